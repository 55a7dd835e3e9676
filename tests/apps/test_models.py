"""What a finished model can lose: gaussians that no view shows, and harmonics."""

from functools import partial

import numpy as np

from clsplat.edit.select import alive
from clsplat.estimate.trial_steps import sampled
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.run import RunFolder
from clsplat.rendering.pipeline import Renderer
from tests.data.tiny_training import CITY
from tests.estimate.test_plan import city, clsplat_

__all__ = ["city"]


def faint(gaussians, rows, logit):
    logits = gaussians.opacity_logits.copy()
    logits[rows] = logit
    return Gaussians({**gaussians.rows, "opacity_logits": logits}, gaussians.sh_degree)


def test_dead_gaussians_change_no_pixel(float_device, city):
    gaussians = sampled(city, 3000, 0)
    threshold = np.log(1 / 254)  # of the logit of 1/255
    dead = np.arange(0, 3000, 3)
    gaussians = faint(gaussians, dead, threshold - 1e-3)
    gaussians = faint(gaussians, dead + 1, threshold + 1e-3)
    keep = alive(gaussians)
    assert np.array_equal(np.flatnonzero(~keep), dead)
    renderer, camera = Renderer(float_device, 0, city.near_plane), city.views[0].camera
    images = []
    for rows in (gaussians.rows, {name: values[keep] for name, values in gaussians.rows.items()}):
        held = {name: float_device.upload(values) for name, values in rows.items()}
        frame = renderer.render(held, renderer.pack(camera), camera.width, camera.height, 0)
        images.append(frame.image.download())
    assert np.array_equal(*images) and images[0].std() > 0.01


def run_with(folder, gaussians, **options):
    run = RunFolder.create(folder)
    run.write_options({"scene": str(CITY), "downscale": 8.0, **options})
    run.save_model(gaussians, [5e6, 0, 0], comments=("SplatRenderMode: default",))
    return run


def test_export_leaves_out_what_carries_nothing(tmp_path, city):
    gaussians = sampled(city, 300, 3)
    gaussians.sh_rest[:] = np.random.default_rng(0).normal(size=gaussians.sh_rest.shape)
    gaussians = faint(gaussians, [7, 9], -20)
    run, output = run_with(tmp_path / "run", gaussians), tmp_path / "model.ply"
    result = clsplat_("export", run.path, "-o", output, "--sh-degree", 2)
    assert result.exit_code == 0, result.output
    assert "298 gaussians, spherical harmonics to degree 2; left out as inv" in result.output
    whole, part = read_ply(run.path / "point_cloud.ply"), read_ply(output)
    keep = alive(gaussians)
    assert part.sh_degree == 2 and b"SplatRenderMode: default" in output.read_bytes()[:400]
    for name, values in whole.rows.items():
        expected = values[keep][:, :8] if name == "sh_rest" else values[keep]
        assert np.array_equal(part.rows[name], expected), name
    before = output.read_bytes()
    result = clsplat_("export", run.path, "-o", output)
    assert result.exit_code == 2 and "exists already; replace it with --over" in result.stderr
    assert output.read_bytes() == before
    export = partial(clsplat_, "export", run.path, "-o", output, "--overwrite")
    assert export().exit_code == 0
    assert (read_ply(output).sh_degree, read_ply(output).count) == (3, 298)
    assert export("--sh-degree", 0).exit_code == 0 and read_ply(output).sh_degree == 0
