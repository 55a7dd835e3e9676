"""How true a map is: its colours against photos, its distances and heights against sparse points.

    python -m tools.studies.orthophoto RUN [--scene SCENE] [--resolution SIZE] [--device DEVICE]

Draws the map of a finished run, and prints

- on flat ground, the PSNR of the orthophoto against the mean of the photos, which are warped onto
  the surface by their cameras, plain and after the colour fit;
- at sparse points that have texture, where a patch of the photo that looks at them most steeply is
  found again in the orthophoto, how far these places are apart, as a share of the distance of the
  points;
- the difference between the surface and the sparse points, for the median depth and for the mean
  depth, which shows why a map takes the median.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.ndimage import (
    gaussian_filter,
    map_coordinates,
    maximum_filter,
    minimum_filter,
)
from scipy.signal import correlate

from clsplat.apps.map_grid import TILE, map_grid
from clsplat.apps.orthophoto import MapPainter
from clsplat.device import choose_device
from clsplat.evaluation.colour import fit_colour
from clsplat.evaluation.metrics import psnr
from clsplat.evaluation.run import Run
from clsplat.io.photos.views import read_photo
from clsplat.rendering.slabs import open_model

WINDOW, LEVEL = 33, 12  # flat: heights in a square of WINDOW pixels differ by less than LEVEL
LEAST_PHOTOS = 5  # of a mean
PATCH, SEARCH = 24, 12  # half sides, pixels: of a patch, and of the area where it is looked for
LEAST_TEXTURE, LEAST_MATCH = 0.03, 0.7  # standard deviation of a patch, and its correlation
LEAST_SHARE = 0.25  # of the map's diagonal, between two places
MOST_POINTS = 400


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--resolution", type=float)
    parser.add_argument("--device", default="auto")
    chosen = parser.parse_args()
    run, device = Run.open(chosen.run), choose_device(chosen.device)
    scene = run.scene(chosen.scene)
    grid = map_grid(scene, chosen.resolution)
    colours, heights = painted(run, scene, grid, device)
    mean, number = mean_photo(scene, grid, smooth(heights))
    flat = flat_ground(heights, grid) & (number >= LEAST_PHOTOS) & (colours[..., 3] > 0)
    image, target = colours[flat][None, :, :3] / 255, mean[flat][None]
    print(f"flat ground: {flat.mean():.1%} of the map, PSNR {psnr(image, target):.2f} dB, "
          f"{psnr(fit_colour(image, target), target):.2f} dB after the colour fit")
    away, error = distances(scene, grid, colours, heights)
    if len(error):
        print(f"distances: {len(away)} places, {np.median(np.linalg.norm(away, axis=1)):.2f} "
              f"pixels from the sparse points (median), distances differ by {np.median(error):.3%} "
              f"(median), {np.quantile(error, 0.95):.3%} (95 %)")
    else:
        print("distances: no places with texture; try a finer --resolution")
    for name, surface in (("median", heights), ("mean", mean_depth(run, grid, device))):
        wrong = at_points(scene, grid, surface)
        print(f"surface by the {name} depth: {np.median(abs(wrong)):.2f} pixels from the sparse "
              f"points (median), {np.quantile(abs(wrong), 0.9):.2f} (90 %)")


def painted(run, scene, grid, device):
    """The colours uint8[H, W, 4] and heights float32[H, W] of a map, in memory."""
    painter = MapPainter(device, run, grid, scene)
    tiles = [[painter.tile(x, y) for x in range(grid.tiles[0])] for y in range(grid.tiles[1])]
    colours, surface = (np.concatenate([np.concatenate([getattr(tile, name) for tile in row],
                                                       axis=1) for row in tiles])
                        [:grid.rows, :grid.columns] for name in ("colours", "surface"))
    return colours, surface[..., 0]


def mean_depth(run, grid, device):
    """The heights of a surface that takes the mean depth."""
    model = run.finished_model
    renderer, rows = open_model(device, model, 0.0, run.options.antialiased, orthographic=True)
    heights = np.empty((grid.tiles[1] * TILE, grid.tiles[0] * TILE))
    for y, x in np.ndindex(grid.tiles[::-1]):
        camera = grid.camera(x, y).shifted(model.offset)
        blended = renderer.render(rows, renderer.pack(camera), TILE, TILE, model.sh_degree,
                                  with_depth=True).blended
        covered = 1 - blended.transmittance.download()
        heights[y * TILE:(y + 1) * TILE, x * TILE:(x + 1) * TILE] = np.where(
            covered >= 0.5, grid.ceiling - blended.depth.download() / np.maximum(covered, 0.5),
            np.nan)
    return heights[:grid.rows, :grid.columns]


def smooth(heights, sigma=6):
    """Heights without their noise, so that warped photos are not torn."""
    known = ~np.isnan(heights)
    weight = gaussian_filter(known.astype(float), sigma)
    return gaussian_filter(np.where(known, heights, 0.0), sigma) / np.maximum(weight, 1e-6)


def flat_ground(heights, grid):
    """bool[H, W]: known, and hardly any slope or step nearby."""
    known, level = ~np.isnan(heights), smooth(heights)
    low = minimum_filter(np.where(known, level, -np.inf), WINDOW)
    high = maximum_filter(np.where(known, level, np.inf), WINDOW)
    return high - low < LEVEL * grid.resolution


def mean_photo(scene, grid, heights):
    """The mean [H, W, 3], 0 to 1, of the photos warped onto a surface, and how many there are."""
    shape = heights.shape
    places = local_places(scene, grid, *np.indices(shape).reshape(2, -1), heights.ravel())
    total, number = np.zeros((len(places), 3)), np.zeros(len(places))
    for view in scene.views:
        pixels, depths = view.camera.project(places)
        size = view.camera.width, view.camera.height
        inside = (depths > 0) & (pixels > 1).all(1) & (pixels < np.subtract(size, 1)).all(1)
        if inside.any():
            total[inside] += sampled(read_photo(view) / 255, pixels[inside])
            number += inside
    return (total / np.maximum(number, 1)[:, None]).reshape(*shape, 3), number.reshape(shape)


def local_places(scene, grid, rows, columns, heights):
    """Pixels of the map at their heights, in the scene's local coordinates [N, 3]."""
    places = np.stack([grid.left + (columns + 0.5) * grid.resolution,
                       grid.top - (rows + 0.5) * grid.resolution, heights], axis=1)
    return (grid.to_scene(places) - scene.offset) / scene.unit


