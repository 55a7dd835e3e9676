"""Named, seeded inputs of the kernel tests and benchmarks: dicts of float64 arrays.

Every number is one that float32 holds, so that kernels of both precisions and the reference start
from the same input.
"""

import zlib

import numpy as np

IMAGE_SIZES = ((48, 40), (61, 37), (16, 16), (7, 5), (1, 1), (33, 17))

# to be put into each input slot in turn, see `poisoned`
POISON = {
    "nan": np.nan,
    "inf": np.inf,
    "-inf": -np.inf,
    "zero": 0.0,
    "-zero": -0.0,
    "denormal": float(np.float32(1e-40)),
    "-denormal": float(np.float32(-1e-40)),
    "smallest_normal": float(np.finfo(np.float32).tiny),
    "largest": float(np.finfo(np.float32).max),
    "-largest": float(np.finfo(np.float32).min),
    "root_of_largest": float(np.float32(1.8446743e19)),  # the square is the largest, or inf
    "exp_overflow": float(np.float32(88.8)),
    "exp_underflow": float(np.float32(-103.9)),
    "alpha_min": float(np.float32(1 / 255)),
    "logit_alpha_min": float(np.float32(np.log(1 / 254))),
    "alpha_max": float(np.float32(0.99)),
    "transmittance_min": float(np.float32(1e-4)),
    "large": 1e6,
    "-large": -1e6,
}

# name: (gaussians, width, height, stored degree, active degree, turned off-centre camera)
SCENES = {
    "empty": (0, 48, 40, 3, 3, False),
    "one": (1, 16, 16, 3, 3, False),
    "plain": (30, 48, 40, 3, 3, False),
    "ragged": (45, 61, 37, 3, 3, True),
    "one_tile": (20, 16, 16, 0, 0, False),
    "less_than_a_tile": (12, 7, 5, 1, 1, True),
    "degree_0": (25, 33, 17, 0, 0, True),
    "degree_1": (25, 33, 17, 1, 1, True),
    "degree_2": (25, 33, 17, 2, 2, True),
    "lower_degree_active": (25, 33, 17, 3, 1, True),
    "stack": (120, 24, 20, 1, 1, False),
    "needles": (40, 48, 40, 1, 1, True),
    "discs": (40, 48, 40, 1, 1, True),
    "giants": (15, 61, 37, 1, 1, True),
    "specks": (40, 48, 40, 1, 1, False),
    "grazing": (60, 48, 40, 1, 1, True),
    "near_plane": (24, 48, 40, 1, 1, False),
    "quaternions": (30, 48, 40, 1, 1, True),
    "opacities": (30, 48, 40, 1, 1, True),
    "depths": (40, 48, 40, 1, 1, False),
    "edge_on": (24, 48, 40, 1, 1, False),
    "many": (3000, 160, 120, 3, 3, True),
}


def gaussians(name, seed=0, count=None, width=None, height=None):
    """The case `name` of SCENES, with another count or image size if given.

    Returns a dict: rows and camera (as `tests.reference.project` takes them), degree (active),
    near, background[3].
    """
    default_count, default_width, default_height, stored, degree, turned = SCENES[name]
    rng = _generator(name, seed)
    seen_by = camera(width or default_width, height or default_height, turned)
    rows = _random_rows(rng, default_count if count is None else count, seen_by, stored)
    if name in _CHANGES:
        _CHANGES[name](rows, seen_by, rng)
    return {
        "rows": single(rows),
        "camera": seen_by,
        "degree": degree,
        "near": NEAR,
        "background": single(np.array([0.2, 0.5, 0.9])),
    }


def camera(width, height, turned=False):
    """A camera of some 60 degrees; turned: tilted, moved, off-centre and with unequal focals."""
    if not turned:
        return {
            "width": width,
            "height": height,
            "fx": 0.875 * width,
            "fy": 0.875 * width,
            "cx": width / 2,
            "cy": height / 2,
            "rotation": np.eye(3),
            "translation": np.zeros(3),
        }
    w, x, y, z = np.array([0.8, -0.3, 0.45, 0.26]) / np.linalg.norm([0.8, -0.3, 0.45, 0.26])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return single(
        {
            "width": width,
            "height": height,
            "fx": 0.9 * width,
            "fy": 1.1 * width,
            "cx": 0.43 * width,
            "cy": 0.61 * height,
            "rotation": rotation,
            "translation": np.array([0.7, -1.3, 0.4]),
        }
    )


