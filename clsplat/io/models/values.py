"""What the formats of models share: their coordinates, axes, steps and comments."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.georeference import Georeference
from clsplat.io.georeference.files import commented_georeference, commented_up, placement_comments

MODE = "SplatRenderMode: "  # the comment on how a model was trained
MIP = f"{MODE}mip"  # with --antialiased
# what stands for infinity: opacities that single precision and logits can hold, and the logarithm
# of a scale whose exponential is a finite float32, as is that of its negative
LEAST_OPACITY, GREATEST_OPACITY = 1e-30, 1 - 2.0**-24
LARGEST_LOG_SCALE = 80.0
MOST_LEFT_OUT = 0.5  # of a file's rows; one with more is damaged
MORTON_BITS = 21  # of each axis
TOLERANCE = 1e-3  # of the median scale: the error of a position that needs double precision


class Steps(NamedTuple):
    """Numbers as bytes: a byte stands for (byte - zero) / scale."""

    scale: float
    zero: float = 0.0

    def bytes(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """The nearest byte of each value."""
        return to_bytes(values * self.scale + self.zero)

    def values(self, codes: NDArray[np.integer]) -> NDArray[np.float64]:
        """The value of each byte."""
        return (codes.astype(np.float64) - self.zero) / self.scale


OPACITY_STEPS = Steps(255)


@dataclass(frozen=True)
class Notes:
    """What a file holds about its gaussians, if its format has a place for it."""

    comments: tuple[str, ...] = ()  # lines of text
    # float64[3], the unit vector that points up; None: unknown
    up: NDArray[np.float64] | None = None
    georeference: Georeference | None = None  # of the original coordinates; None: unknown

    @classmethod
    def of_lines(cls, lines: Iterable[str]) -> Notes:
        """The notes in lines of text, as `lines` has them; other lines are left out."""
        known = tuple(lines)
        return cls(
            tuple(line for line in known if line.startswith(MODE)), commented_up(known), commented_georeference(known)
        )

    @property
    def lines(self) -> tuple[str, ...]:
        """All of it as lines of text."""
        known = () if self.up is None else placement_comments(self.up, self.georeference)
        return (*self.comments, *known)

    @property
    def antialiased(self) -> bool:
        """Whether the model was trained with --antialiased, by the comments."""
        return MIP in self.comments


def mode_comment(antialiased: bool) -> str:
    """The comment of a model that was trained with or without --antialiased."""
    return MIP if antialiased else f"{MODE}default"


def needs_double(positions: NDArray[np.float64], log_scales: NDArray[np.float32]) -> bool:
    """Whether float32 would move a gaussian by more than TOLERANCE of the median scale."""
    error = np.abs(positions.astype(np.float32) - positions).max(initial=0.0)
    return bool(error and error > TOLERANCE * np.exp(np.median(log_scales.astype(np.float64))))


def stored_rows(
    gaussians: Gaussians, along_curve: bool = False
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64]]:
    """The fields of `gaussians.LEARNED` for a file in single precision, in double precision and if
    wanted in `morton_order`, and the origin float64[3] of the positions.

    Positions are the original coordinates with a zero origin, or, if float32 would lose digits, the
    local coordinates with the offset as their origin, which the file must record.
    """
    rows = {field.name: gaussians.rows[field.name].astype(np.float64) for field in LEARNED}
    world, origin = rows["positions"] + gaussians.offset, gaussians.offset
    if not needs_double(world, gaussians.log_scales):
        rows["positions"], origin = world, np.zeros(3)
    if along_curve:
        order = morton_order(rows["positions"])
        rows = {name: values[order] for name, values in rows.items()}
    return rows, origin


def gaussians_of(
    path: Path, rows: dict[str, NDArray[np.float64]], origin: NDArray[np.float64], offset: NDArray[np.float64] | None
) -> Gaussians:
    """Gaussians in local coordinates, from the values of a file; see `usable`.

    Parameters
    ----------
    rows : the fields of `gaussians.LEARNED`; positions relative to the origin.
    origin, offset : float64[3], original coordinates: of the file's, and of the local origin; None:
        that of the file.
    """
    offset = np.array(origin if offset is None else offset, np.float64)
    rows = {**rows, "positions": rows["positions"] + (origin - offset)}
    with np.errstate(over="ignore"):
        single = {name: values.astype(np.float32) for name, values in rows.items()}
    return Gaussians(usable(path, single), round((rows["sh_rest"].shape[1] + 1) ** 0.5) - 1, offset)


def usable(
    path: str | Path, rows: dict[str, NDArray[Any]], most_left_out: float = MOST_LEFT_OUT
) -> dict[str, NDArray[Any]]:
    """The rows [N, ...] of fields whose numbers are all finite; a warning counts the others.

    A logit of +-inf is an opaque or an invisible gaussian, a logarithm of -inf a size of zero:
    finite values stand for these. InputError if more rows than the share `most_left_out` are left
    out; 0 for a file that clsplat wrote.
    """
    ends = {"opacity_logits": logits(np.array((0.0, 1.0))), "log_scales": np.array((-LARGEST_LOG_SCALE, np.inf))}
    for name, (low, high) in ends.items():
        if name in rows and not np.isfinite(rows[name]).all():
            rows = {**rows, name: np.nan_to_num(rows[name], nan=np.nan, neginf=low, posinf=high)}
    finite = np.logical_and.reduce(
        [np.isfinite(values).all(axis=tuple(range(1, values.ndim))) for values in rows.values()]
    )
    count, bad = len(finite), int(np.count_nonzero(~finite))
    if not bad:
        return rows
    if bad > most_left_out * count:
        raise InputError(f"{path}: {bad} of {count} rows hold numbers that are not finite; export or copy it again")
    logging.getLogger(__name__).warning(
        "%s: %d of %d rows hold numbers that are not finite: they are left out", path, bad, count
    )
    return {name: values[finite] for name, values in rows.items()}


def opacities(gaussians: Gaussians) -> NDArray[np.float64]:
    """float64[N], 0 to 1."""
    return np.asarray(scipy.special.expit(gaussians.opacity_logits.astype(np.float64)))


def logits(opacity: NDArray[np.float64]) -> NDArray[np.float64]:
    """The logits float64[N] of opacities, of which 0 and 1 are moved so far that theirs exist."""
    return np.asarray(scipy.special.logit(np.clip(opacity, LEAST_OPACITY, GREATEST_OPACITY)))


def byte_logits(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The logits float64[N] of opacities in steps of 1 / 255."""
    return logits(np.clip(values, 0.25, 254.75) / 255)


