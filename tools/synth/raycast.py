"""Ray casting of a city with numpy: nearest hits, visibility and Lambertian images.

The rays from a camera, like those towards the sun, project to points of a plane: a ray can meet a
solid only if its point lies in the solid's bounding rectangle in that plane. The rays are sorted
along one axis of the plane, so that the candidates of each solid are found quickly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from tools.synth.city import City
from tools.synth.texture import Texture

SAMPLES_PER_SIDE = 3  # of a pixel: 3 x 3 rays, box filtered
MOST_RAYS = 1 << 18  # at the same time
SUN = np.array([0.45, -0.38, 0.81])  # towards the sun
SUN /= np.linalg.norm(SUN)
SUNLIGHT = np.array([0.78, 0.75, 0.68])
SKYLIGHT = np.array([0.42, 0.45, 0.50])
SKY = np.array([0.62, 0.74, 0.88])
DISPLAY_GAMMA = 1.3
NEAR_DEPTH = 1e-3  # of the near plane, world units
NO_HIT = np.inf  # the ray parameter of a ray that meets nothing


def _corners(bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """All corners [P, 8, 3] from low and high corners [P, 2, 3]."""
    pick = np.indices((2, 2, 2)).reshape(3, 8)
    return np.stack([bounds[:, pick[axis], axis] for axis in range(3)], axis=2)


def _rectangles(city: City, camera: Camera) -> NDArray[np.float64]:
    """Low and high pixel [P, 2, 2] of every solid; infinite for those behind the camera."""
    corners = _corners(city.bounds) @ camera.rotation.T + camera.translation
    rectangles = np.full((len(corners), 2, 2), NO_HIT)
    for solid, corner in enumerate(corners):
        front, back = corner[corner[:, 2] > NEAR_DEPTH], corner[corner[:, 2] <= NEAR_DEPTH]
        if len(front) and len(back):  # clip at the near plane, along all lines between corners
            line = front[:, None] - back
            share = (NEAR_DEPTH - back[:, 2]) / line[:, :, 2]
            front = np.concatenate([front, (back + share[:, :, None] * line).reshape(-1, 3)])
        if len(front):
            pixel = front[:, :2] / front[:, 2:] * camera.focal + camera.centre
            rectangles[solid] = pixel.min(axis=0), pixel.max(axis=0)
    return rectangles


def _meet_box(
    box: NDArray[np.float64], origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The ray parameter [N] at which rays enter a box; NO_HIT if they miss it or start inside."""
    inverse = 1 / np.where(direction == 0, 1e-12, direction)
    first, second = (box[0] - origin) * inverse, (box[1] - origin) * inverse
    enter = np.minimum(first, second).max(axis=1)
    leave = np.maximum(first, second).min(axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, NO_HIT)


