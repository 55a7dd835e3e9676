"""What the formats of models share: their coordinates, their axes, and how damage is reported."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.georeference.files import (
    commented_georeference,
    commented_up,
    placement_comments,
)
from clsplat.io.models.ply import needs_double
from clsplat.io.models.usable import (
    GREATEST_OPACITY,
    LARGEST_LOG_SCALE,
    LEAST_OPACITY,
    usable,
    with_meaning,
)
from clsplat.io.reason import reason

MODE = "SplatRenderMode: "  # the comment on how a model was trained
MIP = f"{MODE}mip"  # with --antialiased


def mode_comment(antialiased: bool) -> str:
    """The comment of a model that was trained with or without --antialiased."""
    return MIP if antialiased else f"{MODE}default"


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Report any failure to read a file as one line: libraries raise many kinds of exceptions for
    damaged files.

    Parameters
    ----------
    what : the format with its article, for the message.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # `gaussians_of` checks the results
            yield
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except ImportError as error:
        raise InputError(f"{path}: {reason(error)}") from None
    except MemoryError:
        raise InputError(f"{path}: not enough memory to read it; free some, or give a smaller "
                         "model") from None
    except Exception as error:
        raise InputError(f"{path}: not {what}, damaged or cut short ({reason(error)}); "
                         "export or copy it again") from None


@dataclass(frozen=True)
class Notes:
    """What a file holds about its gaussians, if its format has a place for it.

    Attributes
    ----------
    comments : lines of text.
    up : float64[3], the unit vector that points up; None: unknown.
    georeference : of the original coordinates; None: unknown.
    """

    comments: tuple[str, ...] = ()
    up: NDArray[np.float64] | None = None
    georeference: Georeference | None = None

    @classmethod
    def of_lines(cls, lines: Iterable[str]) -> Notes:
        """The notes in lines of text, as `lines` has them; other lines are left out."""
        known = tuple(lines)
        return cls(tuple(line for line in known if line.startswith(MODE)), commented_up(known),
                   commented_georeference(known))

    @property
    def lines(self) -> tuple[str, ...]:
        """All of it as lines of text."""
        known = () if self.up is None else placement_comments(self.up, self.georeference)
        return (*self.comments, *known)

    @property
    def antialiased(self) -> bool:
        """Whether the model was trained with --antialiased, by the comments."""
        return MIP in self.comments


def stored_positions(gaussians: Gaussians) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions float64[N, 3] for a file that holds single precision, and their origin float64[3].

    These are the original coordinates with a zero origin, or, where float32 would lose digits, the
    local coordinates with the offset as their origin, which the file must record.
    """
    local = gaussians.positions.astype(np.float64)
    world = local + gaussians.offset
    if needs_double(world, gaussians.log_scales):
        return local, gaussians.offset
    return world, np.zeros(3)


def gaussians_of(path: Path, rows: dict[str, NDArray[np.float64]],
                 origin: NDArray[np.float64], offset: NDArray[np.float64] | None) -> Gaussians:
    """Gaussians in local coordinates, from the values of a file; see `usable.usable`.

    Parameters
    ----------
    path : the file that messages name.
    rows : the fields of `gaussians.LEARNED`; positions relative to the origin.
    origin : float64[3], original coordinates, as the file records it.
    offset : float64[3], original coordinates of the origin of the local ones; None: `origin`.
    """
    offset = np.array(origin if offset is None else offset, np.float64)
    rows = {**rows, "positions": rows["positions"] + (origin - offset)}
    bands = rows["sh_rest"].shape[1]
    with np.errstate(over="ignore"):
        single = {name: with_meaning(name, values.astype(np.float32))
                  for name, values in rows.items()}
    return Gaussians(usable(path, single), round((bands + 1) ** 0.5) - 1, offset)


def opacities(gaussians: Gaussians) -> NDArray[np.float64]:
    """float64[N], 0 to 1."""
    with np.errstate(over="ignore"):
        return np.asarray(1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64))))


def logits(opacity: NDArray[np.float64]) -> NDArray[np.float64]:
    """The logits float64[N] of opacities, of which 0 and 1 are moved so far that theirs exist."""
    inside = np.clip(opacity, LEAST_OPACITY, GREATEST_OPACITY)
    return np.log(inside) - np.log1p(-inside)


def byte_logits(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The logits float64[N] of opacities in steps of 1 / 255."""
    return logits(np.clip(values, 0.25, 254.75) / 255)


def scales_of(log_scales: NDArray[np.floating]) -> NDArray[np.float64]:
    """Standard deviations that single precision holds."""
    limited = np.clip(log_scales.astype(np.float64), -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    return np.exp(limited)


def log_scales_of(scales: NDArray[np.float64]) -> NDArray[np.float64]:
    """The logarithms of standard deviations, of which zero and infinity become finite."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a negative one is refused later
        return np.clip(np.log(scales), -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)


def colours_of(sh_constant: NDArray[np.floating]) -> NDArray[np.float64]:
    """The colours float64[N, 3] of the constant harmonics; most are 0 to 1."""
    return 0.5 + SH_C0 * sh_constant.astype(np.float64)


def to_bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Round to uint8, within its limits."""
    limited: NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return limited


def half_turn(rows: dict[str, NDArray[np.float64]], axis: int) -> dict[str, NDArray[np.float64]]:
    """The fields of `gaussians.LEARNED` after half a turn about a coordinate axis.

    Two half turns change nothing.

    Parameters
    ----------
    axis : 0 for x, 1 for y, 2 for z.
    """
    sign = np.full(3, -1.0)
    sign[axis] = 1
    x, y, z = sign
    # as the polynomials of the harmonics change their signs (cl/include/harmonics.h)
    bands = np.array([y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x])
    rest = rows["sh_rest"]
    return {**rows, "positions": rows["positions"] * sign,
            "quaternions": rows["quaternions"] * np.append(1, sign),
            "sh_rest": rest * bands[:rest.shape[1], None]}


def doubles(gaussians: Gaussians, order: NDArray[np.intp]) -> dict[str, NDArray[np.float64]]:
    """The fields of `gaussians.LEARNED` in double precision, in another order."""
    names = ("positions", "sh_constant", "sh_rest", "opacity_logits", "log_scales", "quaternions")
    return {name: gaussians.rows[name][order].astype(np.float64) for name in names}
