"""The scene of the benchmarks: an aerial city of gaussians."""

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import Gradients

DEFINES = (("SH_REST", 15), ("ANTIALIASED", 0))  # of project and cull, as in training


def city_size(count: int) -> tuple[int, int]:
    """Width and height in pixels of the views of a city of `count` gaussians."""
    return (1920, 1080) if count >= 1_000_000 else (1024, 768)


def city(
    count: int, size: tuple[int, int] | None = None, views: int = 8, side: float = 200.0, seed: int = 0
) -> tuple[Gaussians, list[Camera]]:
    """Gaussians of degree 3 on the faces of 220 boxes and on the ground, and a ring of oblique
    cameras.

    It is the scene of ../shared/anchors/city_scene.py, drawn in the same order, so that results can
    be compared.

    Parameters
    ----------
    count : the number of gaussians.
    size : width and height of the views, pixels; None is `city_size`.
    side : metres, the width of the city.
    """
    size = size or city_size(count)
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-side / 2, side / 2, (220, 2))
    half = rng.uniform(3, 9, (220, 2))
    height = rng.gamma(3.0, 5.0, 220) + 3
    on_boxes = int(count * 0.55)
    box, face = rng.integers(0, 220, on_boxes), rng.integers(0, 5, on_boxes)
    uv = rng.uniform(-1, 1, (on_boxes, 2))
    across = np.where(face == 0, 1, np.where(face == 1, -1, uv[:, 0]))
    along = np.where(face == 2, 1, np.where(face == 3, -1, uv[:, 1]))
    up = np.where(face == 4, height[box], rng.uniform(0, 1, on_boxes) * height[box])
    walls = np.stack([centre[box, 0] + across * half[box, 0], centre[box, 1] + along * half[box, 1], up], 1)
    ground = np.stack(
        [*rng.uniform(-side / 2, side / 2, (2, count - on_boxes)), rng.normal(0, 0.15, count - on_boxes)], 1
    )
    spacing = np.sqrt(side * side * 2.2 / count)
    scales = spacing * np.exp(rng.normal(-0.4, 0.7, (count, 3)))
    scales[:, 2] *= 0.3
    quaternions = rng.normal(size=(count, 4))
    opacity = rng.beta(1.2, 1.6, count)
    sh = rng.normal(0, 0.05, (count, 16, 3))
    sh[:, 0] = rng.uniform(-1.2, 1.2, (count, 3))
    rows = {
        "positions": np.concatenate([walls, ground]),
        "sh_constant": sh[:, 0],
        "sh_rest": sh[:, 1:],
        "opacity_logits": np.log(opacity / (1 - opacity)),
        "log_scales": np.log(scales),
        "quaternions": quaternions,
    }
    rows = {name: np.ascontiguousarray(values, np.float32) for name, values in rows.items()}
    return Gaussians(rows, 3), [ring_camera(2 * np.pi * i / views, size) for i in range(views)]


class CityFrame:
    """The city's first view, rendered, so that single families are measured at real sizes.

    Attributes
    ----------
    count, seen : numbers of gaussians, and of those that the view sees.
    camera : packed by the renderer.
    pairs : of the frame, which has one band.
    rows : real[N, ...] by the name of the field.
    size : the numbers of gaussians, pixels and pairs, for `Bench.report`.
    """

    def __init__(self, device: Device, count: int) -> None:
        gaussians, (camera, *_) = city(count)
        self.device, self.count = device, count
        self.renderer = Renderer(device, gaussians.sh_degree, near=0.01)
        self.camera = self.renderer.pack(camera)
        self.rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
        self.frame = self.renderer.render(self.rows, self.camera, camera.width, camera.height, sh_degree=3)
        pairs = self.frame.pairs
        assert pairs is not None  # the frame fits one band
        self.pairs, self.seen = pairs, len(self.frame.visible)
        self.size = {
            "gaussians": count,
            "width": camera.width,
            "height": camera.height,
            "visible": self.seen,
            "pairs": pairs.count,
        }

    def plane(self, seed: int = 0, channels: int = 0) -> NDArray[np.float64]:
        """Random numbers from 0 to 1 for each pixel, or for each of some channels of them."""
        width, height = self.frame.size
        return np.random.default_rng(seed).random((*[channels] * bool(channels), height, width))

    def gradients(self) -> Gradients:
        """Gradients of a loss whose gradient is the same for every value of the image."""
        image = self.frame.image
        grad = image.device.upload(np.full(image.shape, 1 / np.prod(image.shape)))
        return self.renderer.adjoint(self.rows, self.frame, grad)


def ring_camera(angle: float, size: tuple[int, int]) -> Camera:
    """A camera at a height of 85 m on a circle of radius 90 m, which looks at the city's middle."""
    width, height = size
    eye = np.array([90 * np.cos(angle), 90 * np.sin(angle), 85.0])
    forward = np.array([10 * np.sin(3 * angle), 10 * np.cos(2 * angle), 0]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = 0.9 * width
    return Camera(width, height, (focal, focal), (width / 2, height / 2), rotation, -rotation @ eye)
