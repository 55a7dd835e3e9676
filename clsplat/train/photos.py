"""Training photos: decoded once and kept on the device while they fit, else read ahead of use."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from clsplat.io.images import read_image

DEVICE_SHARE = 0.25  # of the device's memory that photos may take
THREADS = 2  # each may hold a whole photo as floats


def decode(view):
    """uint8[3, H, W]: the view's photo at its camera's size."""
    pixels = read_image(view.source, (view.camera.width, view.camera.height))
    return np.ascontiguousarray(pixels.transpose(2, 0, 1))


def decoded(views):
    """Yields `decode` of each view, by a few threads; raises InputError at a damaged photo."""
    with ThreadPoolExecutor(THREADS) as threads:
        yield from threads.map(decode, views)


class Photos:
    """`photos[i]` is view i's photo as uchar[3, H, W] on the device.

    views: Views whose cameras have the size wanted; budget_bytes: what may stay on the device, by
    default a quarter of its memory. Within it all are decoded at once, so that a damaged photo is
    refused before a run begins; past it each is decoded anew at each use, one ahead in a thread:
    `expect` says which comes next.
    """

    def __init__(self, device, views, budget_bytes=None):
        self.device, self.views = device, views
        total = sum(3 * view.camera.width * view.camera.height for view in views)
        budget = (DEVICE_SHARE * device.handle.global_mem_size if budget_bytes is None
                  else budget_bytes)
        self.resident = total <= budget
        self._arrays = [device.upload(p) for p in decoded(views)] if self.resident else []
        self._ahead = {}
        self._thread = ThreadPoolExecutor(1)

    def expect(self, index):
        """Begin decoding a photo that will be asked for soon."""
        if not self.resident and index not in self._ahead:
            self._ahead[index] = self._thread.submit(decode, self.views[index])

    def __getitem__(self, index):
        if self.resident:
            return self._arrays[index]
        pending = self._ahead.pop(index, None)
        return self.device.upload(pending.result() if pending else decode(self.views[index]))

    def close(self):
        self._thread.shutdown(wait=False, cancel_futures=True)
