"""The page of a model: what is in it, and that a browser draws what our renderer draws."""

import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest

from clsplat.constants import SH_C0
from clsplat.estimate.trial_steps import sampled
from clsplat.evaluation.metrics import psnr
from clsplat.evaluation.views import render_view
from clsplat.gaussians import Gaussians
from clsplat.io.georeference.files import write_orientation
from clsplat.rendering.slabs import open_model
from clsplat.report import model_page as page_module
from clsplat.report.encode import encoded
from clsplat.report.model_page import Photo, write_page
from tests.apps.browser import answer_of, needs_chromium, picture_of
from tests.apps.test_models import run_with
from tests.estimate.test_plan import city, clsplat_
from tests.refusals import refused

__all__ = ["city"]
PICTURE = 'return page.document.getElementById("picture").toDataURL();'
SHARP = "await until(() => page.viewer && page.viewer.sharp); page.viewer.draw(1);"


def colourful(city, count=3000, degree=3):
    """Gaussians of every shape, turned every way, whose colours depend on the direction."""
    rng = np.random.default_rng(5)
    model = sampled(city, count, degree)
    rows = {name: values.copy() for name, values in model.rows.items()}
    rows["quaternions"] = rng.normal(size=(count, 4)).astype(np.float32)
    rows["log_scales"] += rng.uniform(-4, 0.5, (count, 3)).astype(np.float32)
    rows["opacity_logits"] = rng.normal(1, 2, count).astype(np.float32)
    rows["sh_rest"] = rng.normal(0, 0.1, rows["sh_rest"].shape).astype(np.float32)
    return Gaussians(rows, degree, model.offset)


def whole(model):
    """The bytes of a model that is one cell, and its coding."""
    parts, coding = encoded(model)
    (content,) = parts.values()
    return content, coding


def decoded(content, coding):
    """Rows from what `encoded` returns, as web/unpack.js and web/splat.vert understand it."""
    count, degree = coding["count"], coding["degree"]
    planes = np.frombuffer(zlib.decompress(content, -15), np.uint8).reshape(-1, count)
    planes = planes.astype(np.int64)
    middle, unit, low, size = map(np.array, coding["positions"])
    places = (planes[0:3] << 16 | planes[3:6] << 8 | planes[6:9]).T
    scale_low, scale_size = map(np.array, coding["logScales"])
    colour_low, colour_size = map(np.array, coding["colours"])
    words = planes[16] | planes[17] << 8 | planes[18] << 16 | planes[19] << 24
    others = np.stack([words >> shift & 1023 for shift in (0, 10, 20)], axis=1)
    others = (others / 1023 - 0.5) * np.sqrt(2)
    turns = np.array([np.insert(row, which, np.sqrt(max(0, 1 - row @ row))) for row, which in zip(others, words >> 30)])
    bands = np.repeat(np.arange(1, 4), [9, 15, 21])[: 3 * degree * (degree + 2)]
    reach = np.array([0.0, *coding["harmonics"]])[bands]
    return {
        "positions": middle + unit * np.sinh(low + size * places / (2**24 - 1)),
        "log_scales": scale_low + scale_size * planes[9:12].T / 255,
        "colours": colour_low + colour_size * planes[12:15].T / 255,
        "opacities": planes[15] / 255,
        "turns": turns,
        "sh_rest": ((planes[20:].T - 128) / 127 * reach).reshape(count, -1, 3),
    }


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_bytes_hold_the_model(city, degree):
    model = colourful(city, 500, degree)
    found = decoded(*whole(model))
    order = np.argsort(found["positions"][:, 0])
    mine = np.argsort(model.positions[:, 0])
    near = {name: values[order] for name, values in found.items()}
    assert np.abs(near["positions"] - model.positions[mine]).max() < 1e-6 * np.ptp(model.positions)
    log_scales = np.maximum(model.log_scales[mine], near["log_scales"].min(axis=0))
    assert (log_scales != model.log_scales[mine]).sum() <= 3
    assert np.abs(near["log_scales"] - log_scales).max() < 0.5 / 255 * np.ptp(model.log_scales, axis=0).max() + 1e-6
    colours = 0.5 + SH_C0 * model.sh_constant[mine]
    assert np.quantile(np.abs(near["colours"] - colours), 0.99) < 0.004
    opacities = 1 / (1 + np.exp(-model.opacity_logits[mine].astype(float)))
    assert np.abs(near["opacities"] - opacities).max() <= 0.5001 / 255
    unit = model.quaternions[mine] / np.linalg.norm(model.quaternions[mine], axis=1, keepdims=True)
    assert np.abs((near["turns"] * unit).sum(axis=1)).min() > np.cos(0.002)
    assert near["sh_rest"].shape == (500, (degree + 1) ** 2 - 1, 3)
    errors = np.abs(near["sh_rest"] - model.sh_rest[mine])
    assert not degree or np.quantile(errors, 0.99) < 0.026


