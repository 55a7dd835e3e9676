"""The kernels of cl/adam.cl, what they are given, and the choices of their builds."""

from clsplat.constants import CATCH_UP_EVERY, FRAME_COUNTS, LAZY_TERMS, SMALL_COLUMNS
from clsplat.device import Either, Forms, Kernel, Only, each
from clsplat.device.kernel import Argument
from clsplat.gaussians import LEARNED
from clsplat.rendering.blend import Defines


def _moments(m: str, v: str, *shape: str | int) -> dict[str, Either]:
    """Moments by name, whose types depend on the build (cl/include/moments.h)."""
    return {
        m: Either("CODED", ("ushort", *shape), ("real", *shape)),
        v: Either("CODED", ("uchar", *shape), ("real", *shape)),
    }


_SMALL_MOMENTS = _moments("m", "v", "N", SMALL_COLUMNS)
_ROWS: dict[str, Argument | Either] = dict(
    positions=("real", "N", 3),
    sh_constant=("real", "N", 3),
    sh_rest=("real", "R", "K", 3),
    opacity_logits=("real", "N"),
    log_scales=("real", "N", 3),
    quaternions=("real", "N", 4),
    **_SMALL_MOMENTS,
    **_moments("m_rest", "v_rest", "R", "S"),
    last_step=("uint", "N"),
)
PAGED = dict(places=Only("PAGED", ("uint", "N")), slots=Only("PAGED", ("uint", "Q")))
_COUNTS = dict(counts=("uint", FRAME_COUNTS))
_COEFFICIENTS = dict(coefficients=("real", CATCH_UP_EVERY, LAZY_TERMS))
STEP = Kernel(
    "adam.cl",
    "adam_step",
    Forms(each("work"), each("work STEP_SPREAD")),
    work="uint",
    now="uint",
    rank_one="uint",
    first="real",
    correction="real",
    share="real",
    **{f"rate_{field.name}": "real" for field in LEARNED},
    **_COUNTS,
    visible=("uint", "V"),
    rows=("uint", "V"),
    grad_positions=("real", "V", 3),
    grad_colours=("real", "V", 3),
    grad_opacity_logits=("real", "V"),
    grad_log_scales=("real", "V", 3),
    grad_quaternions=("real", "V", 4),
    directions=("real", "V", 3),
    grad_sh_rest=("real", "G", "H", 3),
    **_ROWS,
    **_COEFFICIENTS,
    **PAGED,
)
CATCH_UP = Kernel(
    "adam.cl",
    "adam_catch_up",
    Forms(each("count"), each("count CATCH_UP_SPREAD")),
    count="uint",
    now="uint",
    keeps="uint",
    has_frozen="uint",
    by_camera="uint",
    **_COUNTS,
    camera=("real", "C"),
    frozen=("uint", "F"),
    **_COEFFICIENTS,
    **_ROWS,
    **PAGED,
)
SEEN = Kernel(
    "adam.cl",
    "adam_seen",
    Forms(each("count/16"), each("count")),
    count="uint",
    now="uint",
    margin="real",
    position_ahead="real",
    scale_ahead="real",
    camera=("real", "C"),
    **_COEFFICIENTS,
    positions=("real", "N", 3),
    log_scales=("real", "N", 3),
    last_step=("uint", "N"),
    flags=("uint", "N"),
)
CLEAR = Kernel("adam.cl", "adam_clear", each("count"), count="uint", begin="uint", end="uint", **_SMALL_MOMENTS)


def adam_defines(harmonics: int, degree: int) -> Defines:
    """The build-time choices for so many stored harmonics besides the constant ones, of which those
    of a degree are active."""
    return ("SH_REST", harmonics), ("DEGREE", degree)
