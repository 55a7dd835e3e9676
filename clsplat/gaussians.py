"""The gaussians: one table of fields defines rows, Adam moments, PLY columns and checkpoints."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.constants import SH_C0
from clsplat.errors import InputError

if TYPE_CHECKING:
    from typing_extensions import Self

INITIAL_OPACITY = 0.1
MINIMUM_DISTANCE = 1e-7  # share of the cloud's size; coincident points get this scale, not zero


@dataclass(frozen=True)
class Field:
    """One stored parameter of every gaussian."""

    name: str  # key of its rows
    # initial learning rate (Kerbl et al. 2023; positions: times the scene's extent); 0 for a
    # parameter that is not learned
    rate: float
    ply: tuple[str, ...]  # names of its PLY columns, in the order of a row
    # of a row; None: the bands of the spherical harmonics above the constant, by 3
    shape: tuple[int, ...] | None = None

    def row_shape(self, sh_degree: int) -> tuple[int, ...]:
        """Shape of a row."""
        return self.shape if self.shape is not None else ((sh_degree + 1) ** 2 - 1, 3)

    def width(self, sh_degree: int) -> int:
        """Number of floats of a row."""
        return int(np.prod(self.row_shape(sh_degree)))


def _numbered(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}_{i}" for i in range(count))


LEARNED = (
    Field("positions", 1.6e-4, ("x", "y", "z"), (3,)),
    Field("sh_constant", 2.5e-3, _numbered("f_dc", 3), (3,)),
    # PLY stores these channel by channel: row [band, channel] is column channel * bands + band
    Field("sh_rest", 2.5e-3 / 20, _numbered("f_rest", 45)),
    Field("opacity_logits", 5e-2, ("opacity",), ()),
    Field("log_scales", 5e-3, _numbered("scale", 3), (3,)),
    Field("quaternions", 1e-3, _numbered("rot", 4), (4,)),
)
# the sphere that a gaussian must not leave (densify/sphere.py); only models with spheres have it
SPHERE = (
    Field("anchors", 0.0, ("anchor_x", "anchor_y", "anchor_z"), (3,)),
    Field("max_offsets", 0.0, ("max_offset",), ()),
)
FIELDS = LEARNED + SPHERE


# odd factors: the sums of different points then hardly ever agree
KEYS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Gaussians in host memory, a row each.

    Every field is also an attribute: `model.positions`. Quaternions are wxyz and need not have unit
    length; scales and opacities are stored as their logarithm and logit.

    Attributes
    ----------
    rows : field name -> float32[N, *row shape]: positions [N, 3], sh_constant [N, 3], sh_rest
        [N, bands, 3], opacity_logits [N], log_scales [N, 3], quaternions [N, 4], and those of
        SPHERE if the model has spheres; local coordinates.
    sh_degree : degree of the spherical harmonics (SH), 0 to 3.
    offset : float64[3], the origin of the local coordinates in the original ones.
    """

    rows: dict[str, NDArray[np.float32]]
    sh_degree: int
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """InputError unless every field is there and fits the others, as kernels take for granted."""
        if not (isinstance(self.sh_degree, (int, np.integer)) and 0 <= self.sh_degree <= 3):
            raise InputError(f"sh_degree {self.sh_degree!r}: expects 0, 1, 2 or 3")
        if not isinstance(self.rows, dict):
            raise InputError(f"rows: expects a dict of arrays, got {type(self.rows).__name__}")
        count = next(iter(np.shape(self.rows.get("positions", 0.0))), 0)
        for known in FIELDS:
            if known in LEARNED or known.name in self.rows:
                values, shape = self.rows.get(known.name), (count, *known.row_shape(self.sh_degree))
                if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
                    kind = getattr(values, "dtype", type(values).__name__)
                    raise InputError(f"{known.name}: is {kind}; give a numpy array of real numbers")
                if values.shape != shape:
                    raise InputError(
                        f"{known.name}: has shape {values.shape}, not {shape}, which "
                        f"{count:,} gaussians of SH degree {self.sh_degree} have"
                    )
        if np.shape(self.offset) != (3,) or not np.isfinite(self.offset).all():
            raise InputError(f"offset {self.offset!r}: expects three finite numbers")

    @property
    def count(self) -> int:
        """How many gaussians there are."""
        return len(self.rows["positions"])

    def __getattr__(self, name: str) -> NDArray[np.float32]:
        try:
            return np.asarray(self.__dict__["rows"][name])
        except KeyError:
            raise AttributeError(name) from None

    @classmethod
    def from_points(cls, points: NDArray[np.floating], colours: NDArray[np.uint8], sh_degree: int = 3) -> Self:
        """Initial gaussians on a sparse point cloud (Kerbl et al. 2023, section 5.1).

        They are isotropic, with the root mean square distance to the three nearest neighbours as
        their standard deviation, and an opacity of 0.1.

        Parameters
        ----------
        points : float64[N, 3], local coordinates.
        colours : uint8[N, 3].
        sh_degree : degree of the spherical harmonics, 0 to 3.

        Raises
        ------
        clsplat.ClsplatError : if all points have the same position.
        """
        count = len(points)
        rows = {
            "positions": points.astype(np.float32),
            "sh_constant": ((colours / 255.0 - 0.5) / SH_C0).astype(np.float32),
            "sh_rest": np.zeros((count, (sh_degree + 1) ** 2 - 1, 3), np.float32),
            "opacity_logits": np.full(count, np.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY)), np.float32),
            "log_scales": np.repeat(np.log(neighbour_distance(points))[:, None], 3, axis=1).astype(np.float32),
            "quaternions": np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        }
        return cls(rows, sh_degree)

    def scaled(self, factor: float) -> Self:
        """The same gaussians in a frame with larger coordinates.

        Parameters
        ----------
        factor : new coordinates are the old ones times this.
        """
        rows = dict(self.rows)
        for name in ("positions", "anchors", "max_offsets"):
            if name in rows:
                rows[name] = (rows[name] * np.float64(factor)).astype(np.float32)
        rows["log_scales"] = (rows["log_scales"] + np.log(factor)).astype(np.float32)
        return replace(self, rows=rows)

    def with_sh_degree(self, sh_degree: int) -> Self:
        """The same gaussians with spherical harmonics (SH) of another degree.

        Parameters
        ----------
        sh_degree : 0 to 3; bands above it are removed, bands that are missing become zero.
        """
        if sh_degree == self.sh_degree:
            return self
        rest = np.zeros((self.count, (sh_degree + 1) ** 2 - 1, 3), np.float32)
        shared = min(rest.shape[1], self.sh_rest.shape[1])
        rest[:, :shared] = self.sh_rest[:, :shared]
        return replace(self, rows={**self.rows, "sh_rest": rest}, sh_degree=sh_degree)

    def without_spheres(self) -> Self:
        """The same gaussians without the fields of SPHERE."""
        rows = {field.name: self.rows[field.name] for field in LEARNED}
        return replace(self, rows=rows)

    def located(self, offset: ArrayLike) -> Self:
        """The same local coordinates with another origin, so that the gaussians move.

        Parameters
        ----------
        offset : float64[3], original coordinates of the new origin.
        """
        return replace(self, offset=np.asarray(offset, np.float64))

    def moved(self, offset: ArrayLike) -> Self:
        """Local coordinates with another origin, so that the gaussians stay where they are.

        Parameters
        ----------
        offset : float64[3], original coordinates of the new origin.
        """
        away = self.offset - np.asarray(offset, np.float64)
        rows = {
            name: (values + away).astype(np.float32) if name in ("positions", "anchors") else values
            for name, values in self.rows.items()
        }
        return replace(self, rows=rows, offset=np.asarray(offset, np.float64))

    def __repr__(self) -> str:
        return f"<clsplat.Gaussians: {self.count:,}, SH degree {self.sh_degree}>"