def splats(count, width, height, seed=0, opacity=(0.05, 0.9), sigma=(0.6, 6.0)):
    """Random splats (as `tests.reference.blend` takes them) around an image, and their `order`.

    sigma: range of the standard deviations, pixels; logarithmically uniform.
    """
    rng = _generator("splats", seed)
    major, minor = np.exp(rng.uniform(*np.log(sigma), (2, count)))
    angle = rng.uniform(0, np.pi, count)
    cos, sin, u, v = np.cos(angle), np.sin(angle), major**-2.0, minor**-2.0
    depths = rng.uniform(1, 9, count)
    return single(
        {
            "means": rng.uniform(-0.1, 1.1, (count, 2)) * [width, height],
            "conics": np.stack([u * cos**2 + v * sin**2, (u - v) * cos * sin, u * sin**2 + v * cos**2], axis=1),
            "opacities": rng.uniform(*opacity, count),
            "colours": rng.uniform(0, 1, (count, 3)),
            "depths": depths,
        }
    ), np.argsort(np.float32(depths), kind="stable")


def mask(width, height, seed=0):
    """bool[H, W], pixels that count: all but a rectangle at a corner and single ones; at least one."""
    valid = np.random.default_rng([seed, 9]).random((height, width)) < 0.9
    valid[: height // 3, : width // 2] = False
    valid[-1, -1] = True
    return valid


def images(width, height, seed=0):
    """Two images [3, H, W] in 0 to 1: a smooth one with noise, and the same with other noise."""
    rng = _generator("images", seed)
    line, column = np.mgrid[:height, :width]
    phase = rng.uniform(0, 6, (3, 1, 1))
    base = 0.5 + 0.3 * np.sin(0.31 * line + phase) * np.cos(0.17 * column - phase)
    return tuple(single(np.clip(base + rng.normal(0, 0.08, base.shape), 0, 1)) for _ in range(2))


def poisoned(arrays, name, index, value):
    """A copy of the dict `arrays` in which arrays[name][index] is `value`."""
    changed = arrays[name].copy()
    changed[index] = value
    return {**arrays, name: changed}


def single(values):
    """`values` (number, array or dict of them) rounded to float32, as float64; ints stay."""
    if isinstance(values, dict):
        return {name: single(value) for name, value in values.items()}
    if isinstance(values, int):
        return values
    return np.asarray(values, np.float32).astype(np.float64)[()]


NEAR = single(0.2)


def _generator(name, seed):
    return np.random.default_rng([zlib.crc32(name.encode()), seed])


def _random_rows(rng, count, seen_by, stored_degree):
    """Gaussians over and around the image, 2 to 8 units deep, 0.7 to 6 pixels in size."""
    depth = rng.uniform(2, 8, count)
    pixel = rng.uniform(-0.15, 1.15, (count, 2)) * [seen_by["width"], seen_by["height"]]
    sigma = np.exp(rng.uniform(np.log(0.7), np.log(6), (count, 3)))
    return {
        "positions": world(pixel, depth, seen_by),
        "log_scales": np.log(sigma * depth[:, None] / seen_by["fx"]),
        "quaternions": rng.normal(0, 1, (count, 4)),
        "opacity_logits": rng.uniform(-4, 2, count),
        "sh_constant": rng.normal(0.3, 0.8, (count, 3)),
        "sh_rest": rng.normal(0, 0.2, (count, (stored_degree + 1) ** 2 - 1, 3)),
    }


def world(pixel, depth, seen_by):
    """World positions [N, 3] of pixels [N, 2] at depths [N]."""
    focal, centre = [seen_by["fx"], seen_by["fy"]], [seen_by["cx"], seen_by["cy"]]
    p = np.column_stack([(pixel - centre) / focal * depth[:, None], depth])
    return (p - seen_by["translation"]) @ seen_by["rotation"]


def _stack(rows, seen_by, rng):
    """All on the middle of the image and nearly opaque: alpha is clamped, pixels stop early."""
    count = len(rows["positions"])
    pixel = rng.normal(0, 1.5, (count, 2)) + [seen_by["width"] / 2, seen_by["height"] / 2]
    rows["positions"] = world(pixel, rng.uniform(2, 8, count), seen_by)
    rows["opacity_logits"] = rng.uniform(0, 9, count)


def _needles(rows, seen_by, rng):
    """One axis up to 1e6 times the others."""
    rows["log_scales"][:, 1:] -= np.log(10) * rng.uniform(2, 6, len(rows["log_scales"]))[:, None]


def _discs(rows, seen_by, rng):
    """One axis down to 1e-6 of the others."""
    rows["log_scales"][:, 0] -= np.log(10) * rng.uniform(2, 6, len(rows["log_scales"]))


def _giants(rows, seen_by, rng):
    """Larger than the image, up to 1e4 times."""
    rows["log_scales"] += np.log(10) * rng.uniform(1.5, 4, rows["log_scales"].shape)
    rows["opacity_logits"] -= 2


def _specks(rows, seen_by, rng):
    """Far smaller than a pixel."""
    rows["log_scales"] -= np.log(10) * rng.uniform(1, 8, rows["log_scales"].shape)


def _grazing(rows, seen_by, rng):
    """Far beside the image, so that the ratios of the Jacobian are clamped, but large enough to
    reach into it."""
    count = len(rows["positions"])
    pixel = rng.uniform(-1, 2, (count, 2)) * [seen_by["width"], seen_by["height"]]
    rows["positions"] = world(pixel, rng.uniform(0.5, 4, count), seen_by)
    rows["log_scales"] = rng.uniform(-2, 0.5, (count, 3))


def _near_plane(rows, seen_by, rng):
    """In turn before, just before, on, just behind and behind the near plane, and at the camera."""
    depths = [
        3.0,
        np.nextafter(np.float32(NEAR), np.float32(1)),
        NEAR,
        np.nextafter(np.float32(NEAR), np.float32(0)),
        -3.0,
        0.0,
    ]
    count = len(rows["positions"])
    rows["positions"][:, 2] = np.resize(depths, count)
    rows["positions"][:, :2] = rng.uniform(-0.03, 0.03, (count, 2))
    rows["log_scales"] -= 2


def _quaternions(rows, seen_by, rng):
    """In turn zero, huge, tiny, and as they were; only the zero ones mean nothing."""
    for k, factor in enumerate((0, 1e15, 1e-15)):
        rows["quaternions"][k::4] *= factor


def _opacities(rows, seen_by, rng):
    """Logits of +-40, and around alpha = 1/255."""
    count = len(rows["opacity_logits"])
    rows["opacity_logits"] = np.resize([40, -40, np.log(1 / 254) + 0.01, np.log(1 / 254) - 0.01], count).astype(float)


def _depths(rows, seen_by, rng):
    """From just behind the near plane to 1e6 units away, all of a few pixels."""
    count = len(rows["positions"])
    depth = np.exp(rng.uniform(*np.log([1.1 * NEAR, 1e6]), count))
    pixel = rng.uniform(0.1, 0.9, (count, 2)) * [seen_by["width"], seen_by["height"]]
    rows["log_scales"] += np.log(depth / rows["positions"][:, 2])[:, None]
    rows["positions"] = world(pixel, depth, seen_by)


def edge_on(rows, seen_by, rng):
    """Discs of 3 pixels whose plane goes through the camera, nearly: 1e-4 from it."""
    ray = rows["positions"] / np.linalg.norm(rows["positions"], axis=1, keepdims=True)
    normal = np.cross(ray, rng.normal(size=ray.shape))
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) + 1e-4 * ray
    half = normal / np.linalg.norm(normal, axis=1, keepdims=True) + [0, 0, 1]  # from z to normal
    rows["quaternions"] = np.column_stack([half[:, 2], np.cross([0, 0, 1], half)])
    rows["log_scales"] = np.log(np.array([3, 3, 3e-6]) * rows["positions"][:, 2:] / seen_by["fx"])


_CHANGES = {
    "depths": _depths,
    "edge_on": edge_on,
    "stack": _stack,
    "needles": _needles,
    "discs": _discs,
    "giants": _giants,
    "specks": _specks,
    "grazing": _grazing,
    "near_plane": _near_plane,
    "quaternions": _quaternions,
    "opacities": _opacities,
}
