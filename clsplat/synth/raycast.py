"""Ray casting of a city with numpy: nearest hits, visibility and Lambertian images.

All beams used here, from a camera or along the sun, are two-dimensional: a ray can meet a solid
only where its place in the beam's plane lies in the solid's bounding rectangle there. Rays sorted
along one axis of that plane make the solids' candidates cheap to find.
"""

import numpy as np

SAMPLES = 3  # rays a pixel along each axis, box filtered
BAND = 1 << 18  # rays at a time
SUN = np.array([0.45, -0.38, 0.81])  # towards the sun
SUN /= np.linalg.norm(SUN)
SUNLIGHT = np.array([0.78, 0.75, 0.68])
SKYLIGHT = np.array([0.42, 0.45, 0.50])
NEAR = 1e-3  # depth from which a camera sees, world units
FAR = np.inf


def _corners(bounds):
    """float64[P, 8, 3] from low and high corners [P, 2, 3]."""
    pick = np.indices((2, 2, 2)).reshape(3, 8)
    return np.stack([bounds[:, pick[axis], axis] for axis in range(3)], axis=2)


def _rectangles(city, camera):
    """float64[P, 2, 2]: low and high pixel of every solid; empty for those behind the camera."""
    corners = _corners(city.bounds) @ camera.rotation.T + camera.translation
    rectangles = np.full((len(corners), 2, 2), FAR)
    for solid, corner in enumerate(corners):
        front, back = corner[corner[:, 2] > NEAR], corner[corner[:, 2] <= NEAR]
        if len(front) and len(back):  # cut at the near plane, along all lines between corners
            line = front[:, None] - back
            share = (NEAR - back[:, 2]) / line[:, :, 2]
            front = np.concatenate([front, (back + share[:, :, None] * line).reshape(-1, 3)])
        if len(front):
            pixel = front[:, :2] / front[:, 2:] * camera.focal + camera.centre
            rectangles[solid] = pixel.min(axis=0), pixel.max(axis=0)
    return rectangles


def _meet_box(box, origin, direction):
    """Where rays [N, 3] enter a box, float64[N] ray parameter; FAR if they miss or start in it."""
    inverse = 1 / np.where(direction == 0, 1e-12, direction)
    first, second = (box[0] - origin) * inverse, (box[1] - origin) * inverse
    enter = np.minimum(first, second).max(axis=1)
    leave = np.maximum(first, second).min(axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, FAR)


def _meet_sphere(sphere, origin, direction):
    """As `_meet_box`, for a sphere (centre, radius); directions need not have unit length."""
    offset = origin - sphere[:3]
    a = (direction * direction).sum(axis=1)
    b = (offset * direction).sum(axis=1)
    c = (offset * offset).sum(axis=1) - sphere[3] ** 2
    root = b * b - a * c
    enter = (-b - np.sqrt(np.maximum(root, 0))) / a
    return np.where((root > 0) & (enter > 0), enter, FAR)


def _nearest(city, origins, directions, places, rectangles):
    """Nearest solid each ray meets: ray parameter float64[N] (FAR: none) and primitive int[N].

    origins, directions: [N, 3]; places: [N, 2] in the beam's plane; rectangles: [P, 2, 2] there.
    """
    nearest = np.full(len(places), FAR)
    primitive = np.full(len(places), -1)
    order = np.argsort(places[:, 1], kind="stable")
    begin, end = np.searchsorted(places[order, 1], rectangles[:, :, 1].T)
    for solid, ((left, _), (right, _)) in enumerate(rectangles):
        rays = order[begin[solid]:end[solid]]
        rays = rays[(places[rays, 0] >= left) & (places[rays, 0] <= right)]
        if not len(rays):
            continue
        if solid < len(city.boxes):
            met = _meet_box(city.boxes[solid], origins[rays], directions[rays])
        else:
            met = _meet_sphere(city.spheres[solid - len(city.boxes)], origins[rays],
                               directions[rays])
        closer = met < nearest[rays]
        nearest[rays[closer]] = met[closer]
        primitive[rays[closer]] = solid + 1
    return nearest, primitive


