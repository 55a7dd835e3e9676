"""The benchmarks of kernel families that compare photos: features, depths, reprojection."""

from functools import partial

import numpy as np
import scipy

from clsplat.camera import Camera
from clsplat.constants import DESCRIPTOR_SIZE
from clsplat.loss.reproject import pack_pairs
from clsplat.loss.reproject import reproject as reproject_depth
from clsplat.mesh.signed_distance import Volume
from clsplat.sfm import match as matching
from clsplat.sfm import two_views
from clsplat.sfm.reconstruct import SfmOptions
from clsplat.sfm.sift import Sift
from clsplat.stereo import dense_points
from clsplat.stereo import sweep as sweeping
from tools.bench.report import Cases
from tools.bench.workloads import CityFrame, ring_camera

FEATURES = SfmOptions.max_features


def reproject(city: CityFrame) -> Cases:
    """Reprojection of a rendered depth into a source view."""
    device, size = city.device, city.frame.size
    photo, neighbour = (device.upload((255 * city.plane(seed, 3)).astype(np.uint8)) for seed in (0, 1))
    # about as far as the middle of the city
    depth = device.upload(94 + 2 * city.plane())
    transmittance = device.upload(np.full(depth.shape, 0.25))
    geometries = pack_pairs(device, [(ring_camera(0, size), ring_camera(0.1, size))])
    return {
        "value and gradient": partial(
            reproject_depth,
            device,
            depth,
            transmittance,
            photo,
            neighbour,
            geometries,
            device.upload(np.eye(3, 4).reshape(1, 12)),
            0,
            1.0,
        )
    }


def signed_distance(city: CityFrame) -> Cases:
    """A view added to bricks of a volume around the middle of the city."""
    camera, plane = ring_camera(0, city.frame.size), city.device.upload(125 + city.plane())
    bricks = np.array(list(np.ndindex(6, 6, 2))) - (3, 3, 0)
    volume = Volume(city.device, bricks, 0.15, 0.6)
    return {
        f"{len(bricks)} bricks": partial(
            volume.add,
            np.arange(len(bricks)),
            camera,
            0.01,
            plane,
            plane,
            city.frame.blended.transmittance,
            city.frame.image,
        )
    }


def sweep(city: CityFrame) -> Cases:
    """A plane sweep of one photo over others, and the confirmation of its depths by these, at a
    quarter of the size, about as trainings compare photos."""
    width, height = (side // 4 for side in city.frame.size)
    sources = dense_points.SOURCES
    photos = list(np.random.default_rng(0).uniform(0, 1, (1 + sources, height, width)))
    cameras = [
        Camera(width, height, (width, width), (width / 2, height / 2), np.eye(3), np.array([-0.1 * number, 0, 0]))
        for number in range(len(photos))
    ]
    depths = [np.full((height, width), 0.5) for _ in photos]
    by_photos, by_depths = (
        sweeping.Compared.of(*sweeping.device_images(city.device, images), cameras, 0, range(1, len(photos)))
        for images in (photos, depths)
    )
    return {
        f"{sources} sources": partial(sweeping.sweep, by_photos, (0.1, 1.0), dense_points.PLANES),
        f"confirm, {sources} sources": partial(sweeping.confirm, by_depths, dense_points.SAME_DEPTH),
    }


def sift(city: CityFrame) -> Cases:
    """The features of a made photo, at the size at which those of photos are searched."""
    noise = np.random.default_rng(0).normal(size=(1200, 1600, 3))
    blurred = scipy.ndimage.gaussian_filter(noise, (2, 2, 0))
    pixels = np.clip(128 + 40 * blurred / blurred.std(), 0, 255).astype(np.uint8)
    return {"1600x1200": partial(Sift(city.device, FEATURES).features, pixels, 1600, 1200)}


def match(city: CityFrame) -> Cases:
    """A pair of photos: the largest features all with all, and all along epipolar lines."""
    rng = np.random.default_rng(0)
    described = matching.Described.of(city.device, list(rng.integers(0, 60, (2, FEATURES, DESCRIPTOR_SIZE), np.uint8)))
    points = city.device.upload(rng.uniform(-0.7, 0.7, (2, 2, FEATURES)))
    pairs, rows = np.array([[0, 1]]), [0, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0.003]
    geometry = np.array([[rows], [rows]], np.float64)
    return {
        f"all of {two_views.FEW}": partial(matching.nearest, described, pairs, two_views.FEW),
        f"{FEATURES} along lines": partial(matching.follow, described, points, pairs, geometry),
    }
