"""Gaussians to splats, and the adjoint: float64 numpy, one array operation a formula.

A camera is a dict: width, height, fx, fy, cx, cy (pixels), rotation[3, 3] and translation[3]
(world to camera); with orthographic: True, fx and fy are pixels a unit, and rays are parallel to
the axis. Rows are a dict: positions[N, 3], log_scales[N, 3], quaternions[N, 4] (wxyz, any length),
opacity_logits[N], sh_constant[N, 3], sh_rest[N, K, 3].
"""

import numpy as np

from tests.reference.cull import cull

COLOUR_MAX = 1e6  # brighter is not drawn
ANTIALIAS_FLOOR = 2.5e-5  # least share of its area that a splat keeps under the low-pass
SH_BANDS = (1, 4, 9, 16)  # coefficients up to each degree

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def project(rows, camera, degree, near, low_pass=0.3, antialiased=False):
    """Splats of gaussians: means[N, 2], conics[N, 3], depths[N], opacities[N], colours[N, 3],
    cutoffs[N], extents[N, 2] and visible[N]; rows that are not visible are zero.

    conics (a, b, c): q = a dx^2 + 2 b dx dy + c dy^2; cutoffs: the q at which alpha is 1/255;
    extents: half sides (pixels) of the box around q <= cutoff.
    """
    with np.errstate(all="ignore"):
        f = _forward(rows, camera, degree, low_pass, antialiased)
        splats = {
            "means": f["mean"],
            "conics": np.stack([f["yy"], -f["xy"], f["xx"]], axis=1) / f["det"][:, None],
            "depths": f["p"][:, 2],
            "opacities": f["opacity"] * f["coverage"],
            "colours": np.where(_is_drawn(f["colour"]), f["colour"], 0),
        }
        splats["cutoffs"] = 2 * np.log(255 * splats["opacities"])
        splats["extents"] = np.sqrt(splats["cutoffs"][:, None] * np.stack([f["xx"], f["yy"]], axis=1))
        visible = cull(splats, camera, near)
    for values in splats.values():
        values[~visible] = 0
    return {**splats, "visible": visible}


def project_adjoint(rows, camera, degree, near, low_pass=0.3, antialiased=False, *, grads):
    """Gradients like `rows`, from `grads` of any of means, conics, opacities, colours, depths.

    Rows that are not visible get zero, whatever their `grads` hold.
    """
    visible = project(rows, camera, degree, near, low_pass, antialiased)["visible"]
    seen = {name: values[visible] for name, values in rows.items()}
    count = int(visible.sum())
    shapes = {"means": (2,), "conics": (3,), "opacities": (), "colours": (3,), "depths": ()}
    given = {
        name: grads[name][visible] if name in grads else np.zeros((count, *shape)) for name, shape in shapes.items()
    }
    result = {name: np.zeros(values.shape) for name, values in rows.items()}
    for name, values in _adjoint(seen, camera, degree, low_pass, antialiased, given).items():
        result[name][visible] = values
    return result


def harmonics(direction, degree):
    """Real SH basis [N, bands] of unit directions [N, 3] up to `degree`, and its derivative
    [N, bands, 3] by the three components taken as independent (signs of Kerbl et al. 2023)."""
    x, y, z = direction.T
    one, none = np.ones_like(x), np.zeros_like(x)
    xx, yy, zz = x * x, y * y, z * z
    table = (  # value, then its derivatives by x, y, z
        (C0 * one, none, none, none),
        (-C1 * y, none, -C1 * one, none),
        (C1 * z, none, none, C1 * one),
        (-C1 * x, -C1 * one, none, none),
        (C2[0] * x * y, C2[0] * y, C2[0] * x, none),
        (C2[1] * y * z, none, C2[1] * z, C2[1] * y),
        (C2[2] * (2 * zz - xx - yy), -2 * C2[2] * x, -2 * C2[2] * y, 4 * C2[2] * z),
        (C2[3] * x * z, C2[3] * z, none, C2[3] * x),
        (C2[4] * (xx - yy), 2 * C2[4] * x, -2 * C2[4] * y, none),
        (C3[0] * y * (3 * xx - yy), 6 * C3[0] * x * y, 3 * C3[0] * (xx - yy), none),
        (C3[1] * x * y * z, C3[1] * y * z, C3[1] * x * z, C3[1] * x * y),
        (C3[2] * y * (4 * zz - xx - yy), -2 * C3[2] * x * y, C3[2] * (4 * zz - xx - 3 * yy), 8 * C3[2] * y * z),
        (
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -6 * C3[3] * x * z,
            -6 * C3[3] * y * z,
            C3[3] * (6 * zz - 3 * xx - 3 * yy),
        ),
        (C3[4] * x * (4 * zz - xx - yy), C3[4] * (4 * zz - 3 * xx - yy), -2 * C3[4] * x * y, 8 * C3[4] * x * z),
        (C3[5] * z * (xx - yy), 2 * C3[5] * x * z, -2 * C3[5] * y * z, C3[5] * (xx - yy)),
        (C3[6] * x * (xx - 3 * yy), 3 * C3[6] * (xx - yy), -6 * C3[6] * x * y, none),
    )[: SH_BANDS[degree]]
    basis = np.stack([row[0] for row in table], axis=1)
    return basis, np.stack([np.stack(row[1:], axis=1) for row in table], axis=1)