def test_a_vanishing_gaussian_costs_the_others_no_precision(city):
    model = colourful(city, 50, 0)
    order, usual = np.argsort(model.positions[:, 0]), np.ptp(model.log_scales)
    model.log_scales[order[7], 1] = -80
    found = decoded(*whole(model))
    errors = np.abs(found["log_scales"][np.argsort(found["positions"][:, 0])] - model.log_scales[order])
    assert np.quantile(errors, 0.97) < 0.6 * usual / 255  # the smallest on each axis are clipped


def test_harmonics_that_are_zero_are_not_written(city):
    model = colourful(city, 50, 3)
    assert encoded(model)[1]["degree"] == 3
    for first, degree in ((8, 2), (3, 1), (0, 0)):
        model.sh_rest[:, first:] = 0
        assert degree == encoded(model)[1]["degree"]


def written(path, city, model, **changes):
    view = city.views[0].camera
    write_page(path, model, view, np.array([0, 0, 1.0]), **{"near": city.near_plane, "title": "a city", **changes})
    return path.read_text("utf-8")


def test_the_page_is_one_file_without_network(tmp_path, city):
    text = written(tmp_path / "page.html", city, colourful(city, 50), title="<b>&</script>")
    assert "default-src 'none'" in text and "connect-src" not in text
    assert not re.search(r"(https?:)?//[a-z]+\.|src=|href=|import[ (]|fetch\(|XMLHttp", text)
    assert "{{" not in text and "<title>&lt;b&gt;&amp;&lt;/script&gt;</title>" in text
    assert 'aria-label="Three-dimensional view of &lt;b&gt;&amp;&lt;/script&gt;"' in text
    assert 'name="viewport" content="width=device-width' in text


def test_the_first_view_is_in_the_frame_of_the_model(tmp_path, city):
    model = colourful(city, 50)
    moved = replace(model, offset=model.offset + [500_000.25, 0, 0])
    camera = city.views[0].camera.shifted([-500_000.25, 0, 0])  # the same camera, original frame
    write_page(tmp_path / "page.html", moved, camera, np.array([0, 0, 1.0]), near=1, title="")
    text = (tmp_path / "page.html").read_text("utf-8")
    record = json.loads(re.search(r'id="model" type="application/json">(.*?)</script>', text)[1])
    expected = camera.position - (moved.offset - camera.offset)
    assert np.allclose(record["position"], expected)
    assert record["up"] == [0, 0, 1] and record["width"] == camera.width


def test_what_cannot_be_a_page_is_refused(tmp_path, city, monkeypatch):
    model = colourful(city, 50)
    empty = replace(model, rows={name: values[:0] for name, values in model.rows.items()})
    refused(lambda: written(tmp_path / "page.html", city, empty), "holds no gaussians")
    monkeypatch.setattr(page_module, "LARGEST_PAGE", 10_000)
    refused(lambda: written(tmp_path / "page.html", city, model), "more than browsers open")
    assert not list(tmp_path.iterdir())


def drawn(folder, city, model, camera, **changes):
    """The picture of a page in Chromium, and ours."""
    camera = replace(camera, offset=model.offset)
    write_page(
        folder / "page.html", model, camera, np.array([0, 0, 1.0]), near=city.near_plane, title="city", **changes
    )
    size = camera.width, camera.height
    text = (folder / "page.html").read_text("utf-8")
    return picture_of(answer_of(folder, text, SHARP + PICTURE, size))


@pytest.mark.slow
@needs_chromium
@pytest.mark.parametrize(
    "degree, changes, least",
    [(3, {}, 45), (3, {"antialiased": True, "background": (0.2, 0.5, 0.9)}, 45), (0, {}, 52)],
    ids=["classic", "antialiased", "no harmonics"],
)
@pytest.mark.one_in(2)
def test_a_browser_draws_what_we_draw(tmp_path, item_device, city, degree, changes, least):
    """Measured: 49.4 dB with harmonics that are noise, and 54.4 without; trained models had 6 dB
    less where each layer is rounded to 8 bits."""
    model = colourful(city, 4000, degree)
    camera = replace(city.views[3].camera.resized(480, 360), centre=(255.0, 170.0))
    shown = drawn(tmp_path, city, model, camera, **changes)
    opened = open_model(item_device, model, city.near_plane, **changes)
    ours = render_view(*opened, degree, camera)
    assert shown.shape == ours.shape and ours.std() > 0.1
    assert psnr(shown, ours) > least
    if degree:
        assert psnr(shown, render_view(*opened, 0, camera)) < 35  # so the harmonics are there


