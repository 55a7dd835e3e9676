"""Wall times of functions on their devices, taken in turn."""

import time

import numpy as np


def in_turn(tasks, repeats, warm_up=3):
    """Wall times of several (device or whatever has `finish`, function) pairs, float64[len(tasks),
    repeats], milliseconds.

    They run one after the other in each round, so that other work on the machine disturbs all of
    them alike.
    """
    times = np.empty((len(tasks), warm_up + repeats))
    for turn in range(warm_up + repeats):
        for number, (device, function) in enumerate(tasks):
            start = time.perf_counter()
            function()
            device.finish()
            times[number, turn] = (time.perf_counter() - start) * 1e3
    return times[:, warm_up:]


def spread(times):
    """The fields median_ms, quartiles_ms (lower, upper) and repeats of a record."""
    low, median, high = np.percentile(times, (25, 50, 75))
    return {
        "median_ms": round(float(median), 4),
        "quartiles_ms": [round(float(low), 4), round(float(high), 4)],
        "repeats": len(times),
    }