def neighbour_distance(points: NDArray[np.floating], neighbours: int = 3) -> NDArray[np.float64]:
    """Root mean square distance float64[N] of each point to its nearest neighbours, world units.

    Coincident points count as one point; otherwise the distance between duplicates would be zero.
    """
    distance, inverse, least = _distances(points, neighbours)
    return np.asarray(np.maximum(np.sqrt((distance**2).mean(axis=1)), least)[inverse])


def mean_neighbour_distance(points: NDArray[np.floating], neighbours: int) -> NDArray[np.float64]:
    """Mean distance float64[N] of each point to its nearest neighbours, or to as many as there are,
    world units. Coincident points count as one point."""
    distance, inverse, least = _distances(points, neighbours)
    return np.asarray(np.maximum(distance.mean(axis=1), least)[inverse])


def mean_inverse_distance(points: NDArray[np.floating]) -> float:
    """Mean over points of 1 / distance to the nearest neighbour, 1 / world unit (Xue et al. 2026,
    eq. 8).

    Points that differ only by rounding are not neighbours; a point whose three nearest points are
    such duplicates counts as 0.
    """
    distance, _, least = _distances(points, 3)
    nearest = np.where(distance > least, distance, np.inf).min(axis=1)
    return float((1 / nearest).mean())


def _distances(points: NDArray[np.floating], neighbours: int) -> tuple[NDArray[np.float64], NDArray[np.intp], float]:
    """(float64[M, k] distances of the M distinct points to their nearest neighbours, ascending;
    int[N], which of them each point is; the distance below which two points are coincident)."""
    distinct, inverse = _distinct(points)
    if len(distinct) < 2:
        raise InputError(
            f"the sparse model's {len(points)} points all lie at one place; "
            "reconstruct the scene again, or check the units of its points"
        )
    # an outlier far away must not make the other points coincident
    typical = np.median(np.linalg.norm(distinct - np.median(distinct, axis=0), axis=1))
    size = min(np.linalg.norm(np.ptp(distinct, axis=0)), 10 * typical)
    k = min(neighbours, len(distinct) - 1)
    # in half of the time of a balanced one, and as good for queries
    tree = scipy.spatial.cKDTree(distinct, balanced_tree=False)
    distance = np.empty((len(distinct), k))
    # in the order of the tree, where neighbours follow each other: in a third of the time
    distance[tree.indices] = tree.query(distinct[tree.indices], k=k + 1, workers=-1)[0][:, 1:]
    return distance, inverse, MINIMUM_DISTANCE * size


def _distinct(points: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.intp]]:
    """As np.unique(points, axis=0, return_inverse=True), in half of the time or less; where all
    points differ, in the given order."""
    bits = (np.asarray(points, np.float64) + 0.0).view(np.uint64)  # of one zero
    bits ^= bits >> np.uint64(32)  # the lower half of rounded numbers is empty
    keys = np.sort((bits * KEYS).sum(axis=1))
    if (keys[1:] != keys[:-1]).all():
        return points, np.arange(len(points))
    order = np.lexsort(points.T[::-1])
    ordered = points[order]
    is_new = np.ones(len(points), bool)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    inverse = np.empty(len(points), np.intp)
    inverse[order] = np.cumsum(is_new) - 1
    return ordered[is_new], inverse
