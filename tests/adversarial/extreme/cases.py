"""The extreme set: named scenes at the ends of what a float can say, and how far float32 may be
from float64 there.

Bounds are of the image (largest absolute error) and of each gradient (relative L2 over all rows).
They come from what float32 can give, not from what was seen:

* ORDINARY, 1e-4, where no formula loses digits: some hundred roundings of 6e-8, and pixel
  coordinates of up to 61 with as many.
* A needle's squared distance is a sum of terms of up to D^2 / 0.3 (D: pixels from its mean, 0.3:
  the low-pass) that cancel to less than 11. Half of it is the exponent, so the image may be off by
  `of_needles(D)` times its colours, which are of the order of 1.
* A pixel through n faint splats carries n roundings in its transmittance.
* SSIM takes the contrast as a difference of squares, beside 9e-4: see `of_photos`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests import cases
from tests.cases import world

EPSILON = 2.0**-24  # of float32
LOW_PASS = 0.3
ORDINARY = 1e-4
DOUBLE = 1e-10  # any bound, in double precision
SIZE, WIDE = (48, 40), (320, 240)
SCENE = 10.0  # world units: what a scene size is below


@dataclass(frozen=True)
class Case:
    """make(rng) -> scene: rows and camera (as `tests.reference.project` takes them), degree, near,
    background; drawn and skipped: bool[N], the rows that must be visible and those whose gradients
    must be refused; photo: uint8[3, H, W] for the gradient of the loss, else it is random.
    """

    name: str
    make: Callable
    image: float = ORDINARY
    gradient: float = ORDINARY
    antialiased: bool = False
    slow: bool = False

    def scene(self):
        scene = self.make(np.random.default_rng([0, *self.name.encode()]))
        return {**scene, "rows": cases.single(scene["rows"])}


def of_needles(distance):
    """Error of the exponent at `distance` pixels from the mean of a needle, three roundings."""
    return 3 * EPSILON * distance**2 / (2 * LOW_PASS)


def of_photos(brightness):
    """Error of SSIM's gradient where the image's values are about `brightness`."""
    return 4 * EPSILON * brightness**2 / 0.03**2


def plain(rng, count=24, depth=(2.0, 8.0), sigma=(0.7, 6.0), turned=True, size=SIZE):
    """Gaussians over the image; depths in world units, sigma: standard deviations in pixels."""
    camera = cases.camera(*size, turned)
    depth = np.exp(rng.uniform(*np.log(depth), count))
    pixel = rng.uniform(0.1, 0.9, (count, 2)) * size
    sigma = np.exp(rng.uniform(*np.log(sigma), (count, 3)))
    rows = {
        "positions": world(pixel, depth, camera),
        "log_scales": np.log(sigma * depth[:, None] / camera["fx"]),
        "quaternions": rng.normal(size=(count, 4)),
        "opacity_logits": rng.uniform(-3, 2, count),
        "sh_constant": rng.normal(0.3, 0.8, (count, 3)),
        "sh_rest": rng.normal(0, 0.2, (count, 3, 3)),
    }
    return {
        "rows": rows,
        "camera": camera,
        "degree": 1,
        "near": cases.NEAR,
        "background": cases.single(np.array([0.2, 0.5, 0.9])),
        "drawn": np.ones(count, bool),
        "skipped": np.zeros(count, bool),
    }


def stretched(longest, ratio, axes, opacity=0.0, **options):
    """`axes` of the three are `longest` pixels, the others 1 / ratio of that; `opacity`: added to
    the logits (antialiased, a needle keeps 1/200 of it)."""

    def make(rng):
        scene = plain(rng, sigma=(longest, longest), **options)
        scene["rows"]["log_scales"][:, axes:] -= np.log(ratio)
        scene["rows"]["opacity_logits"] += opacity
        return scene

    return make


def sized(sigma, opacity=-1.0):
    """All standard deviations are `sigma` scene sizes; `opacity`: added to the logits."""

    def make(rng):
        scene = plain(rng)
        scale = np.exp(rng.uniform(-0.5, 0, scene["rows"]["log_scales"].shape))
        scene["rows"]["log_scales"] = np.log(sigma * SCENE * scale)
        scene["rows"]["opacity_logits"] += opacity  # giants hide each other
        return scene

    return make


def logits(value):
    def make(rng):
        scene = plain(rng)
        scene["rows"]["opacity_logits"][:] = value
        scene["drawn"][:] = value > 0
        return scene

    return make


def mixed_sizes(rng):
    """Standard deviations from 1e-6 to 100 world units side by side."""
    scene = plain(rng, count=40)
    scene["rows"]["log_scales"] = np.log(10) * rng.uniform(-6, 2, (40, 3))
    return scene


def turned_by(length):
    def make(rng):
        scene = plain(rng)
        quaternions = scene["rows"]["quaternions"]
        quaternions *= length / np.linalg.norm(quaternions, axis=1, keepdims=True)
        scene["drawn"][:] = length > 0
        scene["skipped"][:] = 0 < length < 1e-18
        return scene

    return make


def at_depth(*depth):
    """Without a translation: beside one, float32 positions have no digits left for 1e-6."""

    def make(rng):
        scene = plain(rng, count=40, depth=depth, turned=False)
        return {**scene, "near": cases.single(depth[0] / 2)}

    return make


def around_near(rng):
    """In front of, on and behind the near plane, at the camera and behind it."""
    scene = plain(rng, count=30, depth=(3, 3.1), sigma=(0.1, 0.4), turned=False)
    near = np.float32(scene["near"])
    depths = np.array([3, np.nextafter(near, 1), near, np.nextafter(near, 0), 0, -3])
    scene["rows"]["positions"] = np.column_stack([rng.uniform(-0.05, 0.05, (30, 2)), np.resize(depths, 30)])
    scene["drawn"] = np.resize(depths > near, 30)
    return scene


def edge_on(rng):
    """Discs of 3 pixels whose plane goes through the camera, nearly: 1e-4 from it."""
    scene = plain(rng, turned=False)
    cases.edge_on(scene["rows"], scene["camera"], rng)
    return scene


def beside_the_image(rng):
    """Seen at grazing angles: beyond the clamp of the Jacobian, but large enough to be drawn."""
    scene = plain(rng)
    size = np.array(SIZE)
    beyond = rng.uniform(0.2, 0.6, (24, 2)) * size
    pixel = np.where(rng.random((24, 2)) < 0.5, -beyond, size + beyond)
    depth = rng.uniform(0.5, 4, 24)
    scene["rows"]["positions"] = world(pixel, depth, scene["camera"])
    scene["rows"]["log_scales"] = np.log(rng.uniform(0.5, 2, (24, 3)) * depth[:, None])
    return scene


def one_pixel(count):
    """All around the centre of one pixel, each hardly visible: the pixel ends after some 2500."""

    def make(rng):
        scene = plain(rng, count=count, sigma=(0.01, 0.3), turned=False, size=(5, 5))
        rows, camera = scene["rows"], scene["camera"]
        depth = np.exp(rng.uniform(*np.log([2, 8]), count))
        rows["positions"] = world([2.5, 2.5] + rng.uniform(-0.1, 0.1, (count, 2)), depth, camera)
        rows["opacity_logits"] = rng.uniform(-5.3, -5.1, count)
        return scene

    return make


def coincident(rng):
    """Sixteen copies of one place, shape and depth: the order of storage decides."""
    scene = plain(rng, count=32)
    for name in ("positions", "log_scales", "quaternions"):
        scene["rows"][name][:16] = scene["rows"][name][0]
    return scene


def photographed(photo, colour, background):
    """Rendered in about `colour` over `background`, the photo `photo` (0 to 255) throughout."""

    def make(rng):
        scene = plain(rng)
        scene["rows"]["sh_constant"] = rng.normal(colour, 0.3, (24, 3))
        return {
            **scene,
            "background": np.full(3, float(background)),
            "photo": np.full((3, *SIZE[::-1]), photo, np.uint8),
        }

    return make


def glaring(rng):
    """Every third colour 1e3 or 1e8; at 1e3 the rounding of the image is as much larger."""
    scene = plain(rng)
    scene["rows"]["sh_constant"][::3, 1] = np.resize([4e3, 4e8], 8)
    return scene


def broken(rng):
    """NaN and infinities in one parameter of each row; every other row is healthy."""
    scene = plain(rng, count=48)
    slots = [
        (name, value)
        for name in ("positions", "log_scales", "quaternions", "opacity_logits", "sh_constant", "sh_rest")
        for value in (np.nan, np.inf, -np.inf)
    ]
    for k, (name, value) in enumerate(slots):
        scene["rows"][name].reshape(48, -1)[2 * k, 0] = value
        coloured = name.startswith("sh_")  # drawn in black
        flat_or_opaque = (name, value) in (("log_scales", -np.inf), ("opacity_logits", np.inf))
        scene["drawn"][2 * k] = coloured or flat_or_opaque
        scene["skipped"][2 * k] = coloured
    return scene


NEEDLE = of_needles(np.hypot(*SIZE))

CASES = (
    Case("plain", plain),
    Case("needles 1e6:1", stretched(6, 1e6, 1)),
    Case("needles 1e6:1, antialiased", stretched(6, 1e6, 1, opacity=6.0), antialiased=True),
    Case("needles 1e6:1, 2000 px", stretched(2e3, 1e6, 1), NEEDLE, NEEDLE),
    Case("needles 1e5:1, 2e5 px, antialiased", stretched(2e5, 1e5, 1), NEEDLE, NEEDLE, antialiased=True),
    Case(
        "needles 1e6:1, 2000 px, wide image",
        stretched(2e3, 1e6, 1, count=8, size=WIDE),
        of_needles(np.hypot(*WIDE)),
        of_needles(np.hypot(*WIDE)),
    ),
    Case("discs 1e6:1", stretched(6, 1e6, 2)),
    Case("discs 1e6:1, antialiased", stretched(6, 1e6, 2), antialiased=True),
    Case("discs 1e6:1, 2000 px", stretched(2e3, 1e6, 2), NEEDLE, NEEDLE),
    Case("sigma 1e-9 scenes", sized(1e-9)),
    Case("sigma 1e-9 scenes, antialiased", sized(1e-9, opacity=6.0), antialiased=True),
    Case("sigma 1e4 scenes", sized(1e4)),
    Case("sigma 1e4 scenes, antialiased", sized(1e4), antialiased=True),
    Case("sigma 1e-6 to 100, mixed", mixed_sizes, NEEDLE, NEEDLE),
    Case("opacity logit 100", logits(100.0)),
    Case("opacity logit -100", logits(-100.0)),
    Case("quaternions zero", turned_by(0.0)),
    Case("quaternions 1e30", turned_by(1e30)),
    Case("quaternions 1e-12", turned_by(1e-12)),
    Case("quaternions 1e-30", turned_by(1e-30)),
    Case("around the near plane", around_near),
    Case("discs seen edge-on", edge_on),
    Case("beside the image", beside_the_image),
    Case("depth 1e-6", at_depth(1e-6, 4e-6)),
    Case("depth 1e6", at_depth(1e6, 4e6)),
    Case("depth 1e-6 to 1e6", at_depth(1e-6, 1e6)),
    Case("3e3 splats on one pixel", one_pixel(3_000), 3e3 * EPSILON, 3e3 * EPSILON),
    Case("3e4 splats on one pixel", one_pixel(30_000), 3e3 * EPSILON, 3e3 * EPSILON, slow=True),
    Case("coincident", coincident),
    Case("black photo", photographed(0, 0.3, 0.1)),
    Case("black photo, black render", photographed(0, -9, 0)),
    Case("saturated photo", photographed(255, 0.3, 0.5), gradient=of_photos(1)),
    Case("saturated photo, brighter render", photographed(255, 1, 2), gradient=of_photos(2)),
    Case("colours 1e3 and 1e8", glaring, 1e3 * ORDINARY),
    Case("NaN and inf, one parameter a row", broken),
)
