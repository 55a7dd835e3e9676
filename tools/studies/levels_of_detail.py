"""The quality and speed of levels of detail for distant cameras: prints a line for each view.

    python -m tools.studies.levels_of_detail CITY [--scene SCENE] [-r R] [--away A] [--bias B]

Held-out views are drawn from the tree of a city and with the full model. -r makes pictures and
photos R times smaller, with as few pixels a world unit as from R times the distance; both are
compared with the photos. --away moves each camera back by A times its distance to the scene; both
are then compared with the full model at SUPERSAMPLING^2 samples a pixel.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.device import choose_device
from clsplat.errors import InputError
from clsplat.evaluation.metrics import psnr
from clsplat.evaluation.run import Run, to_render
from clsplat.evaluation.streamed import Streaming, open_tree
from clsplat.evaluation.views import opened, photo_of, render_view
from tools.studies.study import outermost

SUPERSAMPLING = 4  # samples a pixel along each axis
COLUMNS = {"gaussians": "11,.0f", "share": "8.1%", "psnr_full": "10.2f", "psnr": "8.2f",
           "full_psnr": "10.2f", "seconds": "8.3f", "full_seconds": "13.3f"}


def main(argv):
    """Print the table."""
    made = argparse.ArgumentParser(description=__doc__,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("run", type=Path)
    made.add_argument("--scene", type=Path, help="where the scene is, if it was moved")
    made.add_argument("-r", "--downscale", type=float, default=1.0)
    made.add_argument("--away", type=float, default=0.0)
    made.add_argument("--bias", type=float, default=1.0, help="see `render --lod-bias`")
    made.add_argument("--device", default="auto")
    given = made.parse_args(argv)
    print(f"{'view':<20}" + "".join(
        f"{name:>{how.partition('.')[0].rstrip(',')}}" for name, how in COLUMNS.items()))
    records = []
    for record in compare_views(given.run, given.scene, choose_device(given.device), given.bias,
                                given.away, given.downscale):
        records.append(record)
        print(line(record), flush=True)
    print(line({"name": "mean", **{key: np.mean([r[key] for r in records]) for key in COLUMNS}}))


def line(record):
    """A line of the table."""
    return f"{record['name']:<20}" + "".join(
        f"{record[key]:>{how}}" for key, how in COLUMNS.items())


def compare_views(path, scene_path, device, bias=1.0, away=0.0, downscale=1.0):
    """Yield a dict for each held-out view of a run.

    Its keys are name; gaussians, the number that is drawn, and share, the same as a share of the
    full model; psnr_full, dB, against the full model's render; psnr and full_psnr, of both against
    the reference; seconds and full_seconds, of both, without compilation.
    """
    run = Run.open(path)
    gaussians, scene, options = to_render(path, scene_path)
    scene = scene.reduced(downscale)
    detail = TreeDetail(run, scene, device, bias)
    full = opened(device, gaussians, scene, options)
    for view in scene.split(options.test_every, options.test_offset)[1] or scene.views:
        camera, part = view.camera, np.s_[:, :]
        if away:
            camera, part = moved_away(camera, scene.points, away)
        drawn = detail.drawn
        image, seconds = _timed(device, detail.draw, camera)
        drawn = detail.drawn - drawn
        whole, full_seconds = _timed(device, lambda camera: render_view(*full, camera), camera)
        image, whole, reference = image[part], whole[part], (
            supersampled(full, camera) if away else photo_of(view))[part]
        yield {"name": view.name, "gaussians": drawn,
               "share": drawn / gaussians.count, "psnr_full": psnr(image, whole),
               "psnr": psnr(image, reference), "full_psnr": psnr(whole, reference),
               "seconds": seconds, "full_seconds": full_seconds}


class TreeDetail:
    """Draws the tree of a run; `drawn` counts the gaussians of all pictures."""

    def __init__(self, run, scene, device, bias=1.0):
        self._renderer, self._tree = open_tree(run, device, scene.near(run.options.near),
                                               Streaming(bias))
        self._away = self._tree.offset - scene.offset

    @property
    def drawn(self):
        return self._renderer.drawn

    def draw(self, camera):
        """[H, W, 3], 0 to 1: the picture of a camera."""
        return render_view(self._renderer, self._tree, self._tree.sh_degree,
                           camera.shifted(self._away))


def supersampled(model, camera, samples=SUPERSAMPLING):
    """float32[H, W, 3]: the mean of samples x samples a pixel."""
    height, width = camera.height, camera.width
    image = render_view(*model, camera.resized(samples * width, samples * height))
    return image.reshape(height, samples, width, samples, 3).mean(axis=(1, 3))


def moved_away(camera, points, factor):
    """The camera moved back along its axis, and the part of its image, two slices, that it saw.

    The rest of the image was perhaps never photographed.

    Parameters
    ----------
    points : float64[N, 3]; the median depth of those in the image is the camera's distance.
    factor : how far to move, as a multiple of this distance.

    Raises
    ------
    InputError : the camera sees none of the points.
    """
    pixel, depth = camera.project(points)
    size, centre = np.array([camera.width, camera.height]), np.array(camera.centre)
    seen = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
    if not seen.any():
        raise InputError("--away: a view sees none of the sparse points, so its distance is not "
                         "known; use another scene")
    back = np.array([0, 0, factor * np.median(depth[seen])])
    ends = np.clip(centre + np.array([-centre, size - centre]) / (1 + factor), 0, size)
    left, top, right, bottom = (*np.floor(ends[0]).astype(int), *np.ceil(ends[1]).astype(int))
    return (replace(camera, translation=camera.translation + back),
            np.s_[top:bottom, left:right])


def _timed(device, draw, camera):
    """The image of a camera, and the seconds that it took without compilation."""
    begin = time.perf_counter() - device.build_seconds
    return draw(camera), time.perf_counter() - device.build_seconds - begin


if __name__ == "__main__":
    outermost(main)
