"""A block whose surroundings are drawn as layers: what views show, training, resume, memory."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.city.cut import takes_layers
from clsplat.errors import InputError
from clsplat.estimate.cost import ViewMemory
from clsplat.evaluation.metrics import psnr
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.models.ply import write_ply
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.partition.blocks import block_start
from clsplat.rendering.slabs import open_model
from clsplat.training import layers, loop
from clsplat.training.layers import compared_bytes
from clsplat.training.photos import Photos
from clsplat.training.start.prepare import prepare
from tests.city.test_block import region_of
from tests.data.tiny_training import CITY, STILL, model_digest, options_of, resumed, trained
from tests.training.test_launches import of_a_replay

SHORT = {"iterations": 60, "densify_from": 10, "densify_every": 10, "densify_until": 60,
         "test_every": 0, "sh_degree": 1, "sh_every": 1}


@pytest.fixture(scope="module")
def city():
    return read_scene(CITY)


@pytest.fixture(scope="module")
def block(city, tmp_path_factory):
    """(block_start, the scene with its surroundings, options that start from the block's own)."""
    folder = tmp_path_factory.mktemp("block")
    region = region_of(city, 0.4, margin=0.05)
    given = Gaussians.from_points(city.points, city.colours, 1)
    given.rows["opacity_logits"][:] = 1.0
    start = block_start(given, city, region, city.reduced(4).views, as_layers=lambda around: True)
    write_ply(folder / "initial.ply", start.gaussians, city.offset)
    write_ply(folder / "surroundings.ply", start.around, city.offset)
    scene = replace(city, region=region, surroundings=folder / "surroundings.ply")
    return start, scene, {"init": str(folder / "initial.ply"), **SHORT}


def test_all_gaussians_are_in_the_block_or_around_it(block, city):
    start, scene, _ = block
    every = block_start(Gaussians.from_points(city.points, city.colours, 1), city, scene.region,
                        city.reduced(4).views)
    assert every.around is None and (every.own, every.margin) == (start.own, start.margin)
    assert start.gaussians.count + start.around.count == every.gaussians.count
    assert start.surroundings == start.gaussians.count - start.own - start.margin
    assert 0 < start.surroundings < every.surroundings == start.surroundings + start.around.count
    reached = replace(city, region=scene.region).reached(start.around.positions)
    assert not reached.any()


def test_one_gaussian_in_front_is_found(block, monkeypatch):
    """Wherever it stands among those in front that the view does not show."""
    _, scene, _ = block
    monkeypatch.setattr(layers, "LOOKED_AT", 3)
    view = scene.views[0]
    hidden, shown = (view.camera.position + depth * view.camera.rotation[2] for depth in (-5, 5))
    behind = np.zeros(10, bool)
    for place in range(10):
        around = Gaussians.from_points(np.linspace(hidden, hidden + 0.1, 10),
                                       np.zeros((10, 3), np.uint8), 0)
        around.rows["log_scales"][:] = np.log(0.01)
        assert not layers.Front(around, 0.01).is_shown(view, behind)
        around.rows["positions"][place] = shown
        front = layers.Front(around, 0.01)
        assert front.is_shown(view, behind)
        assert not front.is_shown(view, np.arange(10) == place), "it is behind"


def test_a_block_takes_whichever_is_smaller(block):
    """Layers of 7 bytes a pixel, and the image exposed and its gradient, or gaussians with
    moments; what decided is recorded."""
    start, scene, _ = block
    small, views = scene.reduced(5), len(scene.views)
    pixels, sums = [view.camera.width * view.camera.height for view in small.views], 4 * 12 * 8
    drawn, gaussians = compared_bytes(small, start.around, 1, exposes=True)
    assert 3 * sum(pixels) < drawn <= 7 * sum(pixels)
    assert gaussians == 3 * 4 * (3 + 3 + 4 + 1 + 3 + 9) * start.around.count
    exposed = compared_bytes(small, start.around, 1, exposes=False)[0] - drawn
    assert 24 * max(pixels) < exposed < 24 * max(pixels) + sums * views
    decided = {"sh_degree": 1, "exposure": "off"}
    for chosen, compared in ((small, {}), (scene, {})):
        taken = takes_layers("auto", chosen, decided, compared, start.around)
        assert taken == (compared["layers_bytes"] < compared["gaussians_bytes"])
        assert taken == (chosen is small)
        assert not takes_layers("gaussians", chosen, decided, {}, start.around)
        assert takes_layers("layers", chosen, decided, {}, start.around)
    assert block_start(Gaussians.from_points(scene.points, scene.colours, 1), scene, scene.region,
                       small.views, lambda around: False).around is None


def shown(device, gaussians, scene, camera, background=(0.0, 0.0, 0.0)):
    """Image and transmittance, float64[3, H, W] and [H, W]."""
    renderer, rows = open_model(device, gaussians, scene.near_plane, False, background)
    blended = renderer.render(rows, renderer.pack(camera), camera.width, camera.height,
                              gaussians.sh_degree).blended
    return (array.download().astype(float) for array in (blended.image, blended.transmittance))


def test_block_and_layers_look_as_the_whole(item_device, block):
    """More than 32 dB in every view, also where something is in front."""
    start, scene, options = block
    background = (0.2, 0.4, 0.6)
    options = options_of(**options, background=background)
    rows = {field.name: np.concatenate([part.rows[field.name] for part in (
        start.gaussians, start.around)]) for field in LEARNED}
    found, without, fronts = [], [], 0
    views = scene.reduced(4).views[::4]
    for view, planes in zip(views, layers.drawn_layers(
            item_device, scene, start.around, views, scene.near_plane, options)):
        planes = planes / 255
        whole, _ = shown(item_device, Gaussians(rows, 1), scene, view.camera, background)
        own, clear = shown(item_device, start.gaussians, scene, view.camera)
        behind = own + clear * planes[:3]
        composed = planes[3:6] + planes[6] * behind if len(planes) == 7 else behind
        fronts += len(planes) == 7
        found.append(psnr(composed, whole, None))
        without.append(psnr(behind, whole, None))
    assert min(found) > 32
    assert 1 < fronts < len(found) and np.mean(found) > np.mean(without) + 1


def launched(device, folder, scene, **options):
    """The launches of a replayed step."""
    training = loop.Training(scene, options_of(**{**options, **STILL}), device,
                             RunFolder.create(folder))
    found = []
    with training.resumable():
        training.clock.restart()
        while not training.finished():
            before = device.launches, device.waits, device.allocations
            training.take_step()
            found.append(tuple(np.subtract(
                (device.launches, device.waits, device.allocations), before).tolist()))
    return of_a_replay(found)


@pytest.mark.slow
def test_a_step_with_layers_has_no_launch_more(item_device, city, block, tmp_path):
    """Than one that exposes the image; without exposures none learns."""
    _, scene, options = block
    options = {**options, "iterations": 20, "downscale": 16.0}
    plain = launched(item_device, tmp_path / "plain", replace(city, region=scene.region),
                     **options, exposure="on")
    assert launched(item_device, tmp_path / "off", scene, **options) == plain - 1


@pytest.mark.slow
def test_a_stopped_run_ends_in_the_same_bytes_from_memory_or_a_file(item_device, block, tmp_path,
                                                                    monkeypatch):
    start, scene, options = block
    run = trained(tmp_path / "run", scene, item_device, **options)
    model = run.load_model()
    assert model.count > start.gaussians.count and not run.load_exposures()
    monkeypatch.setattr(Photos, "spare_bytes", 0.0)
    used = []
    monkeypatch.setattr(layers.tempfile, "TemporaryFile", lambda make=layers.tempfile.TemporaryFile:
                        used.append(make()) or used[0])
    other = trained(tmp_path / "other", scene, item_device, **options, stop_at=35)
    monkeypatch.undo()
    assert used
    assert model_digest(resumed(other, scene, item_device, **options)) == model_digest(run)


@pytest.mark.slow
def test_a_disk_without_space_is_named(item_device, block, tmp_path, monkeypatch):
    _, scene, options = block

    def full():
        raise OSError(28, "No space left on device")
    monkeypatch.setattr(Photos, "spare_bytes", 0.0)
    monkeypatch.setattr(layers.tempfile, "TemporaryFile", full)
    with pytest.raises(InputError, match=r"No space left on device\); make space there"):
        trained(tmp_path / "run", scene, item_device, **options)


@pytest.mark.slow
def test_memory_is_foretold(item_device, block):
    """Exactly here, as all that is in front shows."""
    _, scene, options = block
    prepared = prepare(scene, options_of(**options), item_device)
    photos = Photos(item_device, prepared.train_views)
    drawn = layers.Layers(item_device, prepared.scene, prepared.surroundings, prepared.near,
                          prepared.options)
    drawn.use(1.0, photos.views, photos.spare_bytes)
    photos.close()
    memory = ViewMemory(item_device, prepared, 1.0)
    assert memory.nbytes - memory.photos == sum(
        drawn[index].nbytes for index in range(len(photos.views)))
