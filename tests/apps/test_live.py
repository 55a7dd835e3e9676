"""A training that is watched ends in the same bytes, and no frame can harm it."""

import http.client
import json
import re
import threading

import numpy as np
import pytest

from clsplat.api.run import Run
from clsplat.apps import live
from clsplat.apps.live import TrainingView, live_page, show_run
from clsplat.apps.server import FrameRequest
from clsplat.evaluation.views import render_view
from clsplat.io.models.tree import TREE
from clsplat.io.photos.images import read_image
from clsplat.io.runs.run import RunFolder
from clsplat.rendering.slabs import open_model
from clsplat.report.model_page import view_record
from clsplat.training.run import train
from tests.apps.browser import answer_of, needs_chromium
from tests.data.made_tree import write_tree
from tests.data.tiny_training import LEVELLED, model_digest, options_of

FRAME = (64, 48)


def record_of(camera):
    return {
        "width": camera.width,
        "height": camera.height,
        "focal": camera.focal,
        "centre": camera.centre,
        "rotation": camera.rotation.tolist(),
        "position": camera.position.tolist(),
    }


def asked(address, what, camera):
    """The answer of a page's server, or None after its end."""
    _, _, host, token, _ = address.split("/")
    connection = http.client.HTTPConnection(host, timeout=30)
    try:
        connection.request("POST", f"/{token}/{what}", json.dumps(record_of(camera)))
        response = connection.getresponse()
        return response.status, response.read()
    except OSError:
        return None
    finally:
        connection.close()


class Eager(TrainingView):
    """A view for which a frame of some camera, or a depth, is wanted after every step."""

    def __init__(self, scene):
        super().__init__(scene)
        self.asked, self._cameras = [], [view.camera.resized(*FRAME) for view in scene.views]

    def is_due(self):
        number = len(self.asked)
        request = FrameRequest(self._cameras[number % len(self._cameras)], number % 5 == 4)
        self.asked.append(request)
        self.requests.put(request)
        return True


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"iterations": 50},  # a mean of the last steps would not be what was seen in the last
        pytest.param({**LEVELLED, "average": 0.0}, marks=pytest.mark.nightly),
    ],
    ids=["short", "levelled"],
)
def test_watching_changes_no_byte(item_device, city, tmp_path, monkeypatch, changes):
    options = options_of(**changes)
    plain, run = RunFolder.create(tmp_path / "plain"), RunFolder.create(tmp_path / "watched")
    train(city, options, item_device, plain)
    with Eager(city) as view:
        train(city, options, item_device, run, view, watcher=view)
    assert len(view.asked) == options.iterations and not any(request.answer.exception(0) for request in view.asked)
    assert model_digest(run) == model_digest(plain)
    assert view._status["total"] == options.iterations and len(view._status["losses"]) > 1
    last = view.asked[-2]  # the last steps change little
    model = Run.open(run.path).model
    shown = render_view(
        *open_model(item_device, model, city.near_plane),
        model.sh_degree,
        last.camera.shifted(model.offset - last.camera.offset),
    )
    image = last.answer.result(0)
    assert np.abs(shown - image).mean() < 0.02 < image.std()

    def no_memory(*_):
        raise MemoryError("too large")

    monkeypatch.setattr(FrameRequest, "drawn", no_memory)
    run = RunFolder.create(tmp_path / "blind")
    with Eager(city) as view:
        train(city, options, item_device, run, view, watcher=view)
    assert {type(request.answer.exception(0)) for request in view.asked} == {MemoryError}
    assert model_digest(run) == model_digest(plain), "a frame that fails harms nothing"


def test_a_run_is_shown_as_its_model_is_rendered(item_device, city, tmp_path):
    """So is its tree, without the model."""
    folder = RunFolder.create(tmp_path / "run")
    train(city, options_of(iterations=12), item_device, folder)
    run = Run.open(folder.path)
    camera = city.views[5].camera.resized(*FRAME)
    middle = camera.cropped(30, 22, 32, 24)
    model = run.model
    local = camera.shifted(model.offset - camera.offset)
    opened = open_model(item_device, model, city.near_plane)
    expected = render_view(*opened, model.sh_degree, local)
    assert expected.std() > 0.05
    points = city.points[city.views[5].sees(city.points)]
    depths = camera.project(points)[1]
    for drawn in ("model", "tree"):
        if drawn == "tree":
            write_tree(folder.path / TREE, iter([model]), model.sh_degree, model.offset)
            folder.model_path.unlink()
        answers = shown_on_a_page(run, item_device, camera, middle)
        code, jpeg = answers["frame"]
        assert code == 200
        assert np.abs(read_image(jpeg) / 255.0 - expected).mean() < 0.02
        depth = json.loads(answers["depth"][1])["depth"]
        assert np.quantile(depths, 0.02) < depth < np.quantile(depths, 0.98)