def _meet_sphere(
    sphere: NDArray[np.float64], origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """As `_meet_box`, for a sphere (centre, radius); directions may have any length."""
    offset = origin - sphere[:3]
    a = (direction * direction).sum(axis=1)
    b = (offset * direction).sum(axis=1)
    c = (offset * offset).sum(axis=1) - sphere[3] ** 2
    root = b * b - a * c
    enter = (-b - np.sqrt(np.maximum(root, 0))) / a
    return np.where((root > 0) & (enter > 0), enter, NO_HIT)


def _nearest(
    city: City,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    places: NDArray[np.float64],
    rectangles: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    """The nearest solid that each ray meets: the ray parameter [N] and the primitive [N], see
    `cast`.

    Rays have origins and directions [N, 3], world. `places` [N, 2] are the points of the rays in a
    plane to which each of them projects, `rectangles` [P, 2, 2] the bounds of each solid in it.
    """
    nearest = np.full(len(places), NO_HIT)
    primitive = np.full(len(places), -1)
    order = np.argsort(places[:, 1], kind="stable")
    begin, end = np.searchsorted(places[order, 1], rectangles[:, :, 1].T)
    for solid, ((left, _), (right, _)) in enumerate(rectangles):
        rays = order[begin[solid] : end[solid]]
        rays = rays[(places[rays, 0] >= left) & (places[rays, 0] <= right)]
        if not len(rays):
            continue
        if solid < len(city.boxes):
            met = _meet_box(city.boxes[solid], origins[rays], directions[rays])
        else:
            met = _meet_sphere(city.spheres[solid - len(city.boxes)], origins[rays], directions[rays])
        closer = met < nearest[rays]
        nearest[rays[closer]] = met[closer]
        primitive[rays[closer]] = solid + 1
    return nearest, primitive


def cast(city: City, camera: Camera, pixels: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    """What a camera sees at pixel coordinates [N, 2]: the world points [N, 3], not finite in the
    sky, and the primitives [N]: -1 for the sky, 0 for the ground, then the boxes, then the spheres.
    """
    inside = (pixels - camera.centre) / camera.focal
    directions = np.column_stack([inside, np.ones(len(pixels))]) @ camera.rotation
    origins = np.broadcast_to(camera.position, directions.shape)
    nearest, primitive = _nearest(city, origins, directions, pixels, _rectangles(city, camera))
    with np.errstate(divide="ignore"):
        ground = np.where(directions[:, 2] < 0, -origins[:, 2] / directions[:, 2], NO_HIT)
    primitive[ground < nearest] = 0
    with np.errstate(invalid="ignore"):
        return origins + np.minimum(nearest, ground)[:, None] * directions, primitive


def normals(city: City, primitive: NDArray[np.integer], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Outward unit normals [N, 3] at surface points [N, 3] of primitives [N] other than the sky."""
    out = np.zeros_like(points)
    out[:, 2] = 1
    boxes = len(city.boxes)
    on_box = np.flatnonzero((primitive > 0) & (primitive <= boxes))
    low, high = np.moveaxis(city.boxes[primitive[on_box] - 1], 1, 0)
    offset = points[on_box] - (low + high) / 2
    # the point lies in the plane of its face, so that is the nearest plane
    axis = np.argmin(np.abs(np.abs(offset) - (high - low) / 2), axis=1)
    out[on_box] = 0
    out[on_box, axis] = np.sign(offset[np.arange(len(on_box)), axis])
    on_sphere = primitive > boxes
    sphere = city.spheres[primitive[on_sphere] - 1 - boxes]
    out[on_sphere] = (points[on_sphere] - sphere[:, :3]) / sphere[:, 3:]
    return out


def shadowed(city: City, points: NDArray[np.float64], outward: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which surface points [N, 3], with normals [N, 3], are in shadow of the sun, as bool[N]."""
    right = np.cross(SUN, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    plane = np.stack([right, np.cross(SUN, right)], axis=1)
    corners = _corners(city.bounds) @ plane
    origins = points + 1e-4 * outward
    nearest, _ = _nearest(
        city,
        origins,
        np.broadcast_to(SUN, points.shape),
        origins @ plane,
        np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1),
    )
    return np.isfinite(nearest)


def shade(texture: Texture, points: NDArray[np.float64], primitive: NDArray[np.integer]) -> NDArray[np.float64]:
    """Colours [N, 3], 0 to 1, of surface points [N, 3]: the albedo under light of sun and sky."""
    city = texture.city
    outward = normals(city, primitive, points)
    sun = np.maximum(outward @ SUN, 0)
    lit = sun > 0
    sun[lit] *= ~shadowed(city, points[lit], outward[lit])
    sky = 0.75 + 0.25 * outward[:, 2]
    sky *= 0.75 + 0.25 * np.clip(points[:, 2] / 3 + (primitive == 0), 0, 1)  # darker low on walls
    light = sun[:, None] * SUNLIGHT + sky[:, None] * SKYLIGHT
    colours: NDArray[np.float64] = np.clip(texture.albedo(primitive, points, outward) * light, 0, 1)
    return colours


def render(texture: Texture, camera: Camera, gains: ArrayLike = (1.0, 1.0, 1.0)) -> NDArray[np.uint8]:
    """A photo [H, W, 3] of the texture's city, whose light is multiplied by gains [3]."""
    width = camera.width * SAMPLES_PER_SIDE
    image = np.empty((camera.height, camera.width, 3))
    band = max(1, MOST_RAYS // (width * SAMPLES_PER_SIDE))
    x = (np.arange(width) + 0.5) / SAMPLES_PER_SIDE
    for top in range(0, camera.height, band):
        bottom = min(top + band, camera.height)
        y = (np.arange(top * SAMPLES_PER_SIDE, bottom * SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE
        pixels = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
        points, primitive = cast(texture.city, camera, pixels)
        colour = np.tile(SKY, (len(pixels), 1))
        solid = primitive >= 0
        colour[solid] = shade(texture, points[solid], primitive[solid])
        colour = colour.reshape(bottom - top, SAMPLES_PER_SIDE, camera.width, SAMPLES_PER_SIDE, 3)
        image[top:bottom] = colour.mean(axis=(1, 3))
    # a display curve that brightens shadows
    return np.round(255 * np.minimum(image * gains, 1) ** (1 / DISPLAY_GAMMA)).astype(np.uint8)
