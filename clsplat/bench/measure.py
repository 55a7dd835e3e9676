"""Flags and reports shared by the benchmarks."""

import argparse
import json
import re

import numpy as np

from clsplat.device import choose_device
from clsplat.errors import InputError

from .ceilings import measure_ceilings
from .timing import milliseconds, spread

MULTIPLES = {"": 1, "k": 1_000, "M": 1_000_000}


class Bench:
    """One run of a benchmark: its flags, its device and what that does at most, and how it times
    and reports.

    defaults: a flag --NAME for each; False makes a switch, a list takes several, `gaussians` is a
    text such as "200k,1M".
    """

    def __init__(self, argv, description, **defaults):
        self.options = arguments(argv, description, **defaults)
        self.device = choose_device(self.options.device, form=self.options.form,
                                    profiling=getattr(self.options, "profile", False))
        self.ceilings = measure_ceilings(self.device)
        if not self.options.json:
            print(f"{self.device.name}, {self.device.form} form: copies "
                  f"{self.ceilings.copy / 1e9:.1f} GB/s, multiplies and adds "
                  f"{self.ceilings.arithmetic / 1e9:.1f} Gop/s", flush=True)

    def milliseconds(self, function, warm_up=3):
        """Wall times float[repeats] of `function()`."""
        return milliseconds(self.device, function, self.options.repeats, warm_up)

    def report(self, family, variant, times, size, traffic=None, operations=None):
        """Print one result: a JSON line, or a line of a table.

        times: milliseconds; size: {what: how much}; traffic: bytes read and written, as the kernels
        ask for them; operations: additions, multiplications, comparisons and the like that the
        algorithm needs, counted by hand in the kernel's source (an exponential as 20). None where
        nothing is counted. Both also as shares of the device's ceilings.
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


def _share(amount, seconds, ceiling):
    return None if amount is None else round(amount / seconds / ceiling, 4)


def _line(record):
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
    """One whose errors are one line, as those of the command line are."""

    def error(self, message):
        raise InputError(f"{message}; see `clsplat bench FAMILY -- --help`")


def arguments(argv, description, **defaults):
    """Parsed --json, --device, --form, --repeats and the flags of `defaults` (see `Bench`)."""
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


def counts(text):
    """(200000, 1000000) of "200k,1M"."""
    parts = [re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", part) for part in text.split(",")]
    if not all(parts):
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of counts such as 200k,1M,4M")
    return tuple(round(float(part[1]) * MULTIPLES[part[2]]) for part in parts)
