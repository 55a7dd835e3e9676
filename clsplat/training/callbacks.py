"""Functions of a user that see a training's records, and may stop it."""

from collections.abc import Callable, Iterable
from typing import Any

from clsplat.errors import StopTraining

Record = dict[str, Any]
Callback = Callable[[Record], object]
STEP = "step"


class Callbacks:
    """Calls each function with each record.

    Attributes
    ----------
    stop : whether one of them has raised StopTraining.
    """

    def __init__(self, functions: Iterable[Callback] = ()) -> None:
        self.functions = tuple(functions)
        self.stop = False

    def show(self, record: Record) -> None:
        """Call the functions."""
        for function in self.functions:
            try:
                function(record)
            except StopTraining:
                self.stop = True
