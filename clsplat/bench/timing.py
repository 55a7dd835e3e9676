"""Wall times of work on a device."""

import time

import numpy as np


def milliseconds(device, function, repeats, warm_up=3):
    """Wall times float[repeats] of `function()` including its completion on the device."""
    return in_turn([(device, function)], repeats, warm_up)[0]


def in_turn(works, repeats, warm_up=3):
    """Wall times float[len(works), repeats] of several (device, function), one after the other in
    each round, so that what a shared machine does meanwhile meets them alike."""
    times = np.empty((len(works), warm_up + repeats))
    for turn in range(warm_up + repeats):
        for number, (device, function) in enumerate(works):
            begin = time.perf_counter()
            function()
            device.finish()
            times[number, turn] = (time.perf_counter() - begin) * 1e3
    return times[:, warm_up:]


def spread(times):
    """{median_ms, quartiles_ms: [lower, upper], repeats} of milliseconds."""
    low, median, high = np.percentile(times, (25, 50, 75))
    return {"median_ms": round(float(median), 4),
            "quartiles_ms": [round(float(low), 4), round(float(high), 4)], "repeats": len(times)}
