"""The list of the terms of the training loss."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clsplat.device import Device
from clsplat.loss.depth_map import DepthMaps
from clsplat.loss.image_loss import ImageLoss
from clsplat.loss.reproject import Reprojection
from clsplat.loss.term import LossTerm

if TYPE_CHECKING:
    from clsplat.options import TrainOptions

TERMS: tuple[type[LossTerm], ...] = (
    ImageLoss,
    Reprojection,
    DepthMaps,
)


def terms_of(device: Device, options: TrainOptions) -> list[LossTerm]:
    """The terms of a training with these options."""
    return [term(device, options) for term in TERMS if term.is_used(options)]
