"""Timing and reporting shared by the benchmarks."""

import argparse
import json
import time

import numpy as np

from clsplat.device import choose_device


def arguments(argv, description, **defaults):
    """Parsed --json, --device, --form, --repeats and one --NAME for each default."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", action="store_true", help="JSON lines instead of a table")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--form", default="auto", choices=("auto", "item", "group"))
    parser.add_argument("--repeats", type=int, default=20)
    for name, default in defaults.items():
        flag = "--" + name.replace("_", "-")
        if isinstance(default, bool):
            parser.add_argument(flag, action="store_true")
        else:
            kind = type(default[0]) if isinstance(default, list) else type(default)
            parser.add_argument(flag, default=default, type=kind,
                                nargs="+" if isinstance(default, list) else None)
    return parser.parse_args(argv)


def open_device(options, **more):
    return choose_device(options.device, form=options.form, **more)


def milliseconds(device, function, repeats, warm_up=3):
    """Wall times float[repeats] of `function()` including its completion on the device."""
    for _ in range(warm_up):
        function()
    device.finish()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        device.finish()
        times.append((time.perf_counter() - begin) * 1e3)
    return np.array(times)


def report(options, device, family, case, times, **counts):
    """Print one result: a JSON line, or a line of a table.

    counts: what the case amounts to; `bytes`, read and written, also gives the rate.
    """
    low, median, high = np.percentile(times, (25, 50, 75))
    if "bytes" in counts:
        counts["gb_s"] = round(counts["bytes"] / float(median) / 1e6, 1)
    if options.json:
        print(json.dumps({
            "family": family, "case": case, "form": device.form, "device": device.name,
            "driver": device.handle.driver_version, "median_ms": round(float(median), 4),
            "quartiles_ms": [round(float(low), 4), round(float(high), 4)], "repeats": len(times),
            **counts}), flush=True)
    else:
        extra = ", ".join(f"{k} {v:,}" if isinstance(v, int) else f"{k} {v}"
                          for k, v in counts.items())
        print(f"{family:12} {case:28} {median:9.3f} ms  ({low:.3f} to {high:.3f})  {extra}",
              flush=True)
