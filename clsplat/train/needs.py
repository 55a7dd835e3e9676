"""What this scene needs of what is optional, found out before training, with the reasons."""

import dataclasses

import numpy as np

from clsplat.drift import DRIFTS, exposure_drift
from clsplat.errors import InputError
from clsplat.neighbours import adjacent_views
from clsplat.train.photos import at_level, decoded

LOOKED_AT = 64  # photos that stand for all
SMALL_SIDE = 256  # pixels; brightness needs no more


@dataclasses.dataclass(frozen=True, eq=False)
class Needs:
    """options: TrainOptions in which nothing is "auto"; neighbours: of each training view, the
    indices of adjacent ones, or None where nothing asks for them; reasons: option -> sentence."""

    options: object
    neighbours: list | None
    reasons: dict

    @property
    def found(self):
        """What `auto` came to, for the record."""
        return {name: getattr(self.options, name) for name in self.reasons}


def find_needs(scene, views, options):
    """The Needs of a training on `views` of `scene`; InputError where an option cannot be met."""
    exposure, exposure_reason = _exposure(scene, views, options)
    neighbours, reproject_reason = _neighbours(scene, views, options)
    options = dataclasses.replace(options, exposure=exposure,
                                  reproject="off" if neighbours is None else "on")
    return Needs(options, neighbours, {"exposure": exposure_reason, "reproject": reproject_reason})


def _exposure(scene, views, options):
    """("on" or "off", why)."""
    if options.exposure != "auto":
        return options.exposure, f"{options.exposure}: asked for"
    chosen = views[::-(-len(views) // LOOKED_AT)]
    side = max(max(v.camera.width, v.camera.height) for v in chosen)
    small = at_level(chosen, max(1.0, side / SMALL_SIDE))
    drift = exposure_drift(small, decoded(small), scene.points, scene.colours)
    drifts = drift >= DRIFTS
    return "on" if drifts else "off", (
        f"{'on' if drifts else 'off'}: the brightness of {len(chosen)} photos varies by "
        f"{100 * drift:.1f} % ({100 * DRIFTS:.1f} % counts as drift)")


def _neighbours(scene, views, options):
    """(indices of adjacent views by view or None, why)."""
    if options.reproject == "off" or not options.reproject_weight:
        return None, "off: not asked for"
    found = adjacent_views(scene, views)
    paired = sum(len(adjacent) > 0 for adjacent in found)
    if paired:
        return found, f"on: {paired} of {len(views)} photos have an adjacent one"
    if options.reproject == "on":
        raise InputError(f"{scene.name}: --reproject on needs two photos that share 20 sparse "
                         "points; there are none: use --reproject auto or off")
    return None, "off: no two photos share 20 sparse points"


def smallest_size(views):
    """(width, height) of the training image with the shortest side, pixels."""
    sizes = [(view.camera.width, view.camera.height) for view in views]
    return sizes[int(np.argmin([min(size) for size in sizes]))]