def log_scales_of(scales: NDArray[np.float64]) -> NDArray[np.float64]:
    """The logarithms of standard deviations, of which zero and infinity become finite."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a negative one is refused later
        return np.clip(np.log(scales), -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)


def scales_of(log_scales: NDArray[np.floating]) -> Any:
    """The standard deviations of logarithms, all finite and above zero."""
    return np.exp(np.clip(log_scales, -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE))


def colours_of(sh_constant: NDArray[np.floating]) -> NDArray[np.float64]:
    """The colours float64[N, 3] of the constant harmonics; most are 0 to 1."""
    return 0.5 + SH_C0 * sh_constant.astype(np.float64)


def to_bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Round to uint8, within its limits."""
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def half_turn(rows: dict[str, NDArray[np.float64]], axis: int) -> dict[str, NDArray[np.float64]]:
    """The fields of `gaussians.LEARNED` after half a turn about axis 0, 1 or 2: its own inverse."""
    sign = np.full(3, -1.0)
    sign[axis] = 1
    x, y, z = sign
    # as the polynomials of the harmonics change their signs (cl/include/harmonics.h)
    bands = np.array([y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x])
    rest = rows["sh_rest"]
    return {
        **rows,
        "positions": rows["positions"] * sign,
        "quaternions": rows["quaternions"] * np.append(1, sign),
        "sh_rest": rest * bands[: rest.shape[1], None],
    }


def morton_order(positions: NDArray[np.floating]) -> NDArray[np.intp]:
    """The order int[N] along a Z-order curve: neighbours in space become neighbours in the file,
    which then compresses better."""
    if not len(positions):
        return np.zeros(0, np.intp)
    span = np.maximum(np.ptp(positions, axis=0), np.finfo(np.float64).tiny)
    cells = ((positions - positions.min(axis=0)) / span * ((1 << MORTON_BITS) - 1)).astype(np.uint64)
    code = np.zeros(len(positions), np.uint64)
    for bit, axis in np.ndindex(MORTON_BITS, 3):
        code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def unit(quaternions: NDArray[np.floating]) -> NDArray[np.float64]:
    """Quaternions float64[N, 4] of unit length; zero becomes 1, 0, 0, 0."""
    values = quaternions.astype(np.float64)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    return np.where(length > 0, values / np.where(length > 0, length, 1), (1.0, 0, 0, 0))


def smallest_three(quaternions: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Quaternions [N, 4] of any length without their largest component, which follows from the
    others if they have unit length.

    Returns
    -------
    int[N], which component is the largest, and float64[N, 3], the others in their order, signed so
    that the largest is positive: within -1 / sqrt(2) to 1 / sqrt(2).
    """
    values = unit(quaternions)
    largest = np.abs(values).argmax(axis=1)
    values *= np.where(np.take_along_axis(values, largest[:, None], 1) < 0, -1, 1)
    return largest, values[np.arange(4) != largest[:, None]].reshape(-1, 3)


def from_smallest_three(largest: NDArray[np.integer], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """The quaternions float64[N, 4] that `smallest_three` packed."""
    values = np.empty((len(others), 4))
    mask = np.arange(4) != largest[:, None]
    values[mask] = others.ravel()
    values[~mask] = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    return values