def rotations(quaternions):
    """Rotation matrices [N, 3, 3] of quaternions [N, 4], their unit quaternions and lengths."""
    largest = np.abs(quaternions).max(axis=1, keepdims=True, initial=0)
    scaled = quaternions / largest  # squares of huge and tiny quaternions leave the range
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    unit = scaled / length
    w, x, y, z = unit.T
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.moveaxis(matrix, 2, 0), unit, length * largest


def _forward(rows, camera, degree, low_pass, antialiased):
    """Every intermediate value that the splats or the adjoint need."""
    focal = np.array([camera["fx"], camera["fy"]])
    centre = np.array([camera["cx"], camera["cy"]])
    size = np.array([camera["width"], camera["height"]])
    turn = camera["rotation"]
    p = rows["positions"] @ turn.T + camera["translation"]
    z = p[:, 2]
    flat = camera.get("orthographic", False)
    ratio = p[:, :2] / (1 if flat else z[:, None])
    margin = 0.3 * 0.5 * size / focal
    low, high = -(centre / focal + margin), (size - centre) / focal + margin
    clamped = np.clip(ratio, low, high)

    jacobian = np.zeros((len(p), 2, 3))
    for axis in (0, 1):
        jacobian[:, axis, axis] = focal[axis] / (1 if flat else z)
        jacobian[:, axis, 2] = 0 if flat else -focal[axis] * clamped[:, axis] / z
    body, unit, length = rotations(rows["quaternions"])
    scales = np.exp(rows["log_scales"])
    b = jacobian @ turn @ body
    m = b * scales[:, None, :]
    m1, m2 = m[:, 0], m[:, 1]
    cross = np.cross(b[:, 0], b[:, 1])  # times two scales each, it is that of m
    pairs = scales[:, [1, 2, 0]] * scales[:, [2, 0, 1]]
    area = ((cross * pairs) ** 2).sum(1)  # squared area of the splat before the low-pass
    squares = (m1**2).sum(1), (m2**2).sum(1)
    blur = low_pass * (squares[0] + squares[1]) + low_pass**2
    det = area + blur

    position = -turn.T @ camera["translation"]
    offset = rows["positions"] - position
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    direction = np.broadcast_to(turn[2], p.shape) if flat else offset / distance
    basis, basis_by_direction = harmonics(direction, degree)
    coefficients = np.concatenate([rows["sh_constant"][:, None], rows["sh_rest"]], axis=1)[:, : SH_BANDS[degree]]
    return {
        "p": p,
        "ratio": ratio,
        "clamped": clamped,
        "free": (ratio > low) & (ratio < high),
        "mean": focal * ratio + centre,
        "jacobian": jacobian,
        "body": body,
        "unit": unit,
        "length": length,
        "scales": scales,
        "b": b,
        "cross": cross,
        "pairs": pairs,
        "area": area,
        "xx": squares[0] + low_pass,
        "yy": squares[1] + low_pass,
        "xy": (m1 * m2).sum(1),
        "det": det,
        "blur": blur,
        "opacity": _sigmoid(rows["opacity_logits"]),
        "coverage": np.sqrt(np.maximum(area / det, ANTIALIAS_FLOOR)) if antialiased else np.ones(len(p)),
        "direction": direction,
        "distance": distance,
        "basis": basis,
        "basis_by_direction": basis_by_direction,
        "coefficients": coefficients,
        "colour": 0.5 + np.einsum("nb,nbc->nc", basis, coefficients),
    }