def shown_on_a_page(run, device, camera, middle):
    """{"frame", "depth"}: what the page of a run answers for two cameras."""
    answers, raise_in_next = {}, []

    def ask(address):
        for what, each in (("frame", camera), ("depth", middle)):
            answers[what] = asked(address, what, each)
        raise_in_next.append(True)

    original = live.FrameRequests.next

    def until_answered(self, patience=0.0):
        if raise_in_next:
            raise KeyboardInterrupt
        return original(self, 0.05)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live.FrameRequests, "next", until_answered)
        with pytest.raises(KeyboardInterrupt):
            show_run(run, device, lambda address: threading.Thread(target=ask, args=(address,), daemon=True).start())
    return answers


SERVER = """<head><script>
  // instead of a server: frames are grey, and the depth is 7
  const asked = [], status = {iteration: 150, total: 600, gaussians: 1234, loss: 0.5, message: "m",
    phase: "training", losses: [[50, 0.9], [100, 0.7], [150, 0.5]]};
  let isThere = true;
  globalThis.fetch = async (what, { body } = {}) => {
    if (!isThere) throw new TypeError("no server");
    if (what === "status") return Response.json(status);
    const camera = JSON.parse(body);
    asked.push([what, camera]);
    if (what === "depth") return Response.json({ depth: 7 });
    const canvas = new OffscreenCanvas(camera.width, camera.height);
    const paper = canvas.getContext("2d");
    paper.fillStyle = "#808080";
    paper.fillRect(0, 0, camera.width, camera.height);
    return new Response(await canvas.convertToBlob());
  };
</script>"""


@pytest.mark.slow
@needs_chromium
def test_the_page_asks_for_frames_and_tells_how_the_training_goes(tmp_path, city):
    page = live_page("a city", view_record(city.first_view, city.up, city.points))
    found = json.loads(
        answer_of(
            tmp_path,
            page.replace("<head>", SERVER, 1),
            """
      const view = page.viewer, text = (name) => page.document.getElementById(name).textContent;
      const { asked } = page.eval("({ asked })"), camera = view.camera, found = {};
      await until(() => view.shown && text("facts").includes("gaussians"));
      found.first = asked[0][1];
      found.told = [text("facts"), text("numbers"), text("message"), text("notice")];
      const curve = page.document.querySelector("#losses polyline").getAttribute("points");
      found.curve = curve.split(" ").map((pair) => pair.split(",").map(Number));
      found.grey = [...view.canvas.getContext("2d").getImageData(9, 9, 1, 1).data];
      camera.orbit(0.3, 0);
      view.moved();
      const turned = JSON.stringify(camera.axes()), last = () => asked[asked.length - 1][1];
      await until(() => JSON.stringify(last().rotation) === turned && last().width === 640);
      found.last = last(); // of all pixels, once it rests
      await view.tools.centre(view.canvas.clientWidth / 2, view.canvas.clientHeight / 2);
      found.distance = camera.distance;
      page.document.getElementById("measure").click();
      view.tools.tapped(320, 240);
      await until(() => view.tools.parts[0].points.length);
      found.coordinates = text("measured");
      page.eval("isThere = false");
      await until(() => view.ended);
      found.end = text("notice");
      return JSON.stringify(found);""",
        )
    )
    first = found["first"]
    assert 3 * first["width"] == 4 * first["height"] > 900
    assert np.allclose(first["position"], city.first_view.position)
    assert np.allclose(first["rotation"], city.first_view.rotation, atol=1e-6)
    assert found["told"] == ["step 150 of 600 · 1,234 gaussians", "training · loss 0.5000", "m", ""]
    assert np.allclose(np.array(found["curve"])[[0, -1]], [(100 / 3, 0), (100, 100)])
    assert found["grey"] == [128, 128, 128, 255]
    assert found["last"]["height"] == 480
    assert not np.allclose(found["last"]["rotation"], first["rotation"], atol=0.1)
    assert found["distance"] == pytest.approx(7, rel=0.1)
    assert re.fullmatch(r"x \S+ · y \S+ · z \S+ · scene units", found["coordinates"])
    assert found["end"].startswith("The training has ended")
