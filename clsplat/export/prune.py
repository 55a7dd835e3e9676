"""What a finished model can do without: gaussians that no view can show, and harmonics that no
held-out view misses."""

import numpy as np

from clsplat.constants import ALPHA_STEPS
from clsplat.errors import InputError
from clsplat.evaluation.views import evaluate_views, read_scene_of, run_options
from clsplat.rendering.pipeline import Renderer


def alive(gaussians):
    """bool[N]: whether a gaussian can be seen at all. Alpha is opacity times what falls off from 1,
    and below 1 / ALPHA_STEPS is nothing: without the others every image has the same bytes."""
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64))) >= 1 / ALPHA_STEPS


def needed_sh_degree(run, device, cost, scene_path=None):
    """(degree, [PSNR at degree 0, 1, ...], dB): the lowest degree of the harmonics whose renders of
    the run's held-out views lose less than `cost` dB of PSNR, a mean over views. scene_path: as of
    `evaluate.views.evaluate_run`.

    Raises InputError for a run without held-out views.
    """
    options, gaussians = run_options(run), run.load_model()
    scene = read_scene_of(run, scene_path)
    scene = scene.reduced(options.downscale, options.max_resolution)
    _, views = scene.split(options.test_every)
    if not views:
        raise InputError(f"{run.path}: no held-out views to measure on (--test-every "
                         f"{options.test_every}); name a degree instead of auto")
    renderer = Renderer(device, gaussians.sh_degree, options.near or scene.near_plane,
                        options.antialiased, options.background)
    rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
    scores = [evaluate_views(renderer, rows, degree, views)["psnr"]
              for degree in range(gaussians.sh_degree + 1)]
    enough = [degree for degree, score in enumerate(scores) if scores[-1] - score < cost]
    return min(enough, default=gaussians.sh_degree), scores
