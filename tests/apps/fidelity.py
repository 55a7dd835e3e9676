"""How far the page of a run is from what our renderer draws, in headless Chromium.

python -m tests.apps.fidelity RUN ... prints a table; each run needs its scene.
"""

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from clsplat.device import choose_device
from clsplat.evaluation.metrics import psnr
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import render_view
from clsplat.report.model_page import write_run_page
from tests.apps.browser import answer_of, picture_of

MOST_VIEWS = 4
PICTURES = """
  await until(() => page.viewer && page.viewer.sharp);
  const { viewer } = page, pictures = [];
  for (const camera of %s) {
    Object.assign(viewer.camera, {position: camera.position, axes: () => camera.rotation,
                                  pinhole: () => camera});
    viewer.moved();
    await until(() => !viewer.sorting && !viewer.stale);
    viewer.draw(1);
    pictures.push(viewer.canvas.toDataURL());
  }
  return JSON.stringify(pictures);"""


@dataclass(frozen=True)
class Fidelity:
    """The page against the render, of one view: PSNR in dB, and the mean of page less render in
    steps of 8 bits."""

    view: str
    psnr: float
    mean: float


def fidelity(run, device, folder, most=MOST_VIEWS):
    """The Fidelity of at most so many held-out views of a run, evenly chosen; of its training views
    if none is held out.

    Parameters
    ----------
    run, device : a finished run and an open device.
    folder : for the page and the profile of the browser.
    most : how many views.
    """
    scene, options = run.scene(), run.options
    train, held_out = scene.split(options.test_every, options.test_offset)
    views = held_out or train
    views = views[::-(-len(views) // most)]
    model = run.finished_model
    write_run_page(folder / "page.html", run, model)
    renderer, rows, degree = run.opened(device, scene, model.moved(scene.offset))
    found = []
    for size in sorted({(view.camera.width, view.camera.height) for view in views}):
        chosen = [view for view in views if (view.camera.width, view.camera.height) == size]
        cameras = [page_camera(scene, view.camera, model) for view in chosen]
        answer = answer_of(folder, (folder / "page.html").read_text("utf-8"),
                           PICTURES % json.dumps(cameras), size)
        for view, picture in zip(chosen, json.loads(answer)):
            shown, ours = picture_of(picture), render_view(renderer, rows, degree, view.camera)
            found.append(Fidelity(view.name, psnr(shown, ours),
                                  255 * float((shown - ours).mean())))
    return found


def page_camera(scene, camera, model):
    """A camera of a scene as web/draw.js takes it, in the world of the page of a model."""
    away = (scene.offset - model.offset + scene.unit * camera.position).tolist()
    return {"width": camera.width, "height": camera.height, "position": away,
            "rotation": camera.rotation.tolist(), "focal": camera.focal, "centre": camera.centre}


if __name__ == "__main__":
    opened = choose_device("auto")
    for path in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as beside:
            for each in fidelity(Run.open(path), opened, Path(beside)):
                print(f"{path}  {each.view}  {each.psnr:.2f} dB  mean {each.mean:+.2f}", flush=True)
