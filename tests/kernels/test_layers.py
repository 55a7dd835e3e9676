"""What surrounds a block, as layers behind and in front of what is blended (cl/include/respond.h).
"""

import numpy as np
import pytest

from clsplat.errors import ShapeError
from clsplat.loss.exposure import Exposures
from clsplat.primitives.compact import new_counts
from clsplat.rendering.bin import bin_splats
from clsplat.rendering.blend import Exposure, blend, blend_adjoint, blend_defines
from clsplat.rendering.project import pack_camera, project_defines, sum_pairs
from clsplat.response import Lenses
from tests import cases
from tests.checks import close
from tests.kernels.chain import (
    SUM_NAMES,
    camera_of,
    grads_of_sums,
    pack_splats,
    precision_of,
    render,
    size_of,
)
from tests.kernels.test_exposure import camera_of as exposed_camera
from tests.reference import blend as reference
from tests.reference import exposure as response

SIZES = ((7, 5), (33, 17), (48, 40))
TRANSFORMS = cases.single(np.eye(3, 4) + np.random.default_rng(5).normal(0, 0.3, (2, 3, 4)))
LENS = cases.single(np.array([[-0.3, 0.2, -0.4, 0.9]]))


def layers_of(size, planes, seed=0):
    """uint8[planes, H, W] with clear, opaque and other pixels."""
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 256, (planes, *size[::-1]), np.uint8)
    if planes == 7:
        values[6].flat[::3], values[6].flat[1::5] = 255, 0
    return values


class Drawn:
    """Splats blended on a device with layers, a transform and a lens; and the way back."""

    def __init__(self, device, splats, order, layers, vignetting=False):
        self.device, self.size = device, layers.shape[:0:-1]
        self.given, self.background = device.upload(layers), device.upload(np.full(3, np.nan))
        self.defines = blend_defines(False)
        self.exposures = Exposures(device, 2, initial=TRANSFORMS.astype(float), lenses=Lenses(
            np.zeros(2, int), LENS) if vignetting else None)
        self.camera = pack_camera(device, exposed_camera(*self.size), 0.01)
        rows = pack_splats(splats, order)
        self.splats = device.upload(rows)
        self.pairs = bin_splats(device, self.splats, new_counts(device, len(rows)), device.upload(
            np.arange(len(rows), dtype=np.uint32)), *self.size)
        self.blended = blend(device, self.splats, self.pairs, *self.size, self.background,
                             self.defines, exposure=self.exposures.of(1, self.camera),
                             backdrop=self.given)

    def adjoint(self, grad):
        """The gradient by the image, the sums of those by the transform, and those by splat."""
        device = self.device
        by_image, partials = self.exposures.adjoint(
            1, self.camera, self.blended.image, device.upload(grad), self.given)
        by_pair = blend_adjoint(device, self.splats, self.pairs, self.blended, self.background,
                                by_image, None, None, self.defines, backdrop=self.given)
        sums = sum_pairs(device, by_pair, self.pairs.counts, project_defines(0, False)).download()
        return by_image.download(), partials.download().astype(float).sum(axis=0), sums


