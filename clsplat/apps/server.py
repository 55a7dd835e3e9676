"""The server of a live page, and the frames that it asks of the thread which owns the device.

Only this machine reaches it, and only who knows its address.

It is bound to 127.0.0.1, and every path begins with a random token. A request must name this
machine in its Host header, so that a page of another site whose name was made to point here
(DNS rebinding) is refused even if it knew the token.
"""

from __future__ import annotations

import json
import os
import secrets
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotInTime
from dataclasses import dataclass, field, replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.camera import Camera, numbers
from clsplat.errors import InputError
from clsplat.io.photos.images import encode_image
from clsplat.io.records import plain

if TYPE_CHECKING:
    from typing_extensions import Self

LOOPBACK = "127.0.0.1"
PATIENCE = 20.0  # seconds, for a frame: a training may evaluate in between
JPEG_QUALITY = 90
IDLE_SECONDS = 15  # without a byte of a request
LONGEST_BODY = 4096  # bytes of a request
LARGEST_SIDE, LARGEST_FRAME = 4096, 2560 * 1600  # pixels
LEAST_COVER = 0.5  # of a pixel, for which its depth is known
HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'",
}


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """A frame that someone waits for.

    Attributes
    ----------
    camera : of the frame, in the world of the page.
    wants_depth : whether only the depth of what its pixels show is wanted.
    answer : becomes the frame, float32[H, W, 3], 0 to 1; or the mean depth, world units, None if
        the pixels show nothing that is opaque.
    """

    camera: Camera
    wants_depth: bool = False
    answer: Future[Any] = field(default_factory=Future)

    def attempt(self, draw: Callable[[], Any]) -> None:
        """Answer with what a function draws; its failure ends nothing else."""
        try:
            self.answer.set_result(draw())
        except Exception as error:  # noqa: BLE001  (memory, for example)
            self.answer.set_exception(error)

    def drawn(self, renderer: Any, rows: Any, degree: int, unit: float = 1.0) -> Any:
        """What `answer` becomes, of a model on the device (see `slabs.open_model`) whose world has
        a `unit` in units of the page's."""
        camera = self.camera
        packed = renderer.pack(replace(camera, translation=camera.translation / unit))
        frame = renderer.render(rows, packed, camera.width, camera.height, degree, with_depth=self.wants_depth)
        if not self.wants_depth:
            return np.clip(frame.image.download().transpose(1, 2, 0), 0, 1)
        cover = 1 - float(frame.blended.transmittance.download().mean())
        return unit * float(frame.blended.depth.download().mean()) / cover if cover > LEAST_COVER else None


class FrameRequests(SimpleQueue[FrameRequest]):
    """The requests that wait, the oldest first."""

    def next(self, patience: float = 0.0) -> FrameRequest | None:
        """The next request for which somebody still waits, or None if none comes within so many
        seconds."""
        while True:
            try:
                request = self.get(block=patience > 0, timeout=patience or None)
            except Empty:
                return None
            if request.answer.set_running_or_notify_cancel():
                return request


class ViewServer:
    """Serves a page until the block ends; a context manager.

    Parameters
    ----------
    page : HTML.
    requests : receives the requests for frames; someone must draw them.
    status : returns what the page is to know now, for JSON; called in another thread.
    port : of the address; 0: any that is free.

    Attributes
    ----------
    address : of the page, with its token.
    """

    def __init__(
        self, page: str, requests: FrameRequests, status: Callable[[], Mapping[str, Any]], port: int = 0
    ) -> None:
        self.token = secrets.token_urlsafe(24)
        self.page, self.requests, self.status = page, requests, status
        try:
            self._server = _Server((LOOPBACK, port), partial(_Handler, self))
        except OSError as error:
            raise InputError(
                f"--port {port}: cannot be opened ({error.strerror}); choose another, or leave it out for a free one"
            ) from None
        self.port = self._server.server_port
        self.address = f"http://{LOOPBACK}:{self.port}/{self.token}/"
        self.hosts = {f"{name}:{self.port}" for name in (LOOPBACK, "localhost")}

    def __enter__(self) -> Self:
        threading.Thread(
            target=self._server.serve_forever, name="clsplat view", daemon=True, kwargs={"poll_interval": 0.1}
        ).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        while request := self.requests.next():
            request.answer.set_exception(InputError("no frames are drawn any more"))


