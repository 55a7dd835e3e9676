"""Frames that the threads of a server ask for, and that the thread which owns the device draws."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera

ENDED = "no frames are drawn any more"
LEAST_COVER = 0.5  # of a pixel, for which its depth is known


class FrameRequest:
    """A frame that someone waits for.

    Parameters
    ----------
    camera : of the frame, in the world of the page.
    wants_depth : whether only the depth of what its pixels show is wanted.

    Attributes
    ----------
    image : float32[H, W, 3], 0 to 1, once it is drawn.
    depth : the mean over pixels, world units; None where they show nothing that is opaque.
    problem : why it could not be drawn, or "".
    """

    def __init__(self, camera: Camera, wants_depth: bool = False) -> None:
        self.camera, self.wants_depth = camera, wants_depth
        self.image: NDArray[np.float32] | None = None
        self.depth: float | None = None
        self.problem = ""
        self.is_abandoned = False
        self._done = threading.Event()

    def wait(self, seconds: float) -> bool:
        """Wait until it is answered, at most so long; afterwards nobody draws it any more."""
        self.is_abandoned = not self._done.wait(seconds)
        return not self.is_abandoned

    def answer(self, problem: str = "") -> None:
        """Tell who waits that it is drawn, or why it is not."""
        self.problem = problem
        self._done.set()

    def attempt(self, draw: Callable[[], object]) -> None:
        """Call what draws this frame, whose failure is told to who waits and ends nothing else."""
        try:
            draw()
        except Exception as error:  # noqa: BLE001  (memory, for example)
            self.answer(f"this frame could not be drawn ({type(error).__name__}: {error})")

    def draw(self, renderer: Any, rows: Any, degree: int, unit: float = 1.0) -> None:
        """Draw it and answer.

        Parameters
        ----------
        renderer, rows, degree : the model on the device; see `slabs.open_model`.
        unit : of the model's world, in units of the page's.
        """
        camera = self.camera
        packed = renderer.pack(replace(camera, translation=camera.translation / unit))
        frame = renderer.render(rows, packed, camera.width, camera.height, degree,
                                with_depth=self.wants_depth)
        if self.wants_depth:
            cover = 1 - float(frame.blended.transmittance.download().mean())
            if cover > LEAST_COVER:
                self.depth = unit * float(frame.blended.depth.download().mean()) / cover
        else:
            self.image = np.clip(frame.image.download().transpose(1, 2, 0), 0, 1)
        self.answer()


class FrameRequests:
    """The requests that wait, the oldest first."""

    def __init__(self) -> None:
        self._waiting: SimpleQueue[FrameRequest] = SimpleQueue()
        self._ended = False

    def add(self, request: FrameRequest) -> None:
        """Let a request wait for the thread that draws."""
        self._waiting.put(request)
        if self._ended:
            self.end()

    def end(self) -> None:
        """From now on nobody draws: no request waits any more."""
        self._ended = True
        while request := self.next():
            request.answer(ENDED)

    @property
    def is_empty(self) -> bool:
        """Whether none waits; does not wait itself."""
        return self._waiting.empty()

    def next(self, patience: float = 0.0) -> FrameRequest | None:
        """The next request, or None if none comes within so many seconds."""
        while True:
            try:
                request = self._waiting.get(block=patience > 0, timeout=patience or None)
            except Empty:
                return None
            if not request.is_abandoned:
                return request