@pytest.mark.slow
@needs_chromium
def test_movement_keeps_the_world_upright(tmp_path, city):
    model = colourful(city, 150)
    model.opacity_logits[:] = 5
    model.log_scales[:] += 3  # something solid to double-click on
    text = written(tmp_path / "page.html", city, model)
    steps = """
      const view = page.viewer, camera = view.camera, surface = view.canvas;
      const upright = () => Math.abs(camera.axes()[0].reduce((sum, x, k) => sum + x * camera.up[k],
                                                             0)).toFixed(4);
      surface.setPointerCapture = () => {};
      const point = (kind, id, x, y) => surface.dispatchEvent(new page.PointerEvent(kind,
        {pointerId: id, clientX: x, clientY: y, buttons: 1, bubbles: true}));
      const first = JSON.stringify(camera.axes()), centre = camera.centre();
      const apart = (a, b) => Math.hypot(...a.map((x, k) => x - b[k])) / camera.distance;
      const found = {};
      point("pointerdown", 1, 100, 100);
      for (let k = 0; k < 100; k++) point("pointermove", 1, 100 + 3 * k, 100 + k % 7);
      found.orbit = apart(camera.centre(), centre) < 1e-3
        && JSON.stringify(camera.axes()) !== first;
      found.upright = upright();
      point("pointerdown", 2, 500, 100);
      const before = camera.distance;
      point("pointermove", 2, 700, 100);
      found.pinch = camera.distance < 0.9 * before;
      point("pointerup", 1, 0, 0);
      point("pointerup", 2, 0, 0);
      const taps = [], picked = view.tools.controls.picked;
      view.tools.controls.picked = (x, y) => taps.push([x, y]);
      for (const length of [100, 3, 0]) { // two drags from one place, then a tap, and a second one
        point("pointerdown", 1, 200, 200);
        if (length) point("pointermove", 1, 200 + length, 200);
        point("pointerup", 1, 0, 0);
        taps.push(length);
      }
      view.tools.controls.picked = picked;
      found.taps = JSON.stringify(taps);
      page.document.getElementById("fly").click();
      const place = camera.position.join();
      point("pointerdown", 1, 100, 100);
      point("pointermove", 1, 150, 160);
      found.look = camera.position.join() === place;
      point("pointerup", 1, 0, 0);
      page.dispatchEvent(new page.KeyboardEvent("keydown", {code: "KeyW"}));
      await until(() => camera.position.join() !== place);
      const key = (kind, code, shiftKey) => page.dispatchEvent(
        new page.KeyboardEvent(kind, {code, shiftKey}));
      const animate = page.requestAnimationFrame;
      page.requestAnimationFrame = () => 0; // a device that needs 300 ms for each frame
      for (let k = 0; k < 3; k++) {
        await new Promise((wake) => setTimeout(wake, 300));
        view.frame(page.performance.now());
      }
      found.coarse = view.detail < 0.6 && view.canvas.width < 400;
      page.requestAnimationFrame = animate;
      view.scheduled = false;
      key("keydown", "ShiftLeft", true);
      found.fast = view.tools.controls.fast;
      key("keyup", "ShiftLeft", false);
      found.fast = found.fast && !view.tools.controls.fast;
      key("keyup", "KeyW", false);
      found.stops = !view.tools.controls.isFlying;
      const tapped = camera.position.join();
      key("keydown", "KeyS", false);
      key("keyup", "KeyS", false);
      found.tap = camera.position.join() !== tapped;
      found.still = upright();
      page.document.getElementById("reset").click();
      const again = camera.axes().flat(), was = JSON.parse(first).flat();
      found.reset = Math.max(...again.map((x, k) => Math.abs(x - was[k]))) < 1e-6;
      const far = camera.distance;
      camera.distance *= 3;
      view.tools.centre(surface.clientWidth / 2, surface.clientHeight / 2);
      await until(() => camera.distance < 2 * far);
      found.pick = camera.distance > far / 2;
      return JSON.stringify(found);"""
    found = json.loads(answer_of(tmp_path, text, SHARP + steps))
    assert found == {
        "orbit": True,
        "upright": "0.0000",
        "pinch": True,
        "look": True,
        "taps": "[100,3,[200,200],0]",
        "coarse": True,
        "fast": True,
        "stops": True,
        "tap": True,
        "still": "0.0000",
        "reset": True,
        "pick": True,
    }


