"""Trial steps before a training, in a session of its own with sampled gaussians."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from clsplat.camera import Camera
from clsplat.device import Array, Device
from clsplat.gaussians import Gaussians
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import Scene, View
from clsplat.schedule.plan import Plan
from clsplat.training.photos import Photos, at_level, decode
from clsplat.training.session import Session

PAIRS_A_SPLAT, PAIRS_A_TILE = 1.62, 114
LOG_SIZE, HALVINGS = 2.0, 6  # search range +-LOG_SIZE of the log size, and its number of halvings


class TrialSteps:
    """Takes steps of a session, one view at a time.

    Attributes
    ----------
    session : the session.
    plan : of every step, with all spherical harmonics and statistics; may be replaced.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.plan = Plan(
            level=session.level,
            degree=session.options.sh_degree,
            gathers=True,
            grows=False,
            resets_opacity=False,
            prunes_large=False,
            decay=0.0,
            regularises=0.0,
        )

    def prepare(self, index: int, regularises: bool = False) -> Callable[[], object]:
        """Return a function that takes a step on a view, whose photo is on the device already.

        A batch consists of this view only.
        """
        session, plan = self.session, replace(self.plan, regularises=float(regularises))
        samples = session.options.batch * [session.sample(index, 1)]

        def take() -> object:
            session.iteration += 1
            return session.step.run(session.iteration, plan, samples)

        return take

    def finish(self) -> None:
        """Wait until all steps are done, also those that had to be repeated."""
        self.session.step.settle()


class SizedPhotos(Photos):
    """Photos where only the sizes of photos matter.

    One photo of each size is read and used for all views of that size.
    """

    resident, folder = True, None

    def __init__(self, device: Device, views: Sequence[View], level: float) -> None:
        self.device, self.level = device, level
        self.views = at_level(views, level)
        self._photos: dict[tuple[int, int], Array] = {}

    def use(self, level: float) -> None:
        """Do nothing, as there is a single level."""

    def __getitem__(self, index: int) -> Array:
        view = self.views[index]
        size = view.camera.width, view.camera.height
        if size not in self._photos:
            self._photos[size] = self.device.upload(decode(view))
        return self._photos[size]

    @property
    def nbytes(self) -> int:
        """Device memory of the photos so far."""
        return sum(photo.nbytes for photo in self._photos.values())


def sampled(scene: Scene, count: int, sh_degree: int) -> Gaussians:
    """Sample `count` gaussians that resemble a model after growth.

    These are the sparse points, or some of them, and more points within half their distance to each
    other. Sizes follow the distances.
    """
    points, colours = scene.points, scene.colours
    rng = np.random.default_rng(0)
    if count < len(points):
        chosen = rng.choice(len(points), count, replace=False)
        points, colours = points[chosen], colours[chosen]
    elif count > len(points):
        sizes = np.exp(Gaussians.from_points(points, colours, 0).log_scales)
        chosen = rng.integers(0, len(points), count - len(points))
        moved = points[chosen] + 0.5 * sizes[chosen] * rng.normal(size=(len(chosen), 3))
        points = np.concatenate([points, moved])
        colours = np.concatenate([colours, colours[chosen]])
    return Gaussians.from_points(points, colours, sh_degree)


def sized(gaussians: Gaussians, renderer: Renderer, cameras: Sequence[Camera]) -> Gaussians:
    """Scale all gaussians by one factor, so that the frames have as many pairs as trained ones.

    Pairs are counted over all cameras; nothing is rendered. With trained models of five scenes
    PAIRS_A_SPLAT and PAIRS_A_TILE were at most 26 % off, in the mean of the views and in the
    largest; sampled gaussians had up to 2.5 times as many pairs.
    """
    low, high = -LOG_SIZE, LOG_SIZE
    packed = [renderer.pack(camera) for camera in cameras]
    rows = {name: renderer.device.upload(values) for name, values in gaussians.rows.items()}
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        log_scales = gaussians.log_scales + np.float32(middle)
        rows["log_scales"].write(log_scales)
        pairs, target = 0, 0.0
        for camera, on_device in zip(cameras, packed):
            splats, counts = renderer.measure(rows, on_device, camera.width, camera.height)
            pairs += int(counts.sum())
            tiles = camera.width * camera.height / renderer.device.tile**2
            target += PAIRS_A_SPLAT * splats + PAIRS_A_TILE * tiles
        low, high = (low, middle) if pairs > target else (middle, high)
    return Gaussians({**gaussians.rows, "log_scales": log_scales}, gaussians.sh_degree)


def spread_out(count: int, most: int) -> list[int]:
    """At most `most` evenly spaced indices below `count`."""
    return sorted(set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()))