def sampled(image, pixels):
    """Colours [N, channels] of an image at pixels [N, 2], bilinear."""
    return np.stack([map_coordinates(channel, [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5], order=1)
                     for channel in np.moveaxis(image, -1, 0)], axis=-1)


def distances(scene, grid, colours, heights):
    """How far [N, 2], pixels, patches of photos lie in the orthophoto from where the sparse points
    are, and by which share distances between pairs of them differ [pairs]."""
    points = grid.to_map(scene.offset + scene.unit * scene.points)
    pixels = grid.pixels(points)
    margin = PATCH + SEARCH + 1
    inside = ((pixels > margin) & (pixels < np.subtract((grid.columns, grid.rows), margin))).all(1)
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(inside))
    grey = colours[..., :3].mean(axis=-1) / 255
    photos, found = {}, []
    for index in chosen:
        if len(found) == MOST_POINTS:
            break
        column, row = np.floor(pixels[index]).astype(int)
        whole = np.s_[row - margin + 1:row + margin, column - margin + 1:column + margin]
        if not colours[whole][..., 3].all():
            continue
        view = steepest(scene, scene.points[index])
        if view is None:
            continue
        image = photos.setdefault(view.name, None)
        if image is None:
            image = photos[view.name] = read_photo(view).mean(axis=-1)[..., None] / 255
        rows, columns = (each.ravel() for each in np.mgrid[
            row - PATCH:row + PATCH + 1, column - PATCH:column + PATCH + 1])
        places = local_places(scene, grid, rows, columns,
                              np.full(rows.size, points[index, 2]))
        seen, _ = view.camera.project(places)
        if not ((seen > 1) & (seen < np.subtract(image.shape[1::-1], 1))).all():
            continue
        patch = sampled(image, seen).reshape(2 * PATCH + 1, -1)
        shift, match = best_shift(patch, grey[whole])
        if patch.std() > LEAST_TEXTURE and match > LEAST_MATCH:
            found.append((pixels[index], shift))
    places, shifts = (np.array([each[part] for each in found]).reshape(-1, 2) for part in (0, 1))
    first, second = np.triu_indices(len(places), 1)
    true = np.linalg.norm(places[first] - places[second], axis=1)
    far = true > LEAST_SHARE * np.hypot(grid.columns, grid.rows)
    there = np.linalg.norm((places + shifts)[first] - (places + shifts)[second], axis=1)
    return shifts, abs(there[far] / true[far] - 1)


def steepest(scene, point):
    """The view that looks at a point from the direction nearest to straight above, or None."""
    seen = [view for view in scene.views if view.sees(point[None])[0]]

    def rise(view):
        away = view.camera.position - point
        return away @ scene.up / np.linalg.norm(away)

    return max(seen, key=rise, default=None)


def best_shift(patch, area):
    """(column, row) by which a patch lies away from the middle of a larger area, and their
    correlation there."""
    patch = patch - patch.mean()
    ones = np.ones(patch.shape)
    mean = correlate(area, ones, "valid") / patch.size
    spread = np.maximum(correlate(area**2, ones, "valid") / patch.size - mean**2, 1e-8)
    match = correlate(area, patch, "valid") / patch.size / np.sqrt(spread) / (patch.std() + 1e-8)
    row, column = np.unravel_index(match.argmax(), match.shape)
    middle = np.subtract(match.shape, 1) / 2
    return (column - middle[1], row - middle[0]), float(match.max())


def at_points(scene, grid, heights):
    """Differences, pixels, between a surface and the sparse points upon it or below."""
    points = grid.to_map(scene.offset + scene.unit * scene.points)
    column, row = np.floor(grid.pixels(points)).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < grid.columns) & (row < grid.rows)
    difference = (heights[row[inside], column[inside]] - points[inside, 2]) / grid.resolution
    return difference[~np.isnan(difference)]


if __name__ == "__main__":
    main()
