"""The device memory that a training will take at most, by counting.

Its steps are taken on a device that only counts (dry.py), along the course that its schedule is
expected to go, from the first level to the last. How many splats and pairs a frame has is measured
on the real device, on strewn gaussians.
"""

import math
from dataclasses import dataclass

import numpy as np

from clsplat.estimate.dry_run import DryDevice
from clsplat.estimate.trial_steps import Rehearsal, settled, spread_out, strewn
from clsplat.rendering.pipeline import Renderer
from clsplat.training.photos import DEVICE_SHARE, at_level

VIEWS = 48  # whose frames stand for all
STREWN = 200_000  # gaussians at most that are rendered; more are extrapolated to


@dataclass(frozen=True)
class Memory:
    """Bytes. total: at most, while the model grows; steps: at most after a step, which is what
    metrics.jsonl has; photos: of them, those at the level with most, and whether they stay on the
    device (resident) at every level; model: parameters and moments at the end."""

    total: int
    steps: int
    photos: int
    resident: bool
    model: int


class Frames:
    """How many splats and pairs the views have, as a power law between two counts of gaussians."""

    def __init__(self, device, scene, views, options, level, counts):
        self.indices = spread_out(len(views), VIEWS)
        renderer = Renderer(device, 0, options.near or scene.near_plane, options.antialiased)
        shown = at_level(views, level)
        measured = []
        for count in sorted({min(count, STREWN) for count in counts}):
            cameras = [shown[index].camera for index in self.indices]
            rows = {name: device.upload(values)
                    for name, values in strewn(scene, count, 0).rows.items()}
            found = [settled(renderer, rows, camera) for camera in cameras]
            measured.append((count, np.maximum(found, 1)))
        self.count, self.found = measured[0]
        self.power = np.ones_like(self.found, float)
        if len(measured) > 1:
            ratio = np.log(measured[1][1] / self.found) / math.log(measured[1][0] / self.count)
            self.power = ratio.clip(0, 1)

    def at(self, count):
        """int[K, 2]: (splats, pairs) of each of `indices`."""
        return (self.found * (count / self.count) ** self.power).astype(int)


def predicted_memory(device, scene, views, needs, gaussians, stretches):
    """The Memory of a training on `device`.

    scene: Scene as trained on; views: its training views; needs: train.needs.Needs; gaussians: the
    initial ones; stretches: of its course. Raises DeviceError where a buffer would be too large.
    """
    dry = DryDevice(device)
    rehearsal = Rehearsal(dry, scene, views, needs, gaussians, _blank)
    photo_budget = DEVICE_SHARE * device.handle.global_mem_size
    total = steps = most_photos = 0
    level, all_resident = None, True
    for stretch in stretches:
        if stretch.level != level:
            level = stretch.level
            counts = [s.gaussians for s in stretches if s.level == level]
            frames = Frames(device, scene, views, needs.options, level, (min(counts), max(counts)))
            rehearsal.use(level)
            photos = sum(3 * v.camera.width * v.camera.height for v in at_level(views, level))
            all_resident &= photos <= photo_budget
            photos *= photos <= photo_budget
            most_photos = max(most_photos, photos)
            dry.peak_bytes = 0
        if stretch.gaussians != rehearsal.step.model.count:
            rehearsal.grow(stretch.gaussians)
        for index, (visible, pairs) in zip(frames.indices, frames.at(stretch.gaussians)):
            dry.visible, dry.pairs = int(visible), int(pairs)
            rehearsal.prepare(index, stretch.regularises)()
        total = max(total, dry.peak_bytes + photos)
        steps = max(steps, dry.memory_bytes + photos)
    model, adam = rehearsal.step.model, rehearsal.step.model.adam
    arrays = [*model.rows.values(), *adam.m.values(), *adam.v.values()]
    held = sum(array.nbytes for array in arrays if hasattr(array, "buffer"))
    return Memory(total, steps, most_photos, all_resident, held)


def _blank(device, view):
    return device.hold((3, view.camera.height, view.camera.width), np.uint8)
