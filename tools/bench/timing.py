"""Wall times of work on a device."""

import time

import numpy as np


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


def spread(times):
    """{median_ms, quartiles_ms: [lower, upper], repeats} of milliseconds."""
    low, median, high = np.percentile(times, (25, 50, 75))
    return {"median_ms": round(float(median), 4),
            "quartiles_ms": [round(float(low), 4), round(float(high), 4)], "repeats": len(times)}
