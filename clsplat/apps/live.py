"""What the live pages show: a finished run, and a training while it goes on."""

import time
from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any, NoReturn

from clsplat.apps.models import photos_of
from clsplat.apps.server import FrameRequests, ViewServer
from clsplat.device import Device
from clsplat.evaluation.run import Run, open_shown
from clsplat.io.models.tree import Tree
from clsplat.rendering.tree import HOST_BYTES
from clsplat.report.model_page import filled, near_of, place_record, view_record
from clsplat.report.page import full_name, script_json
from clsplat.scene import Scene
from clsplat.training.checkpoint import latest_model
from clsplat.training.current import CurrentRenderer
from clsplat.training.progress import SilentProgress
from clsplat.training.session import Session

SHARE = 0.25  # of the time that frames may take from a training
IDLE = 0.5  # seconds between looks for Ctrl-C


def live_page(title: str, view: dict[str, Any]) -> str:
    """The page of a server, with its first view as `view_record` makes it."""
    return filled("live.html", title=escape(title), model=script_json(view))


def show_run(
    run: Run, device: Device, opened: Callable[[str], object], port: int = 0, host_bytes: float = HOST_BYTES
) -> NoReturn:
    """Serve a page of a run's model, and draw its frames, until KeyboardInterrupt.

    Parameters
    ----------
    run : finished, or with a checkpoint.
    device : that draws.
    opened : called with the address of the page.
    port : as for ViewServer.
    host_bytes : for a tree; see `TreeRenderer`.

    Raises
    ------
    InputError : there is no model, or the port cannot be opened.
    """
    renderer, rows, model = open_shown(run, device, near_of(run), host_bytes, partial(latest_model, run.folder))
    positions = (
        model.read(len(model.nodes) - 1, "positions")  # of the root
        if isinstance(model, Tree)
        else model.positions
    )
    view = run.first_view.shifted(model.offset - run.first_view.offset)
    page = live_page(
        full_name(run.path, run.record),
        view_record(view, run.up, positions, photos_of(run), place_record(run.georeference, model.offset)),
    )
    requests = FrameRequests()
    with ViewServer(page, requests, lambda: {"gaussians": model.count}, port) as server:
        opened(server.address)
        while True:
            request = requests.next(IDLE)
            if request:
                request.attempt(partial(request.drawn, renderer, rows, model.sh_degree))


class TrainingView(ViewServer, SilentProgress):
    """Shows a training on a page; the Watcher and the progress of that training.

    It changes nothing: frames are drawn between steps, from a copy of the gaussians, and a frame
    that cannot be drawn is only reported on the page.

    Parameters
    ----------
    scene : as it was read.
    progress : to which all that is reported is passed on.
    port : as for ViewServer.
    """

    def __init__(self, scene: Scene, progress: SilentProgress | None = None, port: int = 0) -> None:
        self._unit = scene.unit
        self._inner = progress or SilentProgress()
        self._drawn_until = self._seconds = 0.0
        self._status: dict[str, Any] = {"phase": "beginning", "message": "", "losses": []}
        page = live_page(
            scene.name,
            view_record(
                scene.first_view,
                scene.up,
                scene.points,
                [view.camera for view in scene.views],
                place_record(scene.georeference, scene.offset),
            ),
        )
        super().__init__(page, FrameRequests(), lambda: self._status, port)

    # --- as a progress line

    def __call__(self, **values: Any) -> None:
        """Keep the values of a step for the page."""
        losses = [*self._status["losses"], (values["iteration"], values["loss"])]
        self._status = {**self._status, **values, "losses": losses}
        self._inner(**values)

    def message(self, text: str) -> None:
        """Keep a message for the page."""
        self._status = {**self._status, "message": text}
        self._inner.message(text)

    def phase(self, text: str) -> None:
        """Keep what is being done for the page."""
        self._status = {**self._status, "phase": text}
        self._inner.phase(text)

    def spent(self) -> dict[str, float]:
        """See `SilentProgress.spent`."""
        return self._inner.spent()

    # --- between steps

    def is_due(self) -> bool:
        """Whether a frame is wanted, and drawing has not taken its share of the time."""
        rest = self._seconds * (1 / SHARE - 1)
        return not self.requests.empty() and time.perf_counter() - self._drawn_until >= rest

    def draw(self, session: Session) -> None:
        """Draw the frame that is wanted. Whatever goes wrong in drawing is no fault of training."""
        request = self.requests.next()
        if request is None:
            return
        begin = time.perf_counter()
        # gives its memory to the frame; an error of a step under way belongs to the training
        session.step.release()
        request.attempt(
            lambda: request.drawn(
                CurrentRenderer(session.renderer),
                session.model,
                session.options.sh_degree,
                session.scene.unit / self._unit,
            )
        )
        session.step.release()
        self._drawn_until = time.perf_counter()
        self._seconds = self._drawn_until - begin
