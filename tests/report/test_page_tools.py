"""The tools of a page of a model, in Chromium: measuring, coordinates, photos, cuts and views."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.photos.images import encode_image
from clsplat.rendering.slabs import open_model
from clsplat.report.model_page import Photo, write_page
from tests.apps.browser import answer_of, needs_chromium
from tests.estimate.test_plan import city
from tests.report.test_model_page import SHARP, colourful

__all__ = ["city"]
SITE = Georeference("EPSG:32614", (622_000.0, 3_456_000.0, 300.0), "GPS of 9 photos", 0.5)
UP = np.array([0.0, 0.0, 1.0])
HEAD = """
  const view = page.viewer, { camera, tools, canvas } = view, found = {};
  const $ = (name) => page.document.getElementById(name);
  const Photos = tools.parts[0], Measure = tools.parts[1];
  canvas.setPointerCapture = () => {};
  const tap = (x, y) => { for (const kind of ["pointerdown", "pointerup"])
    canvas.dispatchEvent(new page.PointerEvent(kind,
      {pointerId: 1, clientX: x, clientY: y, bubbles: true})); };
  const press = (code) => page.dispatchEvent(new page.KeyboardEvent("keydown", {code}));
  const seen = (point) => camera.project(point, canvas.clientWidth, canvas.clientHeight);
  const pixels = () => { view.draw(1); const paper = new page.OffscreenCanvas(640, 480)
    .getContext("2d"); paper.drawImage(canvas, 0, 0, 640, 480);
    return paper.getImageData(0, 0, 640, 480).data; };
  const lit = (data) => data.reduce((sum, value, k) => sum + (k % 4 < 3 && value > 20), 0);
