"""Functions of a user that see a training's records, and may stop it."""

from collections.abc import Callable, Iterable
from typing import Any

from clsplat.errors import StopTraining

Record = dict[str, Any]
STEP = "step"


class Callbacks:
    """Calls each function with each record.

    Attributes
    ----------
    stop : whether one of them has raised StopTraining.
    """

    def __init__(self, functions: Iterable[Callable[[Record], object]] = ()) -> None:
        self.functions = tuple(functions)
        self.stop = False

    def logged(self, record: Record) -> None:
        """Show a record of metrics.jsonl; steps are shown by `stepped`, each of them."""
        if record["event"] != STEP:
            self._show(record)

    def stepped(self, training: Any) -> None:
        """Show the step that a `loop.Training` has taken; its loss makes the host wait."""
        if self.functions:
            loss, l1, ssim = training.check()
            self._show({"event": STEP, **training.place(), "loss": loss, "l1": l1, "ssim": ssim})

    def _show(self, record: Record) -> None:
        for function in self.functions:
            try:
                function(record)
            except StopTraining:
                self.stop = True
