"""Flags and reports shared by the benchmarks."""

import argparse
import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from clsplat.device import choose_device
from clsplat.errors import InputError

from .ceilings import measure_ceilings
from .timing import milliseconds, spread

MULTIPLES = {"": 1, "k": 1_000, "M": 1_000_000}


class Bench:
    """One run of a benchmark: its flags, its device with the peak rates, timing and reports.

    Parameters
    ----------
    argv : the flags of the command line.
    description : the text of --help.
    defaults : a flag --NAME for each; False makes a switch, a list a flag of several values, and
        `gaussians` is a text such as "200k,1M".
    """

    def __init__(self, argv: Sequence[str], description: str | None, **defaults: Any) -> None:
        self.options = arguments(argv, description, **defaults)
        self.device = choose_device(self.options.device, form=self.options.form,
                                    profiling=getattr(self.options, "profile", False))
        self.ceilings = measure_ceilings(self.device)
        if not self.options.json:
            print(f"{self.device.name}, {self.device.form} form: copies "
                  f"{self.ceilings.copy / 1e9:.1f} GB/s, multiplies and adds "
                  f"{self.ceilings.arithmetic / 1e9:.1f} Gop/s", flush=True)

    def milliseconds(self, function: Callable[[], object],
                     warm_up: int = 3) -> NDArray[np.float64]:
        """Wall times float64[repeats] of `function()`."""
        return milliseconds(self.device, function, self.options.repeats, warm_up)

    def report(self, family: str, variant: str, times: NDArray[np.float64],
               size: Mapping[str, object], traffic: float | None = None,
               operations: float | None = None) -> None:
        """Print one result as a JSON line or as a line of a table.

        Parameters
        ----------
        times : milliseconds.
        size : the numbers that say how large the task was, by name.
        traffic : bytes that the kernels read and write, caches left aside; None if not counted.
        operations : additions, multiplications, comparisons and the like that the algorithm needs,
            counted by hand in the source of the kernel, an exponential as 20; None if not counted.
        """
        seconds = float(np.median(times)) * 1e-3
        record = {"family": family, "variant": variant, "form": self.device.form,
                  "device": self.device.name, "driver": self.device.handle.driver_version,
                  "size": size, **spread(times),
                  "bytes": traffic, "operations": operations,
                  "copy_gb_s": round(self.ceilings.copy / 1e9, 2),
                  "arithmetic_gop_s": round(self.ceilings.arithmetic / 1e9, 2),
                  "copy_share": _share(traffic, seconds, self.ceilings.copy),
                  "arithmetic_share": _share(operations, seconds, self.ceilings.arithmetic)}
        print(json.dumps(record) if self.options.json else _line(record), flush=True)


def _share(amount: float | None, seconds: float, ceiling: float) -> float | None:
    return None if amount is None else round(amount / seconds / ceiling, 4)


def _line(record: dict[str, Any]) -> str:
    low, high = record["quartiles_ms"]
    extra = [f"{what} {count:,}" if isinstance(count, int) else f"{what} {count}"
             for what, count in record["size"].items()]
    for amount, share, unit in (("bytes", "copy_share", "GB/s"),
                                ("operations", "arithmetic_share", "Gop/s")):
        if record[amount]:
            rate = record[amount] / record["median_ms"] / 1e6
            extra.append(f"{rate:.1f} {unit} ({record[share]:.0%})")
    return (f"{record['family']:12} {record['variant']:24} {record['median_ms']:9.3f} ms  "
            f"({low:.3f} to {high:.3f})  {', '.join(extra)}")


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like those of the command line."""

    def error(self, message: str) -> NoReturn:
        """Raise InputError."""
        raise InputError(f"{message}; see `clsplat bench FAMILY -- --help`")


def arguments(argv: Sequence[str] | None, description: str | None, **defaults: Any
              ) -> argparse.Namespace:
    """Parse --json, --device, --form, --repeats and the flags of `defaults` (see `Bench`)."""
    parser = Parser(description=description, prog="clsplat bench")
    parser.add_argument("--json", action="store_true", help="JSON lines instead of a table")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--form", default="auto", choices=("auto", "item", "group"))
    for name, default in {"repeats": 20, **defaults}.items():
        flag = "--" + name.replace("_", "-")
        if isinstance(default, bool):
            parser.add_argument(flag, action="store_true")
        elif name == "gaussians":
            parser.add_argument(flag, default=default, type=counts, metavar=default)
        else:
            kind = type(default[0]) if isinstance(default, list) else type(default)
            parser.add_argument(flag, default=default, type=kind,
                                nargs="+" if isinstance(default, list) else None)
    return parser.parse_args(argv)


def counts(text: str) -> tuple[int, ...]:
    """The numbers of a list, such as (200000, 1000000) for "200k,1M"."""
    parts = [re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", part) for part in text.split(",")]
    if not all(parts):
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of counts such as 200k,1M,4M")
    return tuple(round(float(part[1]) * MULTIPLES[part[2]]) for part in parts if part)