def _adjoint(rows, camera, degree, low_pass, antialiased, grads):
    f = _forward(rows, camera, degree, low_pass, antialiased)
    focal = np.array([camera["fx"], camera["fy"]])
    turn = camera["rotation"]
    p, z, b = f["p"], f["p"][:, 2], f["b"]
    variances = f["scales"] ** 2
    result = {}

    # opacity: sigmoid, times the coverage of the antialiased form
    sigmoid_slope = f["opacity"] * _sigmoid(-rows["opacity_logits"])
    result["opacity_logits"] = grads["opacities"] * f["coverage"] * sigmoid_slope

    # K = (B S^2 B^T + low_pass I)^-1, so dK = -K d(B S^2 B^T) K. With Q = K B, by Lagrange's
    # identity (the product would cancel for needles), and H = -2 Q^T G Q, the gradient by
    # log_scales is the diagonal of H S^2, by a turn about the body's axes its antisymmetric part
    det = f["det"][:, None]
    q = np.stack(
        [
            low_pass * b[:, 0] + np.cross(variances * b[:, 1], f["cross"]),
            low_pass * b[:, 1] + np.cross(f["cross"], variances * b[:, 0]),
        ],
        axis=1,
    )
    q /= det[:, :, None]
    ga, gb, gc = grads["conics"].T
    conic = _symmetric(f["yy"], -f["xy"], f["xx"]) / det[:, :, None]
    inner = -2 * _symmetric(ga, gb / 2, gc) @ q
    grad_b = conic @ inner * variances[:, None, :]
    h = np.swapaxes(q, 1, 2) @ inner
    result["log_scales"] = np.einsum("nkk,nk->nk", h, variances)
    grad_turn = np.stack(
        [h[:, j, k] * (variances[:, j] - variances[:, k]) for j, k in ((1, 2), (2, 0), (0, 1))], axis=1
    )

    if antialiased:  # share = area / (area + blur)
        share = f["area"] / f["det"]
        by_share = np.where(share > ANTIALIAS_FLOOR, grads["opacities"] * f["opacity"] / (2 * f["coverage"]), 0)
        by_cross = (2 * by_share * f["blur"] / f["det"] ** 2)[:, None] * f["cross"] * f["pairs"] ** 2
        by_b = (-2 * by_share * share / f["det"] * low_pass)[:, None] * variances
        more = np.stack(
            [np.cross(b[:, 1], by_cross) + by_b * b[:, 0], np.cross(by_cross, b[:, 0]) + by_b * b[:, 1]], axis=1
        )
        grad_b += more
        result["log_scales"] += (more * b).sum(1)
        grad_turn += np.cross(more, b).sum(1)
    result["quaternions"] = _turned(f["unit"], grad_turn) * 2 / f["length"]
    grad_jacobian = grad_b @ np.swapaxes(turn @ f["body"], 1, 2)

    # J and the mean, by the position in the camera frame
    grad_p = np.zeros_like(p)
    grad_p[:, 2] = grads["depths"]
    for axis in (0, 1):
        by_focal, by_ratio = grad_jacobian[:, axis, axis], grad_jacobian[:, axis, 2]
        grad_p[:, 2] -= focal[axis] / z**2 * (by_focal - f["clamped"][:, axis] * by_ratio)
        grad_ratio = focal[axis] * grads["means"][:, axis]
        grad_ratio -= np.where(f["free"][:, axis], focal[axis] / z * by_ratio, 0)
        grad_p[:, axis] += grad_ratio / z
        grad_p[:, 2] -= grad_ratio * f["ratio"][:, axis] / z

    # colour, by coefficients and by direction
    grad_colour = np.where(_is_drawn(f["colour"]), grads["colours"], 0)
    grad_coefficients = f["basis"][:, :, None] * grad_colour[:, None, :]
    result["sh_constant"] = grad_coefficients[:, 0]
    result["sh_rest"] = np.zeros(rows["sh_rest"].shape)
    result["sh_rest"][:, : grad_coefficients.shape[1] - 1] = grad_coefficients[:, 1:]
    grad_direction = np.einsum("nbk,nbc,nc->nk", f["basis_by_direction"], f["coefficients"], grad_colour)
    result["positions"] = grad_p @ turn + _tangent(grad_direction, f["direction"]) / f["distance"]
    return result


def _symmetric(a, b, c):
    """Matrices [N, 2, 2] of [N] each."""
    return np.moveaxis(np.array([[a, b], [b, c]]), 2, 0)


def _turned(unit, vector):
    """The quaternion product unit (0, vector): twice the step of `unit` for that turn."""
    w, v = unit[:, :1], unit[:, 1:]
    return np.concatenate([-(v * vector).sum(1, keepdims=True), w * vector + np.cross(v, vector)], axis=1)


def _is_drawn(colour):
    """Channels that are drawn: others, negative, glaring or NaN, are black and have no gradient."""
    return (colour > 0) & (colour < COLOUR_MAX)


def _tangent(grad, unit):
    """The part of `grad` that normalising to `unit` lets through (before division by length)."""
    return grad - unit * (grad * unit).sum(1, keepdims=True)


def _sigmoid(x):
    return 1 / (1 + np.exp(-x))