"""


def slab(count=2000):
    """A level, opaque square of 20 x 20 at the height 2, dark on the left of x = 0."""
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(-10, 10, (count, 2)), np.full(count, 2.0)])
    rows = {
        "positions": places,
        "log_scales": np.log(np.tile([0.4, 0.4, 0.01], (count, 1))),
        "quaternions": np.tile([1.0, 0, 0, 0], (count, 1)),
        "opacity_logits": np.full(count, 3.0),
        "sh_rest": np.zeros((count, 0, 3)),
        "sh_constant": np.where(places[:, :1] < 0, -1.0, 1.0) * np.ones(3),
    }
    return Gaussians({name: values.astype(np.float32) for name, values in rows.items()}, 0)


def camera_above(city):
    return city.views[0].camera.looking_at([0, 0, 2], [0, -14, 16], width=640, height=480)


def page_of(folder, city, **changes):
    write_page(folder / "page.html", slab(), camera_above(city), UP, **{"near": 0.1, "title": "slab", **changes})
    return (folder / "page.html").read_text("utf-8")


def found_in(folder, text, steps, size=(640, 480)):
    steps = SHARP + HEAD + steps + "return JSON.stringify(found);"
    return json.loads(answer_of(folder, text, steps, size))


@pytest.mark.slow
@needs_chromium
def test_lengths_heights_areas_and_coordinates(tmp_path, city):
    """Of taps at known places of a level square, by mouse and keyboard."""
    text = page_of(tmp_path, city, georeference=SITE)
    found = found_in(
        tmp_path,
        text,
        """
      press("KeyM");
      found.pressed = $("measure").getAttribute("aria-pressed") + $("tools").hidden;
      for (const place of [[-3, -2, 2], [3, -2, 2], [3, 2, 2]]) {
        const count = Measure.points.length, [x, y] = seen(place);
        tap(x, y);
        await until(() => Measure.points.length > count);
        if (!count) found.first = $("measured").textContent;
      }
      found.points = Measure.points;
      found.text = $("measured").textContent.split("\\n");
      found.lines = $("overlay").querySelectorAll("circle").length;
      await until(() => $("overlay").querySelectorAll("circle").length === 3);
      found.closed = $("overlay").querySelectorAll(".closing").length;
      press("KeyZ");
      found.undone = Measure.points.length;
      $("clear").click();
      found.cleared = $("measured").textContent + Measure.points.length;
      canvas.dispatchEvent(new page.KeyboardEvent("keydown", {key: "Enter"}));
      await until(() => Measure.points.length === 1);
      found.middle = Measure.points[0];
      press("KeyM");
      const [x, y] = seen([-4, 4, 2]);
      canvas.dispatchEvent(new page.PointerEvent("pointermove", {clientX: x, clientY: y}));
      await until(() => $("place").textContent);
      found.place = $("place").textContent;
      found.measured = Measure.constructor.of(
        [[0, 0, 0], [3, 0, 4], [3, 2, 4], [0, 2, 0]], [0, 0, 1]);
    """,
    )
    assert found["pressed"] == "truefalse" and found["closed"] == 1
    expected = [[-3, -2, 2], [3, -2, 2], [3, 2, 2]]
    assert np.allclose(found["points"], expected, atol=0.06)
    values = [float(re.search(r"[-\d.]+", line)[0]) for line in found["text"]]
    assert np.allclose(values, [10, 10, 0, 12, 12], atol=0.25)
    assert all(line.endswith(("m", "m²")) for line in found["text"])
    assert found["first"].endswith("· EPSG:32614")
    assert (found["undone"], found["cleared"]) == (2, "Click the surface to set points.0")
    assert np.allclose(found["middle"], [0, 0, 2], atol=0.1)
    east, north, height = map(float, re.findall(r"(?:E|N|height) ([\d.]+)", found["place"]))
    assert np.allclose([east, north, height], [621_996, 3_456_004, 302], atol=0.1)
    exact = found["measured"]  # a slope of 5 x 2
    assert np.allclose([exact[key] for key in ("length", "ground", "rise", "area", "mapArea")], [12, 8, 0, 10, 6])


@pytest.mark.slow
@needs_chromium
def test_places_are_where_our_renderer_sees_the_surface(tmp_path, item_device, city):
    model = colourful(city, 4000, 0)
    model.opacity_logits[:] = 4
    camera = replace(city.views[3].camera.resized(480, 360), offset=model.offset)
    write_page(tmp_path / "page.html", model, camera, UP, near=city.near_plane, title="")
    spots = [(x, y) for x in range(40, 480, 40) for y in range(40, 360, 40)]
    found = found_in(
        tmp_path,
        (tmp_path / "page.html").read_text("utf-8"),
        f"""
      found.depths = [];
      for (const [x, y] of {json.dumps(spots)}) {{
        const place = await view.surfaceAt(x + 0.5, y + 0.5);
        found.depths.push(place ? seen(place)[2] : null);
      }}""",
        (480, 360),
    )
    renderer, rows = open_model(item_device, model, city.near_plane)
    frame = renderer.render(rows, renderer.pack(camera), 480, 360, 0, with_depth=True)
    cover = 1 - frame.blended.transmittance.download()
    depth = (frame.blended.depth.download() / np.maximum(cover, 1e-6)).reshape(360, 480)
    ours = np.array([depth[y, x] if cover.reshape(360, 480)[y, x] > 0.9 else np.nan for x, y in spots])
    theirs = np.array([np.nan if each is None else each for each in found["depths"]])
    errors = np.abs(theirs / ours - 1)[np.isfinite(ours)]
    assert len(errors) > 15 and np.nanmedian(errors) < 0.02 and not np.isnan(errors).any()


@pytest.mark.slow
@needs_chromium
def test_scale_north_heights_and_cut(tmp_path, city):
    text = page_of(tmp_path, city, georeference=SITE)
    found = found_in(
        tmp_path,
        text,
        """
      found.scale = $("scale").textContent.trim();
      const bar = $("bar_length").getBoundingClientRect().width, centre = camera.centre();
      found.bar = bar;
      const beside = centre.map((x, k) => x + parseFloat(found.scale) * camera.axes()[0][k]);
      found.two = seen(beside)[0] - seen(centre)[0];
      camera.orbit(1, 0); view.draw(1);
      found.arrow = $("north").firstElementChild.style.transform;
      const ahead = () => camera.axes()[2];
      found.angle = Math.atan2(ahead()[0], ahead()[1]);
      $("north").click();
      await until(() => Math.abs(ahead()[0]) < 1e-6);
      found.north = ahead()[1];
      camera.reset(); view.moved(); await until(() => view.sharp);
      const at = 4 * (240 * 640 + 400), colours = () => [...pixels().subarray(at, at + 3)];
      found.plain = colours();
      press("KeyG");
      found.high = colours();
      found.legend = [$("legend").hidden, $("legend").textContent.trim()];
      press("KeyG");
      found.again = colours();
      const whole = lit(pixels()), [west, east, , , bottom, top, turn] = view.looks.sliders;
      const slide = (slider, value) => { slider.value = value;
        slider.dispatchEvent(new page.Event("input")); };
      found.shares = {};
      slide(west, 500); found.shares.east = lit(pixels()) / whole;
      const [x, y] = seen([-4, 0, 2]);
      found.gone = await view.surfaceAt(x, y);
      found.left = await view.surfaceAt(...seen([4, 0, 2]).slice(0, 2));
      slide(turn, 1000); found.shares.turned = lit(pixels()) / whole;
      $("uncut").click(); found.shares.all = lit(pixels()) / whole;
      slide(west, 500); slide(east, 500); found.shares.none = lit(pixels()) / whole;
    """,
    )
    number, unit = found["scale"].split()
    assert unit == "m" and float(number) in (1, 2, 5) and found["bar"] == pytest.approx(found["two"], rel=0.02)
    turned = float(re.search(r"\((.*)rad", found["arrow"])[1])
    assert np.cos(turned + found["angle"]) == pytest.approx(1, abs=1e-3) and found["north"] > 0.5
    assert found["plain"][0] == found["plain"][1] > 150 and found["again"] == found["plain"]
    assert max(found["high"]) - min(found["high"]) > 60
    assert found["legend"] == [False, "302.0 m302.0 m"]
    shares = found["shares"]
    assert 0.4 < shares["east"] < 0.7 and shares["none"] == 0
    assert shares["all"] == pytest.approx(1, abs=1e-3)
    assert abs(shares["turned"] - shares["east"]) > 0.02
    assert "gone" not in found and found["left"][0] == pytest.approx(4, abs=0.1)


def photos(city, picture=True):
    grey = np.full((60, 80, 3), 200, np.uint8)
    jpeg = encode_image(grey, "jpg", 80, "JPEG") if picture else b""
    looking = city.views[0].camera.looking_at
    return [
        Photo(f"<b>{number}", looking([x, 0, 2], [x, -3, 12], width=400, height=300), jpeg)
        for number, x in enumerate((-4, 0, 4))
    ]


@pytest.mark.slow
@needs_chromium
def test_photos_are_listed_drawn_and_laid_over_the_picture(tmp_path, city):
    text = page_of(tmp_path, city, photos=photos(city))
    found = found_in(
        tmp_path,
        text,
        """
      await until(() => Photos.all.length);
      const names = [...$("photos").querySelectorAll("button")];
      found.names = names.map((each) => each.textContent);
      press("KeyC");
      await until(() => $("overlay").querySelectorAll(".camera").length === 3);
      tap(...seen(Photos.all[1].position).slice(0, 2));
      await until(() => !$("card").hidden);
      found.tapped = $("caption").textContent;
      found.still = view.camera.position;
      names[2].click();
      await until(() => $("caption").textContent === "<b>2" && !$("card").hidden);
      found.position = camera.position;
      const { left, top, width, height } = $("photo").getBoundingClientRect();
      // where the photo shows a point, and where the picture does
      const photo = Photos.all[2], point = [5, 1, 2];
      const away = point.map((x, k) => x - photo.position[k]);
      const [right, down, ahead] = photo.rotation.map((axis) => axis.reduce(
        (sum, x, k) => sum + x * away[k], 0));
      const of = [photo.focal[0] * right / ahead + photo.centre[0],
                  photo.focal[1] * down / ahead + photo.centre[1]];
      found.ofPhoto = [left + of[0] / photo.width * width, top + of[1] / photo.height * height];
      found.ofPicture = seen(point).slice(0, 2);
      $("fade").value = 30;
      $("fade").dispatchEvent(new page.Event("input"));
      found.fade = $("photo").style.opacity;
      $("next").click();
      await until(() => $("caption").textContent === "<b>0" && !$("card").hidden);
      camera.orbit(0.2, 0); view.moved();
      await until(() => $("photo").hidden);
      found.left = $("card").hidden;
    """,
    )
    assert found["names"] == ["<b>0", "<b>1", "<b>2"] and found["tapped"] == "<b>1"
    assert np.allclose(found["position"], [4, -3, 12], atol=1e-3)
    assert np.allclose(found["ofPhoto"], found["ofPicture"], atol=1.5)
    assert found["fade"] == "0.3" and found["left"]


@pytest.mark.slow
@needs_chromium
@pytest.mark.parametrize("still", [False, True], ids=["motion", "reduced motion"])
@pytest.mark.one_in(2)
def test_views_are_kept_and_linked(tmp_path, city, still):
    text = page_of(tmp_path, city)
    asked = "<script>matchMedia = () => ({ matches: true });</script>" if still else ""
    found = found_in(
        tmp_path,
        text.replace("<head>", f"<head>{asked}", 1),
        """
      const first = camera.pose;
      camera.orbit(0.5, -0.1); view.moved();
      const pose = camera.pose, near = (a, b) => a.every((x, k) => Math.abs(x - b[k]) < 1e-5);
      $("name").value = "the <b>yard";
      $("keep").requestSubmit();
      found.kept = $("kept").textContent;
      const address = tools.link;
      $("link").click();
      await until(() => $("told").textContent);
      found.hash = page.location.hash === new URL(address).hash;
      camera.reset(); view.moved();
      let frames = 0;
      const moved = view.moved.bind(view);
      view.moved = () => { frames++; moved(); };
      $("kept").querySelector("button").click();
      await until(() => near(camera.pose, pose));
      found.frames = frames;
      camera.reset();
      page.location.hash = "#view=1,2";
      await new Promise((wake) => setTimeout(wake, 100));
      found.refused = near(camera.pose, first);
      page.location.hash = new URL(address).hash;
      await until(() => near(camera.pose, pose));
      const far = [...pose]; far[0] = 1e9;
      page.location.hash = "#view=" + far.join();
      await until(() => !near(camera.pose, pose));
      found.bounded = Math.abs(camera.position[0]) < 1e4;
      $("kept").querySelectorAll("button")[1].click();
      found.forgotten = $("kept").textContent;
      found.facts = $("facts").textContent;
      const labels = [...page.document.querySelectorAll("button, input")].filter((each) => !(
        each.textContent || each.getAttribute("aria-label") || each.closest("label")));
      found.nameless = labels.map(({ id }) => id);
      found.canvas = canvas.getAttribute("aria-describedby") + canvas.getAttribute("role");
    """,
    )
    assert found["kept"] == "the <b>yard×" and found["forgotten"] == "" and found["hash"]
    assert found["refused"] and found["bounded"] and found["nameless"] == []
    assert found["frames"] == 1 if still else found["frames"] >= 2
    assert found["facts"] == "2,000 gaussians" and found["canvas"] == "helpapplication"


@pytest.mark.slow
@needs_chromium
def test_a_page_shows_a_poster_and_its_share_while_it_loads(tmp_path, city):
    grey = encode_image(np.full((60, 80, 3), 200, np.uint8), "jpg", 80, "JPEG")
    text = page_of(tmp_path, city, poster=grey)
    found = json.loads(
        answer_of(
            tmp_path,
            text,
            """
      const found = {}, frame = document.createElement("iframe");
      Object.assign(frame, { width: 640, height: 480 });
      document.body.append(frame);
      const text = await (await fetch("page")).text(), part = frame.contentDocument;
      const begin = text.indexOf(">", text.indexOf('<script id="cell0"')) + 1;
      const half = begin + (text.indexOf("<", begin) - begin) / 2;
      part.open();
      part.write(text.slice(0, half));
      const notice = part.getElementById("notice");
      await until(() => /[1-9]/.test(notice.textContent));
      found.notice = notice.textContent;
      const { left, top, width, height } = part.getElementById("poster").getBoundingClientRect();
      found.poster = [left, top, width, height];
      part.write(text.slice(half));
      part.close();
      await until(() => frame.contentWindow.viewer.sharp);
      found.end = notice.textContent + part.querySelectorAll("#poster").length;
      return JSON.stringify(found);""",
        )
    )
    assert re.fullmatch(r"Loading the model … (49|50) %", found["notice"])
    assert found["poster"] == [0, 0, 640, 480] and found["end"] == "0"
