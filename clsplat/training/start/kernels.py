"""Which kernels the first steps of a training launch, so that threads can compile them before."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from clsplat.device import Device, Kernel
from clsplat.loss import image_loss
from clsplat.optimise import adam
from clsplat.primitives import compact, gather, reduce, sort
from clsplat.rendering import bin, blend, cull, project
from clsplat.training import frequency
from clsplat.training.parts import parts_of
from clsplat.training.photos import photo_array

if TYPE_CHECKING:
    from clsplat.training.start.prepare import PreparedScene


def first_kernels(prepared: PreparedScene, device: Device
                  ) -> Iterator[tuple[Kernel, blend.Defines]]:
    """The kernels, one of each program, with the constants of their builds.

    One that is missing here, such as a part's own, is compiled when it is launched, and one that is
    not launched has cost time of a thread.
    """
    options, parts = prepared.options, parts_of(prepared)
    own_masks = any(view.may_have_mask for view in prepared.train_views)
    projecting = project.project_defines(options.sh_degree, options.antialiased)
    yield cull.CULL, projecting
    yield compact.COMPACT, ()
    yield project.PROJECT, project.of_degree(projecting, 0)
    yield bin.COUNT_TILES, ()
    yield adam.STEP, adam.adam_defines(dict(projecting)["SH_REST"], 0)
    if bin.NEEDS_ORDER.of(device):
        yield sort.SCATTER, sort.SORT_DEFINES
    if options.exposure == "on":
        yield blend.BLEND, (*blend.blend_defines(False),
                            *blend.response_defines(options.vignetting == "on"))
    for with_depth in sorted({False, *(part.needs_depth for part in parts)}):
        yield blend.ADJOINT, blend.blend_defines(with_depth)
        yield project.ADJOINT, (
            *project.of_degree(projecting, 0), *project.adjoint_choices(
                False, True, own_masks, any(part.needs_pose for part in parts)),
            *project.summed_choices((("WITH_DEPTH", int(with_depth)),)))
    for planes in sorted({photo_array(view).shape[0] for view in prepared.train_views}):
        yield image_loss.VALUE, image_loss.mask_defines(planes > 3)
    yield frequency.LARGEST, ()
    yield reduce.SUM_COLUMNS, ()
    yield gather.GATHER, ()
    yield project.PROJECT, project.of_degree(projecting, options.sh_degree)  # an evaluation