@pytest.mark.slow
@needs_chromium
def test_the_reader_stays_where_photos_looked(tmp_path, city):
    """However far somebody drags, pulls, flies or zooms."""
    photos = [Photo(view.name, view.camera) for view in city.views]
    text = written(tmp_path / "page.html", city, colourful(city, 500), photos=photos)
    steps = """
      const view = page.viewer, camera = view.camera, surface = view.canvas, found = {};
      const { middle, reach, pitches } = camera.view;
      const height = () => camera.position.reduce((sum, x, k) => sum + x * camera.up[k], 0);
      const away = () => Math.hypot(...camera.position.map((x, k) => x - middle[k]));
      const inside = () => height() >= camera.view.ground - 1e-3
        && away() <= reach * 1.01 && camera.pitch >= pitches[0] - 1e-9
        && camera.pitch <= pitches[1] + 1e-9;
      const moves = {
        "dragged up": () => camera.orbit(0, 0.3), "dragged down": () => camera.orbit(0.1, -0.3),
        "looked up": () => camera.look(0.1, 0.5), "looked down": () => camera.look(0, -0.5),
        "zoomed out": () => camera.zoom(1.5), "zoomed in": () => camera.zoom(0.5),
        "zoomed at a corner": () => camera.zoom(0.8, camera.ray(5, 5, 640, 480)),
        "flown forward": () => camera.move(0, 0, camera.distance),
        "flown back": () => camera.move(0, 0, -camera.distance),
        "sunk": () => camera.rise(-camera.distance), "risen": () => camera.rise(camera.distance),
        "sideways": () => camera.move(camera.distance, 0, 0)};
      for (const [name, move] of Object.entries(moves)) {
        camera.reset();
        found[name] = inside();
        for (let k = 0; k < 40; k++) { move(); found[name] = found[name] && inside(); }
      }
      camera.reset();
      const pinhole = camera.pinhole(640, 480), ray = camera.ray(500, 100, 640, 480);
      const along = camera.distance / ray.reduce((sum, x, k) => sum + x * camera.axes()[2][k], 0);
      const place = camera.position.map((x, k) => x + along * ray[k]);
      camera.zoom(0.7, ray);
      const seen = place.map((x, k) => x - camera.position[k]);
      const [right, down, ahead] = camera.axes().map(
        (axis) => axis.reduce((sum, x, k) => sum + x * seen[k], 0));
      found.pointer = Math.hypot(pinhole.focal[0] * right / ahead + pinhole.centre[0] - 500,
                                 pinhole.focal[1] * down / ahead + pinhole.centre[1] - 100) < 1;
      const help = page.document.getElementById("help"), shown = help.hidden;
      page.dispatchEvent(new page.KeyboardEvent("keydown", {key: "?", code: "Minus"}));
      found.help = help.hidden !== shown;
      return JSON.stringify(found);"""
    found = json.loads(answer_of(tmp_path, text, SHARP + steps))
    assert len(found) == 14 and all(found.values()), found


def test_export_of_a_run_without_its_scene_keeps_everything(tmp_path, city):
    run = run_with(tmp_path / "run", colourful(city, 300))
    run.write_options({**run.read_options(), "scene": str(tmp_path / "gone"), "extent": 10.0})
    write_orientation(run.path, city.up, city.first_view)
    result = clsplat_("export", run.path, "-o", tmp_path / "run.html")
    assert result.exit_code == 0 and "its scene is not there" in result.output, result.output
    assert re.search(r'"count": (29|300)', (tmp_path / "run.html").read_text("utf-8"))


def test_a_page_leaves_out_what_one_photo_shows(tmp_path, city):
    """And what has vanished."""
    model = colourful(city, 300)
    model.opacity_logits[:] = np.where(np.arange(300) < 10, -20, 1)
    model.opacity_logits[:5] = 1
    model.positions[:5] += 1e5
    run = run_with(tmp_path / "run", model)
    run.save_model(model, city.offset)
    for words, count in (((), 290), (("--everything",), 295)):
        result = clsplat_("export", run.path, "-o", tmp_path / "run.html", "--overwrite", *words)
        assert result.exit_code == 0, result.output
        assert f'"count": {count}' in (tmp_path / "run.html").read_text("utf-8"), result.output
