"""Predicts the largest device memory of a training, the sum of the arrays that it allocates.

Persistent arrays are listed by their owners (`Model.arrays` and the like), those of a step in
`rendering.frame_arrays`, by the losses and by the optimiser. The numbers of splats and pairs of a
frame are measured with sampled gaussians.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from clsplat.densify.statistics import Statistics
from clsplat.device import ArraySpec, Device
from clsplat.device.arena import Arena, Block
from clsplat.estimate.trial_steps import PAIRS_A_SPLAT, sampled, settled, spread_out
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.loss import depth_map, image_loss, reproject
from clsplat.loss.exposure import Exposures
from clsplat.optimise.batch import BatchMean
from clsplat.optimise.pose import Poses
from clsplat.partition.surroundings import Sides
from clsplat.rendering.bands import pair_limit
from clsplat.rendering.bin import steps_of, tile_grid
from clsplat.rendering.frame_arrays import STAGES, FrameArray, FrameSize, frame_arrays
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import CAMERA
from clsplat.scene import View
from clsplat.schedule.simulate import Segment
from clsplat.training.layers import Front, layer_array
from clsplat.training.model import ENGINES, Model
from clsplat.training.parts.depth_maps import depth_array
from clsplat.training.parts.exposures import lenses_of
from clsplat.training.parts.reprojection import SourceViews
from clsplat.training.photos import DEVICE_SHARE, at_level, photo_array
from clsplat.training.prepare import PreparedScene
from clsplat.training.rooms import pairs_room, shared_pairs, visible_room
from clsplat.training.units import COUNTS

SAMPLED_VIEWS = 48
MOST_SAMPLED = 200_000  # gaussians that are rendered; larger numbers are extrapolated


@dataclass(frozen=True)
class Memory:
    """Bytes of device memory.

    Attributes
    ----------
    total : the most, while the model grows.
    steps : the most after a step, which metrics.jsonl records.
    photos : photos of the level with most, which are part of it.
    resident : whether photos stay on the device at every level.
    model : parameters and moments at the end.
    """

    total: int
    steps: int
    photos: int
    resident: bool
    model: int


class Frames:
    """Numbers of splats and pairs of views, as power laws through two numbers of gaussians.

    Attributes
    ----------
    indices : the sampled views.
    """

    def __init__(self, device: Device, prepared: PreparedScene, level: float,
                 counts: Iterable[int]) -> None:
        self.indices = spread_out(len(prepared.train_views), SAMPLED_VIEWS)
        renderer = Renderer(device, 0, prepared.near, prepared.options.antialiased)
        shown = at_level(prepared.train_views, level)
        measured = []
        for count in sorted({min(count, MOST_SAMPLED) for count in counts}):
            rows = {name: device.upload(values)
                    for name, values in sampled(prepared.scene, count, 0).rows.items()}
            sizes = [settled(renderer, rows, shown[index].camera) for index in self.indices]
            measured.append((count, np.maximum(sizes, 1)))
        self.count, self.sizes = measured[0]
        self.power = np.ones_like(self.sizes, float)
        if len(measured) > 1:
            ratio = np.log(measured[1][1] / self.sizes) / math.log(measured[1][0] / self.count)
            self.power = ratio.clip(0, 1)

    def at(self, count: int) -> list[list[int]]:
        """[[splats, pairs], ...] of `indices`, with `count` gaussians."""
        sizes = self.sizes * (count / self.count) ** self.power
        pairs: list[list[int]] = np.minimum(sizes, [count, np.inf]).astype(int).tolist()
        return pairs


class Pool:
    """The bytes that the device's arena keeps for short-lived arrays.

    Parameters
    ----------
    real : the device's real type.
    exact : whether blocks have the sizes of arrays, as in recordings.
    """

    def __init__(self, real: np.dtype, exact: bool) -> None:
        self._real, self._exact = real, exact
        self._arena = Arena(lambda size: None)

    def add(self, arrays: Sequence[FrameArray]) -> None:
        """Allocate the arrays of a step, each while it is alive."""
        alive: list[tuple[FrameArray, Block]] = []
        for stage in STAGES:
            alive += [(array, self._arena.allocate(array.nbytes(self._real), self._exact))
                      for array in arrays if array.first == stage]
            alive = [(array, block) for array, block in alive if array.last != stage]

    @property
    def nbytes(self) -> int:
        """Bytes kept."""
        return self._arena.managed_bytes


def predicted_memory(device: Device, prepared: PreparedScene, gaussians: Gaussians,
                     segments: Sequence[Segment]) -> Memory:
    """Predict the device memory of a training; DeviceError if an array would be too large.

    Parameters
    ----------
    device : of the training.
    prepared : the scene.
    gaussians : the initial ones.
    segments : the simulated run.
    """
    options, views = prepared.options, prepared.train_views
    names = list(gaussians.rows)
    neighbours = prepared.decisions.parts["reproject"].found
    pool = Pool(device.real, ENGINES[options.engine].RECORDS)
    photo_budget = DEVICE_SHARE * device.handle.global_mem_size
    total = steps = most_photos = 0
    level, count, resident = None, gaussians.count, True

    def model_of(count: int) -> list[ArraySpec]:
        return model_arrays(names, options.sh_degree, count, options.engine)

    for segment in segments:
        if segment.level != level:
            level, pool = segment.level, Pool(device.real, ENGINES[options.engine].RECORDS)
            counts = [s.gaussians for s in segments if s.level == level]
            frames = Frames(device, prepared, level, (min(counts), max(counts)))
            shown = at_level(views, level)
            sizes = [spec.nbytes(device.real) for view in shown
                     for spec in (photo_array(view), depth_array(view)) if spec]
            fits = sum(sizes) <= photo_budget
            photos = sum(sizes) if fits else max(sizes)
            resident &= fits
            most_photos = max(most_photos, photos * fits)
            if prepared.surroundings:
                drawn, drawing = layer_bytes(device, prepared, shown, photo_budget - sum(sizes))
                photos += drawn  # they come and go with photos
                total = max(total, photos + drawing + (
                    0 if steps == 0 else _bytes(device, model_of(count))))
        others = photos + _bytes(device, other_arrays(prepared, segment.gaussians))
        if segment.gaussians != count:
            growing = _while_replaced(device, model_of(count), model_of(segment.gaussians))
            total = max(total, others + growing + ArraySpec((segment.gaussians,)).nbytes(
                np.dtype(np.uint32)))
            count, pool = segment.gaussians, Pool(device.real, ENGINES[options.engine].RECORDS)
        results = dict[tuple[int, int], int]()  # size of an image -> bytes
        for index, size in zip(frames.indices, _sizes(device, prepared, shown, frames, count)):
            has_source = bool(segment.regularises and neighbours and neighbours[index])
            has_map = bool(shown[index].depth and options.depth_weight)
            pool.add(step_arrays(device, prepared, size, has_source, has_map))
            image = size.width, size.height
            results[image] = max(results.get(image, 0), _bytes(device, result_arrays(
                device, prepared, *image, has_source, has_map)))
        steps = max(steps, others + _bytes(device, model_of(count)) + pool.nbytes
                    + sum(results.values()))
    return Memory(max(total, steps), steps, most_photos, resident,
                  _bytes(device, model_of(count)))


def layer_bytes(device: Device, prepared: PreparedScene, shown: Sequence[View], spare: float
                ) -> tuple[int, int]:
    """Bytes of the layers of a level, and of what is in memory only while they are drawn.

    The first are an upper bound: all that is in front of the block counts as visible.

    Parameters
    ----------
    device, prepared : of the training of a block that has surroundings.
    shown : the training views at the level.
    spare : bytes that layers may take.
    """
    around = prepared.surroundings
    assert around is not None
    near, most = prepared.near, 0
    sizes, widest = [], max(shown, key=lambda view: view.camera.width * view.camera.height)
    sides, front = Sides(prepared.scene, around.positions), Front(around, near)
    for view in shown:
        behind = sides.behind(view.camera.position)
        sizes.append(layer_array(view, front.is_shown(view, behind)).nbytes(device.real))
        most = max(most, int(behind.sum()), int((~behind).sum()))
    count = sum(layer_array(view, True).nbytes(device.real) for view in shown)
    size = FrameSize(most, most, int(PAIRS_A_SPLAT * most) + 1, widest.camera.width,
                     widest.camera.height)
    pool = Pool(device.real, False)
    pool.add([array for array in frame_arrays(device, size, around.sh_degree)
              if STAGES.index(array.first) <= STAGES.index("blend")])
    rows = Model.arrays([field.name for field in LEARNED], around.sh_degree, around.count)
    return (sum(sizes) if count <= spare else max(sizes),
            _bytes(device, list(rows.values())) + pool.nbytes)


def model_arrays(names: Iterable[str], sh_degree: int, count: int,
                 engine: str) -> list[ArraySpec]:
    """The arrays of rows and moments, in the order in which growth replaces them."""
    rows = Model.arrays(names, sh_degree, count)
    learned = {field.name: rows[field.name] for field in LEARNED}
    moments_of = ENGINES[engine].arrays(learned)
    return [spec for fields in (rows, *moments_of) for spec in fields.values()]


def other_arrays(prepared: PreparedScene, count: int) -> list[ArraySpec]:
    """The other persistent arrays with `count` gaussians, without photos."""
    options, views, scene = prepared.options, prepared.train_views, prepared.scene
    neighbours = prepared.decisions.parts["reproject"].found
    rows = Model.arrays([field.name for field in LEARNED], options.sh_degree, count)
    return [*Statistics.arrays(count).values(), *Renderer.ARRAYS, *len(views) * [CAMERA], COUNTS,
            *(BatchMean.arrays(rows).values() if options.batch > 1 else ()),
            *(Exposures.arrays(len(views), _lenses(prepared)).values()
              if _exposes(prepared) else ()),
            *(Poses.arrays(len(views)).values() if options.poses == "on" else ()),
            *(SourceViews.arrays(neighbours).values() if neighbours else ()),
            *([ArraySpec((count,), np.uint32)] if scene.region else ())]  # Step.frozen


def _exposes(prepared: PreparedScene) -> bool:
    """Whether views have responses: those with layers need one, as a step puts them in front there.
    """
    return prepared.options.exposure == "on" or prepared.scene.surroundings is not None


def _lenses(prepared: PreparedScene) -> int:
    """Lenses on the device, of which one is a token where nothing is learned of them."""
    lenses = lenses_of(prepared.scene, prepared.train_views, prepared.options)
    return len(lenses.rows) if lenses else 1


def result_arrays(device: Device, prepared: PreparedScene, width: int, height: int,
                  has_source: bool, has_map: bool) -> list[ArraySpec]:
    """What recorded steps keep between two replays, for images of one size in one band."""
    options = prepared.options
    if not ENGINES[options.engine].RECORDS:
        return []
    return options.batch * [
        *steps_of(device, math.prod(tile_grid(device, width, height))),
        *_term_results(device, width, height, has_source, has_map)]


def _term_results(device: Device, width: int, height: int, has_source: bool, has_map: bool
                  ) -> list[ArraySpec]:
    return [*image_loss.result_arrays(device, width, height),
            *(has_source + has_map) * [ArraySpec((2,))]]


def step_arrays(device: Device, prepared: PreparedScene, size: FrameSize,
                has_source: bool, has_map: bool) -> list[FrameArray]:
    """The short-lived arrays of a step on a view.

    Parameters
    ----------
    device, prepared : the device and the scene of the training.
    has_source, has_map : whether the view is compared with a source view and with a depth map.
    size : of the frame; where steps are recorded, the sizes of its Room (rooms.py).
    """
    options = prepared.options
    exposes, count, seen = _exposes(prepared), size.gaussians, size.splats
    degree, image = options.sh_degree, (size.width, size.height)
    arrays = frame_arrays(device, size, degree, has_source or has_map)
    arrays += image_loss.frame_arrays(device, *image, "exposure" if exposes else "project adjoint")
    arrays += reproject.frame_arrays(*image) if has_source else []
    arrays += depth_map.frame_arrays(*image) if has_map else []
    if exposes:
        arrays += Exposures.frame_arrays(*image, options.vignetting == "on")
    if options.poses == "on":
        arrays += Poses.frame_arrays(seen)
    if not ENGINES[options.engine].RECORDS:
        arrays = [array._replace(shape=(count,)) if array.name == "visible" else array
                  for array in arrays]  # without a Room: one slot a gaussian
        arrays += [FrameArray("result", *spec, "loss", "adam")
                   for spec in _term_results(device, *image, has_source, has_map)]
    if options.batch > 1:
        rows = Model.arrays([field.name for field in LEARNED], degree, count)
        arrays += BatchMean.frame_arrays(count, seen, rows)
    for array in arrays:
        device.check_size(array.nbytes(device.real))
    return arrays + ENGINES[options.engine].frame_arrays(count, seen, degree,
                                                         options.optimizer == "dense")


def _sizes(device: Device, prepared: PreparedScene, shown: Sequence[View], frames: Frames,
           count: int) -> list[FrameSize]:
    """The sizes of the frames of the sampled views, with `count` gaussians."""
    cameras = [shown[index].camera for index in frames.indices]
    exact = [FrameSize(count, splats, pairs, camera.width, camera.height)
             for camera, (splats, pairs) in zip(cameras, frames.at(count))]
    limits = [pair_limit(device, size.width, size.height, True) for size in exact]
    if not ENGINES[prepared.options.engine].RECORDS:
        return [size._replace(pairs=min(size.pairs, limit)) for size, limit in zip(exact, limits)]
    visible = visible_room(max(size.splats for size in exact), count)
    most = {size[3:]: max(other.pairs for other in exact if other[3:] == size[3:])
            for size in exact}
    tiles = max(math.prod(tile_grid(device, *size)) for size in most)
    found = []
    for size, limit in zip(exact, limits):
        pairs = most[size[3:]]
        if pairs <= limit:
            pairs = shared_pairs(most.values(), limit)
        found.append(size._replace(splats=visible, pairs=pairs_room(pairs, tiles, limit)))
    return found


def _bytes(device: Device, specs: Sequence[ArraySpec]) -> int:
    for spec in specs:
        device.check_size(spec.nbytes(device.real))
    return sum(spec.nbytes(device.real) for spec in specs)


def _while_replaced(device: Device, old: Sequence[ArraySpec], new: Sequence[ArraySpec]) -> int:
    """The most bytes while each array is replaced by a new one in turn."""
    used, most = _bytes(device, old), 0
    for before, after in zip(old, new):
        used += after.nbytes(device.real)
        most = max(most, used)
        used -= before.nbytes(device.real)
    return most
