"""Training photos: decoded once and kept on the device while they fit, else read ahead of use."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from clsplat.io.images import read_image

DEVICE_SHARE = 0.25  # of the device's memory that photos may take


def planar(pixels):
    """uint8[3, H, W] from uint8[H, W, 3]."""
    return np.ascontiguousarray(pixels.transpose(2, 0, 1))


class Photos:
    """`photos[i]` is view i's photo as uchar[3, H, W] on the device.

    views: Views whose cameras have the size wanted; budget_bytes: what may stay on the device, by default a
    quarter of its memory. Past it photos are decoded anew at each use, one ahead in a thread:
    `expect` says which comes next.
    """

    def __init__(self, device, views, budget_bytes=None):
        self.device, self.views = device, views
        total = sum(3 * view.camera.width * view.camera.height for view in views)
        budget = DEVICE_SHARE * device.handle.global_mem_size if budget_bytes is None else budget_bytes
        self.resident = total <= budget
        self._arrays = {}
        self._ahead = {}
        self._thread = ThreadPoolExecutor(1)

    def _decode(self, index):
        view = self.views[index]
        return planar(read_image(view.source, (view.camera.width, view.camera.height)))

    def expect(self, index):
        """Begin decoding a photo that will be asked for soon."""
        if index not in self._arrays and index not in self._ahead:
            self._ahead[index] = self._thread.submit(self._decode, index)

    def __getitem__(self, index):
        if index in self._arrays:
            return self._arrays[index]
        pending = self._ahead.pop(index, None)
        photo = self.device.upload(pending.result() if pending else self._decode(index))
        if self.resident:
            self._arrays[index] = photo
        return photo

    def close(self):
        self._thread.shutdown(wait=False, cancel_futures=True)
