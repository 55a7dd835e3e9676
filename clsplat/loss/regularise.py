"""L1 regularisation of the gaussians' opacities and sizes (cl/regularise.cl)."""

from collections.abc import Mapping

from clsplat.constants import FRAME_COUNTS
from clsplat.device import Array, Kernel, each
from clsplat.rendering.project import Gradients

REGULARISE = Kernel(
    "regularise.cl",
    "regularise",
    each("V"),
    opacity_weight="real",
    scale_weight="real",
    counts=("uint", FRAME_COUNTS),
    rows=("uint", "V"),
    opacity_logits=("real", "N"),
    log_scales=("real", "N", 3),
    grad_opacity_logits=("real", "V"),
    grad_log_scales=("real", "V", 3),
)


def regularise(rows: Mapping[str, Array], gradients: Gradients, opacity_weight: float, scale_weight: float) -> None:
    """Add the gradient of the regularisation to that of a view, in place: of the mean opacity and
    the mean standard deviation of the gaussians that it sees; `scale_weight` is in 1 / world
    unit."""
    fields = gradients.fields
    rows["opacity_logits"].device.launch(
        REGULARISE,
        opacity_weight=opacity_weight,
        scale_weight=scale_weight,
        counts=gradients.counts,
        rows=gradients.rows,
        opacity_logits=rows["opacity_logits"],
        log_scales=rows["log_scales"],
        grad_opacity_logits=fields["opacity_logits"],
        grad_log_scales=fields["log_scales"],
    )