class _Server(ThreadingHTTPServer):
    daemon_threads = True  # a browser that keeps its connection must not hold up the end
    block_on_close = False
    allow_reuse_address = os.name != "nt"  # on Windows two servers would share a port

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one connection."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "clsplat", ""
    timeout = IDLE_SECONDS

    def __init__(self, view: ViewServer, *arguments: Any) -> None:
        self.view = view
        super().__init__(*arguments)

    def do_GET(self) -> None:  # noqa: N802  (the name is the library's)
        """Send the page, or its status."""
        name = self._allowed_path()
        if name == "":
            self._send(200, "text/html; charset=utf-8", self.view.page.encode())
        elif name == "status":
            self._send_json(plain(dict(self.view.status())))
        elif name is not None:
            self._refuse(404, "there is no such page")

    def do_POST(self) -> None:  # noqa: N802
        """Send a frame of the camera in the body, or the depth of what that camera sees."""
        try:
            length = int(self.headers.get("Content-Length") or "")
            if not 0 <= length <= LONGEST_BODY:
                raise ValueError(length)
            body = self.rfile.read(length)
        except ValueError:
            self.close_connection = True  # what was not read cannot be skipped
            self._refuse(413, "a request has at most 4096 bytes")
            return
        name = self._allowed_path()
        if name not in ("frame", "depth"):
            if name is not None:
                self._refuse(404, "there is no such page")
            return
        try:
            request = FrameRequest(camera_of(body), name == "depth")
        except (ValueError, InputError) as error:
            self._refuse(400, f"not a camera: {error}")
            return
        self.view.requests.put(request)
        try:
            answer = request.answer.result(PATIENCE)
        except NotInTime:  # before Python 3.11 not the built-in one
            request.answer.cancel()
            self._refuse(503, "not drawn in time")
        except Exception as error:  # noqa: BLE001  (of the drawing, which the page shows)
            self._refuse(500, f"this frame could not be drawn ({type(error).__name__}: {error})")
        else:
            if request.wants_depth:
                self._send_json({"depth": answer})
            else:
                self._send(200, "image/jpeg", encode_image(answer, "jpg", JPEG_QUALITY, "JPEG"))

    def _allowed_path(self) -> str | None:
        """The path after the token; None if the request was refused."""
        _, token, *rest = (*self.path.partition("?")[0].split("/", 2), "")
        known = secrets.compare_digest(token.encode(), self.view.token.encode())
        if self.headers.get("Host") not in self.view.hosts or not known:
            self._refuse(403, "open the address that clsplat printed")
            return None
        return rest[0]

    def _refuse(self, code: int, text: str) -> None:
        self._send(code, "text/plain; charset=utf-8", f"{text}\n".encode())

    def _send_json(self, value: Any) -> None:
        self._send(200, "application/json", json.dumps(value).encode())

    def _send(self, code: int, kind: str, content: bytes) -> None:
        self.send_response(code)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Write no log: the terminal belongs to the training."""


def camera_of(text: bytes) -> Camera:
    """The camera of JSON, as ReaderCamera.pinhole makes it (web/camera.js).

    Raises
    ------
    ValueError : for anything else, and for a frame that is too large.
    """
    try:
        record = json.loads(text)
        width, height = record["width"], record["height"]
        rotation, position, focal, centre = (
            numbers(name, record[name], shape)
            for name, shape in (("rotation", (3, 3)), ("position", (3,)), ("focal", (2,)), ("centre", (2,)))
        )
        camera = Camera(
            width,
            height,
            (float(focal[0]), float(focal[1])),
            (float(centre[0]), float(centre[1])),
            rotation,
            -rotation @ position,
        )
        camera.check()
    except (InputError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{error}") from None
    if max(width, height) > LARGEST_SIDE or width * height > LARGEST_FRAME:
        raise ValueError("width and height are no size of a frame")
    return camera