@pytest.mark.oclgrind
@pytest.mark.parametrize("planes, vignetting", [
    (3, False), pytest.param(7, False, marks=pytest.mark.slow), (7, True)])
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.one_in(5)
def test_image_and_gradients(device, size, planes, vignetting):
    """As C = F + T (C_block + T_block B); nothing reads the background, which is nan."""
    splats, order = cases.splats(40, *size)
    layers, precision = layers_of(size, planes), precision_of(device)
    unit = layers / 255
    fragile = reference.fragile_pixels(splats, order, *size)
    image, transmittance, _ = reference.blend(splats, order, *size, unit[:3])
    colour, clear = (unit[3:6], unit[6]) if planes == 7 else (0 * image, 0 * transmittance + 1)
    lens = LENS[0] if vignetting else response.NO_LENS
    u = response.radius(exposed_camera(*size), lens)
    seen = response.in_front(colour, clear, image)
    exposed = response.apply(TRANSFORMS[1], seen, lens, u)

    drawn = Drawn(device, splats, order, layers, vignetting)
    for what, actual, expected in (
            ("image", drawn.blended.image, image), ("exposed", drawn.blended.exposed, exposed),
            ("transmittance", drawn.blended.transmittance, transmittance)):
        close(np.where(fragile, expected, actual.download()), expected, precision, what)

    grad = np.where(fragile, 0, cases.single(np.random.default_rng(4).normal(size=image.shape)))
    seen = response.in_front(colour, clear, drawn.blended.image.download().astype(float))
    by_seen, by_transform, by_lens = response.apply_adjoint(
        TRANSFORMS[1], seen, grad, lens, u)
    by_image = response.in_front_adjoint(clear, by_seen)
    expected = reference.blend_adjoint(splats, order, *size, unit[:3], by_image)
    actual, partials, sums = drawn.adjoint(grad)
    close(actual, by_image, precision, "gradient by the image")
    close(partials, np.append(by_transform.ravel(), by_lens if vignetting else []), precision,
          "gradient by transform and lens")
    grads = grads_of_sums(sums, splats["conics"][order])
    for name in SUM_NAMES:
        close(grads[name], expected[name][order], precision, f"gradient of {name}")


def test_what_is_opaque_in_front_hides_the_block_and_its_poison(float_device):
    """A gradient that is not finite at one pixel stays there."""
    size = 33, 17
    layers = layers_of(size, 7)
    layers[6] = 0
    drawn = Drawn(float_device, *cases.splats(40, *size), layers)
    expected = response.apply(TRANSFORMS[1], layers[3:6] / 255)
    close(drawn.blended.exposed.download(), expected, "float", "exposed")
    grad = np.random.default_rng(4).normal(size=(3, 17, 33))
    assert not drawn.adjoint(grad)[0].any() and not drawn.adjoint(grad)[2].any()
    layers[6] = 128
    drawn, clean = (Drawn(float_device, *cases.splats(40, *size), layers) for _ in range(2))
    for value in cases.POISON.values():
        poisoned = grad.copy()
        with np.errstate(all="ignore"):
            poisoned[:, 8, 20] = value
            actual, expected = drawn.adjoint(poisoned)[0], clean.adjoint(grad)[0]
        actual[:, 8, 20] = expected[:, 8, 20]
        assert np.array_equal(actual, expected)


@pytest.mark.slow
def test_a_frame_in_bands_has_the_same_bytes(device):
    case = cases.gaussians("plain")
    width, height = size_of(case)
    renderer, rows, frame = render(device, case)
    layers = device.upload(layers_of((width, height), 7))
    grad = device.upload(np.random.default_rng(4).normal(size=(3, height, width)))
    results = []
    for limit in (None, frame.pairs.count // 2):
        renderer.pair_limit = limit
        drawn = renderer.render(rows, renderer.pack(camera_of(case)), width, height,
                                case["degree"], backdrop=layers)
        fields = renderer.adjoint(rows, drawn, grad).fields
        results.append([drawn.image, drawn.exposed, fields["positions"], fields["sh_constant"]])
    assert len(drawn.bands) > 1
    assert all(np.array_equal(one.download(), other.download()) for one, other in zip(*results))


def test_layers_of_another_size_are_refused(device):
    splats, order = cases.splats(4, 8, 8)
    drawn = Drawn(device, splats, order, layers_of((8, 8), 3))
    with pytest.raises(ShapeError, match="backdrop"):
        blend(device, drawn.splats, drawn.pairs, 8, 8, drawn.background, drawn.defines,
              exposure=Exposure(drawn.exposures.transforms, 0),
              backdrop=device.upload(layers_of((8, 9), 3)))
