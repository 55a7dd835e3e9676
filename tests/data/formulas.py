"""How the manuals of other programs project points, to compare with COLMAP's camera models.

Each function takes points float64[N, 3] in a camera's frame (right, down, forward) and gives pixels
float64[N, 2] with (0.5, 0.5) in the middle of the first.
"""

import numpy as np
import pycolmap


def rays(seed=0, count=50, wide=0.6):
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(-wide, wide, (count, 2)), np.ones(count)])


def colmap(optics, points):
    """Pixels by the camera model that a reader chose."""
    model, parameters = optics.model or ("PINHOLE", (*optics.focal, *optics.centre))
    return pycolmap.Camera(
        model=model, width=optics.size[0], height=optics.size[1], params=list(parameters)
    ).img_from_cam(points)


def fisheye(points):
    """x and y scaled to the angle from the axis."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r = np.hypot(x, y)
    return x * np.arctan(r) / r, y * np.arctan(r) / r


def metashape(points, size, f, cx, cy, b1=0.0, k=(0, 0, 0, 0), p1=0.0, p2=0.0, wide=False):
    """Metashape's manual, appendix "Camera models"."""
    x, y = fisheye(points) if wide else (points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
    r2 = x**2 + y**2
    radial = 1 + sum(value * r2 ** (n + 1) for n, value in enumerate(k))
    x_ = x * radial + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y
    y_ = y * radial + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y
    return np.column_stack([size[0] * 0.5 + cx + x_ * f + x_ * b1, size[1] * 0.5 + cy + y_ * f])


def opensfm(points, camera):
    """https://opensfm.org/docs/geometry.html, in pixels from the outer corner of the first: half a
    pixel more than those of OpenCV, which that page converts to."""
    size, kind = (camera["width"], camera["height"]), camera["projection_type"]
    x, y = fisheye(points) if "fisheye" in kind else (points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
    r2 = x**2 + y**2
    radial = 1 + sum(camera.get(f"k{n}", 0.0) * r2**n for n in range(1, 5))
    p1, p2 = camera.get("p1", 0.0), camera.get("p2", 0.0)
    x_ = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    y_ = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)
    fx, fy = camera.get("focal_x", camera.get("focal")), camera.get("focal_y", camera.get("focal"))
    u, v = fx * x_ + camera.get("c_x", 0.0), fy * y_ + camera.get("c_y", 0.0)
    opencv = max(size) * np.column_stack([u, v]) + (np.array(size) - 1) / 2
    return opencv + 0.5