def cast(city, camera, pixels):
    """What a camera sees at pixel coordinates [N, 2].

    Returns points float64[N, 3] in the world (not finite in the sky), and primitive int[N]: -1 sky,
    0 ground, then boxes, then spheres.
    """
    inside = (pixels - camera.centre) / camera.focal
    directions = np.column_stack([inside, np.ones(len(pixels))]) @ camera.rotation
    origins = np.broadcast_to(camera.position, directions.shape)
    nearest, primitive = _nearest(city, origins, directions, pixels, _rectangles(city, camera))
    with np.errstate(divide="ignore"):
        ground = np.where(directions[:, 2] < 0, -origins[:, 2] / directions[:, 2], FAR)
    primitive[ground < nearest] = 0
    with np.errstate(invalid="ignore"):
        return origins + np.minimum(nearest, ground)[:, None] * directions, primitive


def normals(city, primitive, points):
    """Outward unit normals float64[N, 3] of surface points of primitives (none of them sky)."""
    out = np.zeros_like(points)
    out[:, 2] = 1
    boxes = len(city.boxes)
    on = np.flatnonzero((primitive > 0) & (primitive <= boxes))
    low, high = np.moveaxis(city.boxes[primitive[on] - 1], 1, 0)
    offset = points[on] - (low + high) / 2
    # the face is the one whose plane the point lies in, so the smallest gap
    axis = np.argmin(np.abs(np.abs(offset) - (high - low) / 2), axis=1)
    out[on] = 0
    out[on, axis] = np.sign(offset[np.arange(len(on)), axis])
    on = primitive > boxes
    sphere = city.spheres[primitive[on] - 1 - boxes]
    out[on] = (points[on] - sphere[:, :3]) / sphere[:, 3:]
    return out


def shadowed(city, points, outward):
    """bool[N]: surface points that the sun does not reach because a solid is in between."""
    right = np.cross(SUN, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    plane = np.stack([right, np.cross(SUN, right)], axis=1)
    corners = _corners(city.bounds) @ plane
    origins = points + 1e-4 * outward
    nearest, _ = _nearest(
        city, origins, np.broadcast_to(SUN, points.shape), origins @ plane,
        np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1))
    return np.isfinite(nearest)


def shade(texture, points, primitive):
    """Colours float64[N, 3], 0..1, of surface points: albedo under sun and sky."""
    city = texture.city
    outward = normals(city, primitive, points)
    sun = np.maximum(outward @ SUN, 0)
    lit = sun > 0
    sun[lit] *= ~shadowed(city, points[lit], outward[lit])
    sky = 0.75 + 0.25 * outward[:, 2]
    sky *= 0.75 + 0.25 * np.clip(points[:, 2] / 3 + (primitive == 0), 0, 1)  # less low on walls
    light = sun[:, None] * SUNLIGHT + sky[:, None] * SKYLIGHT
    return np.clip(texture.albedo(primitive, points, outward) * light, 0, 1)


def render(texture, camera):
    """A photo uint8[H, W, 3] of the city that `texture` paints."""
    width = camera.width * SAMPLES
    image = np.empty((camera.height, camera.width, 3))
    band = max(1, BAND // (width * SAMPLES))
    x = (np.arange(width) + 0.5) / SAMPLES
    for top in range(0, camera.height, band):
        bottom = min(top + band, camera.height)
        y = (np.arange(top * SAMPLES, bottom * SAMPLES) + 0.5) / SAMPLES
        pixels = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
        points, primitive = cast(texture.city, camera, pixels)
        colour = np.tile([0.62, 0.74, 0.88], (len(pixels), 1))
        solid = primitive >= 0
        colour[solid] = shade(texture, points[solid], primitive[solid])
        colour = colour.reshape(bottom - top, SAMPLES, camera.width, SAMPLES, 3)
        image[top:bottom] = colour.mean(axis=(1, 3))
    # a display curve, so that shadows stay readable
    return np.round(255 * image ** (1 / 1.3)).astype(np.uint8)
