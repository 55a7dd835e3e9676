"""The parts that clsplat brings, in the order in which a step calls them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clsplat.loss.options import REGISTERED
from clsplat.training.part import Part
from clsplat.training.parts.average import Average
from clsplat.training.parts.depth_maps import DepthMaps
from clsplat.training.parts.entering_points import EnteringPoints
from clsplat.training.parts.exposures import PhotoResponses
from clsplat.training.parts.image_term import ImageTerm
from clsplat.training.parts.mcmc import PositionNoise, Regularisers
from clsplat.training.parts.outlier_masks import OutlierMasks
from clsplat.training.parts.poses import CameraPoses
from clsplat.training.parts.reprojection import Reprojection

if TYPE_CHECKING:
    from clsplat.training.start.prepare import PreparedScene

PARTS: tuple[type[Part], ...] = (
    CameraPoses,
    PhotoResponses,
    ImageTerm,
    Reprojection,
    DepthMaps,
    Regularisers,
    PositionNoise,
    OutlierMasks,
    EnteringPoints,
    Average,
)


def parts_of(prepared: PreparedScene) -> list[Part]:
    """The parts of a training: those that its options ask for, and those that were given, of which
    one with the name of another takes its place."""
    registered = [registered_part(name) for name in prepared.options.add_parts]
    own = [kind() for kind in (*PARTS, *registered) if kind.is_used(prepared)]
    return list({part.name: part for part in (*own, *prepared.given)}.values())


def registered_part(name: str) -> type[Part]:
    """The class of a part that another package registers; InputError if it does not load."""
    return REGISTERED.load(name, Part)
