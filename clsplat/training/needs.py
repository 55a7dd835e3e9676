"""What this scene needs of what is optional, found out before training, with the reasons."""

import dataclasses
import math

import numpy as np

from clsplat.config.option import AUTO
from clsplat.covisibility.exposure_drift import DRIFTS, exposure_drift
from clsplat.covisibility.source_views import choose_source_views, view_spread
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED
from clsplat.schedule import Subject, schedule_of
from clsplat.schedule.course import course, largest
from clsplat.training.model import DEVICE_SHARE, GROWTH_ROOM
from clsplat.training.photos import at_level, decoded

LOOKED_AT = 64  # photos that stand for all
SMALL_SIDE = 256  # pixels; brightness needs no more
HIGHEST_DEGREE = 3
SHINE = 0.1  # amplitude of what depends on the direction, of full brightness
VISIBLE = 1 / 255  # of full brightness: a step of 8 bits
SHARE = 0.99  # of the points that a degree must serve


@dataclasses.dataclass(frozen=True)
class Part:
    """One decision. value: what is used; reason: a sentence that begins with it, and has the number
    behind it; asked: whether an option overrode what would have been found."""

    value: object
    reason: str
    asked: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Needs:
    """options: TrainOptions in which nothing is "auto" that the scene decides; neighbours: of each
    training view, the indices of adjacent ones, or None where nothing asks for them; parts: name
    -> Part."""

    options: object
    neighbours: list | None
    parts: dict

    @property
    def reasons(self):
        """Part -> sentence."""
        return {name: part.reason for name, part in self.parts.items()}

    @property
    def found(self):
        """Part -> what is used, for the record; what was asked for stands in the options."""
        return {name: part.value for name, part in self.parts.items()}


def find_needs(scene, views, options, device=None):
    """The Needs of a training on `views` of `scene`; InputError where an option cannot be met.

    options: TrainOptions with scaled steps; device: that of the training. Without it, where the
    moments are kept is left to train.model.Model, which knows the initial gaussians only.
    """
    exposure = _exposure(scene, views, options)
    neighbours, reproject = _neighbours(scene, views, options)
    spread = view_spread(scene, scene.views)  # of all views: held-out ones are to be met, too
    parts = {"levels": _levels(views, options), "sh_degree": _degree(spread, options),
             "antialiased": _antialiased(spread, options), "exposure": exposure,
             "reproject": reproject}
    decided = ("sh_degree", "exposure", "reproject")
    options = dataclasses.replace(options, **{name: parts[name].value for name in decided})
    if device is not None:
        parts["engine"] = _engine(scene, views, options, device)
        options = dataclasses.replace(options, engine=parts["engine"].value)
    return Needs(options, neighbours, parts)


def needed_degree(cap):
    """The lowest degree of harmonics with which colours seen from within `cap` degrees of a middle
    direction are right to a step of 8 bits.

    A colour that harmonics up to L describe changes by at most L^k times its amplitude in k
    derivatives (Bernstein's inequality), so what its Taylor polynomial of degree n leaves over, a
    cap's radius r away, is at most amplitude (L r)^(n + 1) / (n + 1)!; harmonics of degree n hold
    that polynomial. L is 3, the amplitude a tenth of full brightness: 0.7, 5.3 and 11.8 degrees are
    the limits of 0, 1 and 2.
    """
    reach = HIGHEST_DEGREE * math.radians(cap)
    for degree in range(HIGHEST_DEGREE):
        if SHINE * reach ** (degree + 1) / math.factorial(degree + 1) <= VISIBLE:
            return degree
    return HIGHEST_DEGREE


def _asked(value):
    return Part(value, f"{value}: asked for", asked=True)


def _levels(views, options):
    """Those that the schedule will take."""
    return Part(*schedule_of(options.schedule).planned_levels(options, smallest_size(views)))


def _degree(spread, options):
    """Of the harmonics."""
    if options.sh_degree == HIGHEST_DEGREE:
        return Part(HIGHEST_DEGREE, f"{HIGHEST_DEGREE}: all, the default")
    if options.sh_degree != AUTO:
        return _asked(options.sh_degree)
    if not len(spread.cap):
        return Part(HIGHEST_DEGREE, f"{HIGHEST_DEGREE}: no point is seen by two views, nothing is "
                    "known of angles")
    cap = float(np.quantile(spread.cap, SHARE))
    degree = needed_degree(cap)
    return Part(degree, f"{degree}: {SHARE:.0%} of the points are seen from within {cap:.1f} "
                "degrees of their mean direction")


def _antialiased(spread, options):
    """Nothing decides it: it is on where asked for. The number is what it has to do with."""
    value = "on" if options.antialiased else "off"
    ratios = spread.ratio[np.isfinite(spread.ratio)]
    seen = (f"; nine points in ten are seen at scales within a factor of "
            f"{np.quantile(ratios, 0.9):.1f}" if len(ratios) else "")
    return Part(value, f"{value}: {'' if options.antialiased else 'not '}asked for{seen}",
                asked=options.antialiased)


def _exposure(scene, views, options):
    if options.exposure != AUTO:
        return _asked(options.exposure)
    chosen = views[::-(-len(views) // LOOKED_AT)]
    side = max(max(v.camera.width, v.camera.height) for v in chosen)
    small = at_level(chosen, max(1.0, side / SMALL_SIDE))
    drift = exposure_drift(small, decoded(small), scene.points, scene.colours)
    value = "on" if drift >= DRIFTS else "off"
    return Part(value, f"{value}: the brightness of {len(chosen)} photos varies by "
                f"{100 * drift:.1f} % ({100 * DRIFTS:.1f} % counts as drift)")


def _neighbours(scene, views, options):
    """(indices of adjacent views by view or None, Part)."""
    if options.reproject == "off" or not options.reproject_weight:
        return None, Part("off", "off: not asked for")
    found = choose_source_views(scene, views)
    paired = sum(len(adjacent) > 0 for adjacent in found)
    if paired:
        return found, Part("on", f"on: {paired} of {len(views)} photos have an adjacent one",
                           asked=options.reproject == "on")
    if options.reproject == "on":
        raise InputError(f"{scene.name}: --reproject on needs two photos that share 20 sparse "
                         "points; there are none: use --reproject auto or off")
    return None, Part("off", "off: no two photos share 20 sparse points")


def _engine(scene, views, options, device):
    """Where the moments are kept: by the most gaussians there will be, and room to grow."""
    if options.engine != AUTO:
        return _asked(options.engine)
    count = largest(course(schedule_of(options.schedule)(
        options, subject_of(scene, views, photos=tuple))))
    floats = sum(field.width(options.sh_degree) for field in LEARNED)
    needed = 3 * floats * GROWTH_ROOM * count * device.real.itemsize
    there = device.handle.global_mem_size
    value = "device" if needed < DEVICE_SHARE * there else "numpy"
    return Part(value, f"{value}: parameters and moments take up to {needed / 2**20:,.0f} MiB of "
                f"the device's {there / 2**20:,.0f}")


def subject_of(scene, views, photos=None, inverse_distance=1.0):
    """The Subject that a schedule is told of; photos: as there, by default those of `views`."""
    return Subject(smallest_size(views), len(scene.points), inverse_distance,
                   photos or (lambda: decoded(views)),
                   sum(view.camera.width * view.camera.height for view in views))


def smallest_size(views):
    """(width, height) of the training image with the shortest side, pixels."""
    sizes = [(view.camera.width, view.camera.height) for view in views]
    return sizes[int(np.argmin([min(size) for size in sizes]))]
