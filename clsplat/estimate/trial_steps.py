"""Steps of a training that is not begun: its own Session, on gaussians sampled about the points."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from clsplat.camera import Camera
from clsplat.device import Array, Device
from clsplat.gaussians import Gaussians
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import Scene, View
from clsplat.schedule import Plan
from clsplat.training.photos import at_level, decode
from clsplat.training.session import PreparedScene, Session

PAIRS_A_SPLAT, PAIRS_A_TILE = 1.62, 114
SIZES, HALVINGS = 2.0, 6  # logarithm of the size looked for, and how often its range is halved


class TrialSteps:
    """Takes steps of a Session, one view at a time.

    Attributes
    ----------
    session : what is stepped with.
    plan : of every step; may be replaced.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.plan = trial_plan(session.options, session.level, False)

    def prepare(self, index: int, regularises: bool = False) -> Callable[[], object]:
        """A function that takes one step on a view, with its photo and camera in place; a batch is
        all of this view."""
        session, plan = self.session, replace(self.plan, regularises=float(regularises))
        samples = session.options.batch * [session.sample(index, 1, plan)]

        def take():
            session.iteration += 1
            return session.step.run(session.iteration, plan, samples)
        return take


def trial_plan(options: TrainOptions, level: float, regularises: bool) -> Plan:
    """The Plan of a step with all harmonics, which gathers statistics."""
    return Plan(level=level, degree=options.sh_degree, gathers=True, grows=False,
                resets_opacity=False, prunes_large=False, decay=0.0,
                regularises=float(regularises))


class SizedPhotos:
    """What `training.photos.Photos` is to a Session, where only the sizes of photos matter: one of
    each size is read, and stands for all."""

    resident = True

    def __init__(self, device: Device, views: Sequence[View], level: float) -> None:
        self.device, self.level = device, level
        self.views = at_level(views, level)
        self._photos: dict[tuple[int, int], Array] = {}

    def use(self, level: float) -> None:
        """There is one level."""

    def __getitem__(self, index: int) -> Array:
        view = self.views[index]
        size = view.camera.width, view.camera.height
        if size not in self._photos:
            self._photos[size] = self.device.upload(decode(view))
        return self._photos[size]


def trial_session(prepared: PreparedScene, device: Device, gaussians: Gaussians,
                  level: float) -> Session:
    """A Session at a level whose photos have the right sizes."""
    return Session(prepared, device, gaussians,
                   photos=SizedPhotos(device, prepared.train_views, level))


def sampled(scene: Scene, count: int, sh_degree: int, seed: int = 0) -> Gaussians:
    """Gaussians, `count` of them, as growth might leave them: the sparse points, or some of them,
    and more within half their distance to each other; sized anew by that distance."""
    points, colours = scene.points, scene.colours
    rng = np.random.default_rng(seed)
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
    """The gaussians made larger or smaller, all alike, so that the cameras' frames have as many
    pairs together as `settled` says. Pairs are counted, nothing is rendered."""
    low, high = -SIZES, SIZES
    packed = [renderer.pack(camera) for camera in cameras]
    rows = {name: renderer.device.upload(values) for name, values in gaussians.rows.items()}
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        log_scales = gaussians.log_scales + np.float32(middle)
        rows["log_scales"].write(log_scales)
        pairs = wanted = 0
        for camera, on_device in zip(cameras, packed):
            splats, found = renderer.count(rows, on_device, camera.width, camera.height)
            pairs += found
            wanted += _settled_pairs(splats, camera, renderer.device)
        low, high = (low, middle) if pairs > wanted else (middle, high)
    return Gaussians({**gaussians.rows, "log_scales": log_scales}, gaussians.sh_degree)


def settled(renderer: Renderer, rows: dict[str, Array], camera: Camera) -> tuple[int, float]:
    """(splats, pairs) of a frame, were the gaussians trained: PAIRS_A_SPLAT a splat and
    PAIRS_A_TILE a tile. Of the trained models of five scenes that was off by 26 % at most, in the
    mean of the views and in the largest; sampled gaussians had up to 2.5 times as many."""
    splats = renderer.count_splats(rows, renderer.pack(camera))
    return splats, _settled_pairs(splats, camera, renderer.device)


def _settled_pairs(splats, camera, device):
    return (PAIRS_A_SPLAT * splats
            + PAIRS_A_TILE * camera.width * camera.height / device.tile**2)


def spread_out(count: int, most: int) -> list[int]:
    """Indices of at most `most` of `count` things, evenly spread."""
    return sorted(set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()))
