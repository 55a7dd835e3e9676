"""What moved is left out of photos, and what is only not learned yet is not."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.photos.images import write_image
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import View
from clsplat.training.parts import outlier_masks
from clsplat.training.parts.outlier_masks import ObservedView, _outliers, _residuals, find_outliers, resampled, spread
from clsplat.training.photos import Photos, photo_array
from tests.data.tiny_training import CITY, model_digest, records, resumed, trained

WIDTH, HEIGHT, VIEWS = 70, 50, 5


def test_differences_of_fine_texture_cancel():
    image = np.full((3, 16, 16), 0.4)
    view = ObservedView(None, np.full((3, 16, 16), 102, np.uint8), np.ones((16, 16), bool))
    image[:, ::2] += 0.2
    image[:, 1::2] -= 0.2
    image[:, 8:, 8:] += 0.1
    found = _residuals(image, view)
    assert np.allclose(found[:2], 0) and np.allclose(found[2:, 2:], 0.1)
    image[0, 0, 0] = np.nan
    assert found.shape == (4, 4) and _residuals(image, view)[0, 0] == 0


def test_outliers_are_coherent_seen_by_others_and_few():
    residual, expected = np.full((20, 30), 0.01), np.full((20, 30), 0.01)
    served = np.ones((20, 30), bool)
    residual[5:9, 5:9] = 0.3  # moved
    residual[12:16, 5:9] = expected[12:16, 5:9] = 0.3  # learned nowhere
    residual[5:9, 20:24], served[5:9, 20:24] = 0.3, False  # seen by this view only
    residual[12:19:3, 15:29:3] = 0.3  # scattered, as fine texture is
    found = _outliers(residual, expected, served, 0.01)
    assert found[4:10, 4:10].sum() > 25 and found[5:9, 5:9].all()
    found[4:10, 4:10] = False
    assert not found.any()
    expected[:] = 0.01  # a whole photo differs
    residual = np.linspace(0.3, 0.9, 600).reshape(20, 30)
    found = _outliers(residual, expected, np.ones_like(served), 0.01)
    assert 0.1 < found.mean() <= outlier_masks.MAX_MASKED_SHARE


def test_cells_at_another_size():
    cells = np.zeros((10, 12), bool)
    cells[2:6, 4:8] = True
    finer = resampled(cells, 80, 96)
    assert finer.shape == (20, 24) and np.array_equal(np.argwhere(finer)[[0, -1]], [[4, 8], [11, 15]])
    assert np.array_equal(resampled(finer, 39, 47), cells)


@pytest.fixture
def wall(float_device):
    """A renderer, rows, and views of a coloured wall whose photos are their renders."""
    rng = np.random.default_rng(1)
    across, down = np.meshgrid(np.linspace(-5, 5, 60), np.linspace(-4, 4, 48))
    points = np.stack([across.ravel(), down.ravel(), np.full(across.size, 5.0)], axis=1)
    gaussians = Gaussians.from_points(points, rng.integers(60, 200, (len(points), 3)), 0)
    rows = {field.name: gaussians.rows[field.name] for field in LEARNED}
    rows["opacity_logits"] = np.full_like(rows["opacity_logits"], 3)
    renderer, device = Renderer(float_device, 0, 0.01), float_device
    rows = {name: device.upload(values) for name, values in rows.items()}
    views = []
    for index in range(VIEWS):
        shift = np.array([0.4 * (index - VIEWS // 2), 0.1 * (-1) ** index, 0])
        camera = renderer.pack(Camera(WIDTH, HEIGHT, (60.0, 60.0), (35.0, 25.0), np.eye(3), shift))
        image = renderer.render(rows, camera, WIDTH, HEIGHT, 0).image.download()
        noisy = image + rng.normal(0, 0.02, image.shape)
        views.append(
            ObservedView(camera, np.round(noisy.clip(0, 1) * 255).astype(np.uint8), np.ones((HEIGHT, WIDTH), bool))
        )
    return renderer, rows, views


def found(wall):
    renderer, rows, views = wall
    return find_outliers(renderer, rows, 0, lambda: iter(views))


@pytest.mark.one_in(2)
def test_what_is_in_one_photo_only_is_found(wall):
    views = wall[2]
    assert not np.any(found(wall))
    views[2].photo[:, 12:28, 20:44] = np.array([250, 30, 200])[:, None, None]
    views[4].photo[:, 12:28, 20:44] = 255
    views[4].valid[12:28, 20:44] = False  # the photo's own mask
    cells = found(wall)
    assert not any(each.any() for index, each in enumerate(cells) if index != 2)
    pixels = spread(cells[2], HEIGHT, WIDTH)
    assert pixels[12:28, 20:44].all() and pixels.sum() < 2 * 16 * 24


def test_what_few_photos_show_is_not(wall):
    renderer, rows, views = wall
    views[2].photo[:, 12:28, 20:44] = np.array([250, 30, 200])[:, None, None]
    assert found(wall)[2].any()
    assert not np.any(found((renderer, rows, views[: outlier_masks.MIN_OTHER_VIEWS])))


def test_what_no_photo_agrees_with_is_not(wall):
    """All photos differ from the model at the same place of the wall: it is not learned yet."""
    renderer, rows, views = wall
    wrong = rows["sh_constant"].download()
    centre = np.abs(rows["positions"].download()[:, :2]).max(axis=1) < 0.8
    wrong[centre] = 1.5
    assert centre.sum() > 20
    assert not np.any(found((renderer, {**rows, "sh_constant": renderer.device.upload(wrong)}, views)))


def test_a_gaussian_that_is_not_finite_hides_nothing(wall):
    renderer, rows, views = wall
    poisoned = rows["sh_constant"].download()
    poisoned[len(poisoned) // 2] = np.nan
    assert not np.any(found((renderer, {**rows, "sh_constant": renderer.device.upload(poisoned)}, views)))


@pytest.mark.parametrize("budget", [None, 0], ids=["resident", "streaming"])
def test_photos_leave_out_cells_at_every_level(item_device, tmp_path, budget):
    camera = Camera(48, 40, (20.0, 20.0), (24.0, 20.0), np.eye(3), np.zeros(3))
    views, rng = [], np.random.default_rng(0)
    for index in range(2):
        write_image(tmp_path / f"{index}.png", rng.integers(0, 256, (40, 48, 3), np.uint8))
        views.append(View(f"{index}.png", camera, tmp_path / f"{index}.png", weighed=True))
    mask = np.full((40, 48, 3), 255, np.uint8)
    mask[:8] = 0
    write_image(tmp_path / "mask.png", mask)
    views[1] = replace(views[1], mask=tmp_path / "mask.png")
    photos = Photos(item_device, views, (2.0, 1.0), budget)
    assert photos[0].shape == photo_array(photos.views[0]).shape == (4, 20, 24)
    assert photos[0].download()[3].all() and not photos[1].download()[3, :4].any()
    cells = [np.zeros((5, 6), bool), np.zeros((5, 6), bool)]
    cells[0][1, 2] = cells[1][3, 5] = True
    photos.ignore(cells)
    photos.use(1.0)
    for index, (y, x) in enumerate([(8, 16), (24, 40)]):
        expected = np.full((40, 48), 255)
        expected[: 8 * index] = 0
        assert np.array_equal(photos.unweighed(index)[3], expected)
        expected[y : y + 8, x : x + 8] = 0
        assert np.array_equal(photos[index].download()[3], expected)
    photos.ignore([np.zeros((10, 12), bool)] * 2)
    assert photos[0].download()[3].all()
    photos.close()


@pytest.fixture
def often(monkeypatch):
    """Outliers are looked for every 28 steps, and found though nothing moves."""
    for name, value in {"MIN_EPOCHS": 1, "FACTOR": 0.8, "FLOOR": 0.5, "MIN_OTHER_VIEWS": 0}.items():
        monkeypatch.setattr(outlier_masks, name, value)


@pytest.mark.slow
def test_a_resumed_run_ends_in_the_same_bytes(item_device, tmp_path, often):
    city, options = read_scene(CITY), {"iterations": 100, "reset_every": 0}
    whole = trained(tmp_path / "whole", city, item_device, robust="on", **options)
    shares = [record["share"] for record in records(whole, "robust")]
    assert len(shares) == 3 and 0.01 < max(shares) <= outlier_masks.MAX_MASKED_SHARE
    part = trained(tmp_path / "part", city, item_device, robust="on", stop_at=70, **options)
    assert "robust.cells" in RunFolder.open(part.path).load_checkpoint()[0]
    again = resumed(part, city, item_device, robust="on", **options)
    assert model_digest(again) == model_digest(whole)
    plain = trained(tmp_path / "plain", city, item_device, **options)
    assert model_digest(plain) != model_digest(whole)
