"""The public Python API: what `import clsplat` offers, compared with the command line."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import clsplat
from clsplat.evaluation.views import render_view
from clsplat.io.runs.run import RunFolder
from clsplat.options import resolve
from clsplat.rendering.slabs import open_model
from clsplat.training import run as trainings
from tests.data.tiny_training import CITY, ROOT, model_digest

EXAMPLES = ROOT / "docs" / "examples"
SMALL_VALUES = {"iterations": 40, "downscale": 8, "schedule": "constant", "exposure": "off", "eval_every": 20}
SMALL = clsplat.TrainOptions(**SMALL_VALUES)
CAMERA = clsplat.Camera.looking_at((0, 0, 0), (0.2, -3, 0.4), width=40, height=28)


@pytest.fixture(scope="module")
def scene():
    return clsplat.Scene.read(CITY)


@pytest.fixture(scope="module")
def run(scene, item_device, tmp_path_factory):
    """Not to be changed."""
    return clsplat.train(scene, SMALL, output=tmp_path_factory.mktemp("api") / "run", device=item_device)


def blob(count=30, degree=1):
    rng = np.random.default_rng(1)
    model = clsplat.Gaussians.from_points(
        rng.uniform(-1, 1, (count, 3)), rng.integers(0, 256, (count, 3), np.uint8), degree
    )
    model.rows["sh_rest"][:] = rng.normal(0, 0.1, model.sh_rest.shape)
    model.rows["log_scales"] += rng.normal(0, 0.3, (count, 3)).astype(np.float32)
    return model


@pytest.mark.slow
def test_its_names_are_found_and_nothing_is_imported_before():
    code = (
        "import sys, clsplat\nassert not {'numpy', 'pyopencl', 'scipy'} & set(sys.modules), 'too early'\n"
        "assert set(clsplat.__all__) <= set(dir(clsplat))\n"
        "assert all(getattr(clsplat, name).__doc__ for name in clsplat.__all__)\n"
        "from clsplat import *\nassert callable(render) and callable(train) and callable(evaluate)\n"
        "import clsplat.rendering.blend, clsplat.training.loop, clsplat.evaluation.views\n"
        "assert callable(clsplat.render) and callable(clsplat.train)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        clsplat.rendr  # noqa: B018


def test_what_is_public_says_what_it_takes():
    """Every argument of every public function and method has a line in its docstring."""
    import inspect

    for name in clsplat.__all__:
        thing = getattr(clsplat, name)
        functions = (
            [thing]
            if inspect.isfunction(thing)
            else [
                member
                for key, member in vars(thing).items()
                if not key.startswith("_") and callable(getattr(member, "__func__", member))
            ]
        )
        for function in functions:
            function = getattr(function, "__func__", function)
            hints, text = inspect.signature(function), inspect.getdoc(function)
            if thing in (clsplat.Part, clsplat.Schedule):  # whose methods have arguments in common
                text += inspect.getdoc(thing)
            assert text and hints.return_annotation is not inspect.Signature.empty, function
            for argument in hints.parameters.values():
                if argument.name not in ("self", "cls"):
                    assert argument.annotation is not inspect.Parameter.empty, (function, argument)
                    assert argument.name in text, (function, argument)


def test_a_render_is_what_evaluations_see(run, scene, item_device):
    camera = scene.reduced(8).views[0].camera
    image = clsplat.render(run.model, camera, device=item_device, near=scene.near_plane)
    opened, rows = open_model(item_device, run.model, scene.near_plane)
    assert image.dtype == np.float32 and image.shape == (camera.height, camera.width, 3)
    assert np.array_equal(np.clip(image, 0, 1), render_view(opened, rows, 3, camera))


def test_the_name_of_a_device_is_no_device(scene, tmp_path):
    for call in (
        lambda: clsplat.render(blob(), CAMERA, device="cpu"),
        lambda: clsplat.Renderer(blob(), "cpu"),
        lambda: clsplat.evaluate(blob(), scene, device="cpu"),
        lambda: clsplat.train(scene, output=tmp_path / "run", device="cpu"),
    ):
        with pytest.raises(clsplat.ClsplatError, match=r"give clsplat.Device\('cpu'\)"):
            call()
    assert not (tmp_path / "run").exists()


def test_model_and_camera_may_have_other_origins(run, scene, item_device):
    camera, model = scene.reduced(8).views[0].camera, run.model
    assert np.array_equal(camera.offset, scene.offset) and scene.offset.any()
    assert np.allclose(model.offset, scene.offset)
    image = clsplat.render(model, camera, device=item_device)
    moved = clsplat.render(model.moved((0, 0, 0)), camera, device=item_device)
    also = clsplat.render(model, camera.shifted((1, 2, 3)), device=item_device)
    assert np.abs(moved - image).max() < 0.02 and np.abs(also - image).max() < 0.02
    assert np.abs(image - image.mean()).max() > 0.2, "it shows something"
    elsewhere = clsplat.render(model.located(model.offset + 1), camera, device=item_device)
    assert np.abs(elsewhere - image).max() > 0.1


def test_depth_is_the_distance_of_what_is_seen(item_device):
    model = clsplat.Gaussians.from_points(np.array([(0, 0, 0), (0, 0, 0.01)]), np.full((2, 3), 255, np.uint8), 0)
    model.rows["log_scales"][:] = np.log(0.3)
    camera = clsplat.Camera.looking_at((0, 0, 0), (0, -5, 0), width=32, height=32)
    image, depth = clsplat.render(model, camera, device=item_device, depth=True)
    assert depth[16, 16] == pytest.approx(5, rel=1e-3) and depth[0, 0] == 0
    assert image[16, 16].min() > image[0, 0].max() == 0
    behind = clsplat.render(model, camera, device=item_device, background=(0.1, 0.2, 0.3))
    assert np.allclose(behind[0, 0], (0.1, 0.2, 0.3))


def test_a_batch_is_its_frames(item_device):
    """Also where a frame needs far more room than those before it, and in other sizes."""
    far, near = (
        clsplat.Camera.looking_at((0, 0, 0), (0.2, -distance, 0.4), width=40, height=28) for distance in (60, 2)
    )
    cameras = [far, far, near, *[CAMERA] * 7, CAMERA.resized(64, 48), near]
    frames = clsplat.render(blob(), cameras=iter(cameras), device=item_device, depth=True)
    assert len(frames) == len(cameras)
    for camera, (image, depth) in zip(cameras, frames):
        expected = clsplat.render(blob(), camera, device=item_device, depth=True)
        assert np.array_equal(image, expected[0]) and np.array_equal(depth, expected[1])
    assert clsplat.render(blob(), cameras=[], device=item_device) == []


def test_features_are_blended_like_colours_and_have_gradients(item_device):
    model, rng = blob(), np.random.default_rng(3)
    renderer = clsplat.Renderer(model, item_device)
    features = rng.normal(size=(30, 8)).astype(np.float32)
    frame = renderer.forward(CAMERA, features=features)
    assert frame.image.shape == (28, 40, 8) and frame._repr_png_().startswith(b"\x89PNG")
    constant = renderer.forward(CAMERA, features=np.ones((30, 1))).image[..., 0]
    assert np.allclose(constant, 1 - frame.transmittance, atol=1e-5)
    weights = rng.normal(size=frame.image.shape)
    gradient = renderer.backward(frame, weights, pose=True)
    assert gradient["turn"].any() and gradient["features"].shape == (30, 8)
    # the image is linear in the features
    assert (gradient["features"] * features).sum() == pytest.approx((weights * frame.image).sum(), rel=1e-3)
    for wrong in (np.zeros((29, 8)), np.zeros((30, 17)), np.zeros(30), "abc"):
        with pytest.raises(clsplat.ClsplatError, match="features: "):
            renderer.forward(CAMERA, features=wrong)


@pytest.mark.slow  # double-precision kernels take long to compile
@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.one_in(3)
def test_backward_is_the_derivative_of_forward(double_device, depth):
    model = blob(3)  # each covers the whole image, for its border would be a step
    model.rows["log_scales"][:] = np.log((2.0, 1.5, 1.8))
    model.rows["positions"] *= 0.2
    model.rows["opacity_logits"][:] = (-0.5, 0, 0.5)
    renderer = clsplat.Renderer(model, double_device)
    frame = renderer.forward(CAMERA, depth=depth)
    rng = np.random.default_rng(2)
    weights = rng.normal(size=frame.image.shape)
    by_depth = rng.normal(size=weights.shape[:2]) if depth else None
    gradients = renderer.backward(frame, weights, by_depth, by_depth, pose=True)

    def loss(name, step):
        camera = CAMERA
        if name in ("turn", "shift"):
            camera = CAMERA.moved(**{"turn": np.zeros(3), "shift": np.zeros(3), name: step * direction[name]})
        else:
            renderer.update(**{name: model.rows[name] + step * direction[name]})
        seen = renderer.forward(camera, depth=depth)
        renderer.update(**model.rows)
        return (weights * seen.image).sum() + (0 if not depth else (by_depth * (seen.depth + seen.transmittance)).sum())

    direction = {name: rng.normal(size=values.shape) for name, values in gradients.items()}
    for name, values in gradients.items():
        assert values.dtype == np.float32 and values.shape == (model.rows[name].shape if name in model.rows else (3,))
        step = 2e-3  # long, for images come as float32
        slope = (loss(name, step) - loss(name, -step)) / (2 * step)
        expected = (values * direction[name]).sum()
        scale = np.sqrt((values**2 * direction[name] ** 2).sum())
        assert abs(slope - expected) < 3e-3 * scale + 1e-4, name


def test_parameters_are_replaced_and_read_back(item_device):
    renderer = clsplat.Renderer(blob(), item_device)
    before = renderer.forward(CAMERA).image
    renderer.update(positions=np.full((30, 3), 100.0))
    assert not renderer.forward(CAMERA).image.any() and before.any()
    assert renderer.forward(CAMERA).transmittance.min() == 1
    assert (renderer.download().positions == 100).all()

    class Exporting:  # as tensors of other libraries do
        def __init__(self, values):
            self.values = values

        def __dlpack__(self, **how):
            return self.values.__dlpack__(**how)

        def __dlpack_device__(self):
            return self.values.__dlpack_device__()

    renderer.update(positions=Exporting(blob().positions))
    assert np.array_equal(renderer.forward(CAMERA).image, before)


@pytest.mark.parametrize(
    "wrong, words",
    [
        (lambda r: r.update(place=np.zeros(3)), "place: not a field"),
        (lambda r: r.update(positions=np.zeros((3, 3))), r"\(3, 3\), not \(30, 3\)"),
        (lambda r: r.backward(r.forward(CAMERA), np.zeros((28, 40))), "grad_image"),
        (lambda r: r.backward(r.forward(CAMERA), np.zeros((28, 40, 3)), np.zeros((28, 40))), "depth=True"),
    ],
)
def test_what_does_not_fit_is_said(item_device, wrong, words):
    with pytest.raises(clsplat.ClsplatError, match=words):
        wrong(clsplat.Renderer(blob(), item_device))


def test_training_is_that_of_the_command_line(run, scene, item_device, tmp_path):
    same = RunFolder.create(tmp_path / "run")
    trainings.train(scene, resolve({}, SMALL_VALUES), item_device, same)
    assert (run.path / "point_cloud.ply").read_bytes() == (same.path / "point_cloud.ply").read_bytes()
    assert run.is_finished and run.options.iterations == 40 and len(run.metrics) > 2
    assert clsplat.Run.open(run.path).model.count == run.model.count


@pytest.mark.slow
def test_callbacks_see_every_step_and_may_stop_it(run, scene, item_device, tmp_path):
    seen = []

    def stop(record):
        seen.append(record)
        if record["event"] == "step" and record["iteration"] == 4:
            raise clsplat.StopTraining

    stopped = clsplat.train(scene, SMALL, output=tmp_path / "run", device=item_device, callbacks=[stop])
    steps = [record for record in seen if record["event"] == "step"]
    assert [record["iteration"] for record in steps] == [1, 2, 3, 4]
    assert all(0 < record["loss"] < 1 and record["gaussians"] == 4400 for record in steps)
    assert not stopped.is_finished and stopped.model.count == 4400
    assert np.allclose(stopped.model.offset, scene.offset)
    with pytest.raises(clsplat.ClsplatError, match="no finished model"):
        stopped.evaluate(item_device)
    between = clsplat.evaluate(stopped.model, scene.reduced(8), device=item_device)
    stopped.resume(device=item_device)
    assert stopped.is_finished and model_digest(stopped) == model_digest(run)
    assert stopped.evaluate(item_device).psnr > between.psnr


def test_scores_are_those_of_the_run(run, item_device):
    ours, theirs = clsplat.evaluate(run.model, run.scene(), device=item_device), run.evaluate(item_device)
    assert ours.views == theirs.views == 4 and ours.psnr == pytest.approx(theirs.psnr, abs=1e-6)
    assert ours.per_view[0]["name"] == "000.jpg"


def test_models_come_back_from_files(tmp_path):
    model = blob().located((5e5, 4e6, 100))
    model.save(tmp_path / "model.ply")
    again = clsplat.Gaussians.load(tmp_path / "model.ply")
    assert np.abs(again.positions - model.positions).max() < 1e-6
    assert np.array_equal(again.offset, model.offset)
    model.save(tmp_path / "model.spz")
    again = clsplat.Gaussians.load(tmp_path / "model.spz")  # in another order
    places = [np.sort(each.positions.astype(float) + each.offset, axis=0) for each in (again, model)]
    assert np.abs(places[0] - places[1]).max() < 1e-3
    with pytest.raises(clsplat.ClsplatError, match="model.obj"):
        model.save(tmp_path / "model.obj")
    with pytest.raises(clsplat.ClsplatError, match="none.ply"):
        clsplat.Gaussians.load(tmp_path / "none.ply")


@pytest.mark.parametrize(
    "wrong, words",
    [
        (lambda: clsplat.Device("no such device"), "no device matches"),
        (lambda: clsplat.Device(form="itme"), "itme"),
        (lambda: clsplat.Device(99), "99"),
        (lambda: clsplat.Scene.read("no/such/folder"), "no such scene"),
        (lambda: clsplat.TrainOptions(iteratons=3), "iteratons"),
        (lambda: clsplat.train("no/such/folder"), "no such scene"),
        (lambda: clsplat.Run.open("no/such/folder"), "no/such/folder"),
        (lambda: clsplat.Camera.looking_at((0, 0, 0), (0, 0, 3)), "another `up`"),
    ],
)
def test_mistakes_are_one_line(wrong, words):
    with pytest.raises(clsplat.ClsplatError, match=words) as caught:
        wrong()
    assert "\n" not in str(caught.value)


def test_objects_show_themselves_in_notebooks(run, scene, item_device):
    assert "32, 320 x 240 pixels" in scene._repr_html_() and "4,400 points" in repr(scene)
    assert "PSNR and SSIM over training" in run._repr_html_() and "finished" in repr(run)
    frame = clsplat.Renderer(blob(), item_device).forward(CAMERA)
    assert frame._repr_png_().startswith(b"\x89PNG")
    assert "dB" in run.evaluate(item_device)._repr_html_()
    assert "30, SH degree 1" in repr(blob()) and "30 gaussians" in blob()._repr_html_()
    assert "data:image/jpeg" in scene.views[0]._repr_html_()


@pytest.mark.slow
def test_a_plan_is_that_of_the_training(run, scene, item_device):
    forecast = clsplat.plan(scene, SMALL, device=item_device)
    assert forecast.steps == 40 and 0 < forecast.seconds < 600
    record = run.metrics[-1]
    assert forecast.gaussians == record["gaussians"] and 2e6 < forecast.memory_bytes < 1e9
    assert "requested" in forecast.reasons["exposure"] and "40" in forecast._repr_html_()


def test_what_public_objects_make_is_public(run, scene):
    """So that its pixels can be read, and it can be saved and shown."""
    for made in (scene, scene.reduced(2), scene.part([0, 3]).normalised(), run.scene()):
        views = (*made.views, *made.split(8)[1])
        assert type(made) is clsplat.Scene and {type(view) for view in views} == {clsplat.View}
    assert scene.reduced(8).views[0].photo().shape == (30, 40, 3)
    for model in (run.model, blob().moved((1, 2, 3)).scaled(2).with_sh_degree(0)):
        assert type(model) is clsplat.Gaussians


def test_a_camera_looks_at_its_target():
    pixels, depths = CAMERA.project([(0, 0, 0), (0, 0, 0.1)])
    assert np.allclose(pixels[0], (20, 14)) and pixels[1, 1] < pixels[0, 1], "up is upwards"
    assert depths[0] == pytest.approx(np.sqrt(0.04 + 9 + 0.16))
    assert np.allclose(CAMERA.rotation @ CAMERA.rotation.T, np.eye(3))
    assert np.linalg.det(CAMERA.rotation) == pytest.approx(1)


def ran(name, *words):
    return subprocess.run(
        [sys.executable, EXAMPLES / name, *map(str, words)],
        check=True,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
    ).stdout


@pytest.mark.slow
def test_example_of_rendering(run, tmp_path):
    said = ran("render_a_model.py", CITY, run.path / "point_cloud.ply", tmp_path / "image.npy")
    assert "320 x 240 pixels" in said and np.load(tmp_path / "image.npy").shape == (240, 320, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, least, most", [("fit_an_image.py", 27, 99), ("fit_a_pose.py", 0, 0.02), ("fit_features.py", 0.98, 1)]
)
@pytest.mark.one_in(3)
def test_examples_of_fitting_end_well(name, least, most):
    first, *_, last = (float(line.split()[2]) for line in ran(name).splitlines())
    assert least < last <= most and first != last


@pytest.mark.slow
def test_example_of_steps(tmp_path):
    said = ran("train_step_by_step.py", CITY, tmp_path / "run")
    assert "not finished" in said and "step 50: loss" in said


@pytest.mark.slow
def test_example_of_arrays(tmp_path):
    said = ran("photos_from_arrays.py", tmp_path / "run")
    assert float(said.partition("PSNR ")[2].split()[0]) > 24 and "3 held-out" in said


@pytest.mark.slow
def test_example_of_torch(tmp_path):
    pytest.importorskip("torch", reason="torch is not installed; it is not a dependency")
    assert float(ran("torch_autograd.py").split()[1]) < 0.02


def test_a_damaged_checkpoint_is_one_line(scene, item_device, tmp_path):
    stopped = clsplat.train(scene, replace(SMALL, stop_at=2), output=tmp_path / "run", device=item_device)
    folder = RunFolder.open(stopped.path)
    arrays, state = folder.load_checkpoint()
    folder.save_checkpoint({k: v for k, v in arrays.items() if k != "row.positions"}, state)
    with pytest.raises(clsplat.ClsplatError, match="lacks a good 'row.positions'"):
        stopped.model  # noqa: B018
    folder.save_checkpoint(arrays, state)
    record = folder.read_options()
    folder.write_options({**record, "extent": "wide"})
    with pytest.raises(clsplat.ClsplatError, match="options.json is damaged"):
        stopped.model  # noqa: B018
