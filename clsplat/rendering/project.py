"""Gaussians to splats, and the adjoint (cl/project.cl)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import CAMERA_REALS, COUNT_VISIBLE, FRAME_COUNTS, POSE_REALS, SPLAT_REALS
from clsplat.device import Array, ArraySpec, Device, Forms, Kernel, Only, each, groups
from clsplat.gaussians import LEARNED
from clsplat.rendering.blend import Defines, SplatGrads

Rows = Mapping[str, Array]  # field name -> real[N, *row shape]

BORDER = 0.15  # of the photo: so far beyond its borders Jacobians are not clamped
LOW_PASS = 0.3  # pixels squared (Kerbl et al. 2023)

_PARAMETERS = dict(opacity_logits=("real", "N"), log_scales=("real", "N", 3), quaternions=("real", "N", 4))
_COLOURS = dict(sh_constant=("real", "N", 3), sh_rest=("real", "R", "K", 3))
# where harmonics lie that are paged (cl/include/rest.h)
_PAGED = dict(places=Only("PAGED", ("uint", "N")), slots=Only("PAGED", ("uint", "Q")))
_PLACES = dict(camera=("real", CAMERA_REALS), positions=("real", "N", 3))
_PAIRS = dict(
    splat_counts=("uint", "V"), offsets=("uint", "V"), pair_grads=("real", "P", "S"), earlier=("real", "E", "S")
)
PROJECT = Kernel(
    "project.cl",
    "project",
    Forms(item=each("V"), group=groups("V/PROJECT_GROUP", "PROJECT_GROUP")),
    counts=("uint", FRAME_COUNTS),
    rows=("uint", "V"),
    **_PLACES,
    **_COLOURS,
    **_PARAMETERS,
    splats=("real", "V", SPLAT_REALS),
    depth_keys=("uint", "V"),
    **_PAGED,
)
_BY_COLOUR = dict(grad_colours=("real", "V", 3), directions=("real", "V", 3))
ADJOINT = Kernel(
    "project.cl",
    "project_adjoint",
    Forms(item=each("work"), group=groups("work/PROJECT_GROUP", "PROJECT_GROUP")),
    work="uint",
    half_width="real",
    half_height="real",
    counts=("uint", FRAME_COUNTS),
    rows=("uint", "V"),
    **_PLACES,
    **_COLOURS,
    **_PARAMETERS,
    **_PAIRS,
    grad_positions=("real", "V", 3),
    **_BY_COLOUR,
    grad_opacity_logits=("real", "V"),
    grad_log_scales=("real", "V", 3),
    grad_quaternions=("real", "V", 4),
    grad_means=("real", "V", 2),
    active=("uint", "V"),
    skipped=("uint", 1),
    frozen=Only("WITH_FROZEN", ("uint", "N")),
    grad_norm_sum=Only("WITH_STATISTICS", ("real", "N")),
    seen_count=Only("WITH_STATISTICS", ("uint", "N")),
    photo=Only("MASKED", ("uchar", 4, "Y", "X")),
    pose_terms=Only("WITH_POSE", ("real", "V", POSE_REALS)),
    grad_features=Only("WITH_FEATURES", ("real", "V", "CH")),
    **_PAGED,
)
SUM_PAIRS = Kernel(
    "project.cl",
    "sum_pairs",
    Forms(item=each("V"), group=groups("V/PROJECT_GROUP", "PROJECT_GROUP")),
    counts=("uint", FRAME_COUNTS),
    **_PAIRS,
    totals=("real", "V", "S"),
)
HARMONICS = Kernel(
    "project.cl",
    "harmonics_gradients",
    each("V"),
    counts=("uint", FRAME_COUNTS),
    **_BY_COLOUR,
    grad_sh_constant=("real", "V", 3),
    grad_sh_rest=("real", "V", "K", 3),
)
CAMERA = ArraySpec((CAMERA_REALS,))


@dataclass(eq=False)
class FieldGradients(Mapping[str, Array]):
    """Gradients by field, real[V, *row shape]; those by the harmonics are computed when asked for.

    The gradient by a harmonic is the gradient by the colour times the harmonic, so 6 floats of a
    gaussian stand for 48.
    """

    stored: dict[str, Array]  # field name -> gradient; those by the harmonics are added here
    grad_colours: Array  # real[V, 3], by the colours
    directions: Array  # real[V, 3], unit vectors from the camera
    harmonics: int  # stored harmonics above the constant, 0, 3, 8 or 15
    defines: Defines  # of the build of `project`, for the active degree
    counts: Array  # uint[FRAME_COUNTS], of the frame

    def __getitem__(self, name: str) -> Array:
        if name in ("sh_constant", "sh_rest") and name not in self.stored:
            device, count = self.grad_colours.device, len(self.grad_colours)
            gradients = dict(
                grad_sh_constant=device.empty((count, 3)), grad_sh_rest=device.empty((count, self.harmonics, 3))
            )
            device.launch(
                HARMONICS,
                self.defines,
                counts=self.counts,
                directions=self.directions,
                grad_colours=self.grad_colours,
                **gradients,
            )
            self.stored.update(sh_constant=gradients["grad_sh_constant"], sh_rest=gradients["grad_sh_rest"])
        return self.stored[name]

    def __iter__(self) -> Iterator[str]:
        return (field.name for field in LEARNED)

    def __len__(self) -> int:
        return len(LEARNED)


@dataclass(eq=False)
class Gradients:
    """Gradients of a loss by the V gaussians that a view saw."""

    fields: Mapping[str, Array]  # name -> real[V, *row shape]; of one view a `FieldGradients`
    # real[V, 2], by the mean of the splat, pixels; None for a mean of several views
    means: Array | None
    rows: Array  # uint[V], the row of each gaussian, or NO_ROW where the gradient is not finite
    visible: Array  # uint[V], the row of each gaussian, whatever its gradient
    counts: Array  # uint[FRAME_COUNTS]; only the first counts[COUNT_VISIBLE] of the V exist
    # real[V, 6], their shares in the gradient by the camera's pose, if it was asked for
    pose_terms: Array | None = None
    features: Array | None = None  # real[V, C], by the features, if they were blended

    def by_pose(self) -> NDArray[np.float64]:
        """float64[6], the gradient by the pose; waits.

        The first three are by a small turn of the scene about the camera's centre, w for the new
        rotation exp([w]x) R, in camera axes; the last three by the camera's centre, world.
        """
        if self.pose_terms is None:
            raise ValueError("the gradient by the pose was not asked for")
        count = self.counts.download()[COUNT_VISIBLE]
        sums = self.pose_terms.download()[:count].sum(axis=0, dtype=np.float64)
        return np.concatenate([sums[:3], -sums[3:]])


def project_defines(sh_degree: int, antialiased: bool, orthographic: bool = False) -> Defines:
    """The build-time choices of `cull` and `project`.

    Parameters
    ----------
    sh_degree : of the stored spherical harmonics.
    antialiased : whether opacities are scaled by the area that the low-pass filter adds.
    orthographic : whether cameras are; `project_adjoint` is for pinhole cameras only.
    """
    choices = ("SH_REST", (sh_degree + 1) ** 2 - 1), ("ANTIALIASED", int(antialiased))
    return (*choices, ("ORTHOGRAPHIC", 1)) if orthographic else choices


def pack_camera(device: Device, camera: Camera, near: float, low_pass: float = LOW_PASS) -> Array:
    """The camera on the device, as the kernels read it: real[27] (cl/include/camera.h)."""
    return device.upload(camera_row(camera, near, low_pass))


def camera_row(camera: Camera, near: float, low_pass: float = LOW_PASS) -> NDArray[np.float64]:
    """float64[27]: the camera as the kernels read it."""
    return np.concatenate(
        [
            camera.rotation.reshape(-1),
            camera.translation,
            camera.focal,
            camera.centre,
            camera.position,
            [near, low_pass, camera.width, camera.height],
            *clamped_ratios(camera),
        ]
    )


def clamped_ratios(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(smallest, largest), float64[2] each: the x/z and y/z to which Jacobians are clamped.

    A part of a photo has those of the whole photo, so that both show the same.
    """
    low, high = np.reshape(camera.borders, (2, 2))
    beyond = BORDER * (high - low)
    smallest, largest = ((end - camera.centre) / camera.focal for end in (low - beyond, high + beyond))
    return smallest, largest


def project(
    device: Device, rows: Rows, visible: Array, counts: Array, camera: Array, sh_degree: int, defines: Defines
) -> tuple[Array, Array]:
    """The splats of gaussians.

    Parameters
    ----------
    rows : field name -> real[N, *row shape].
    visible : uint[V], the gaussians, of which the first counts[COUNT_VISIBLE] exist.
    counts : uint[FRAME_COUNTS], of the frame.
    camera : real[27], packed.
    sh_degree : of the spherical harmonics that are used.
    defines : the build-time choices of the renderer.

    Returns
    -------
    real[V, 12] (cl/include/splat.h), and uint[V], keys that sort them front to back.
    """
    splats = device.empty((len(visible), SPLAT_REALS))
    depth_keys = device.empty(len(visible), np.uint32)
    device.launch(
        PROJECT,
        of_rows(defines, rows, sh_degree),
        counts=counts,
        rows=visible,
        camera=camera,
        splats=splats,
        depth_keys=depth_keys,
        **_learned(rows),
    )
    return splats, depth_keys


def project_adjoint(
    device: Device,
    rows: Rows,
    visible: Array,
    counts: Array,
    camera: Array,
    sh_degree: int,
    defines: Defines,
    splat_grads: SplatGrads,
    skipped: Array,
    size: tuple[int, int] = (0, 0),
    frozen: Array | None = None,
    statistics: tuple[Array, Array] | None = None,
    masked: Array | None = None,
    with_pose: bool = False,
) -> Gradients:
    """Gradients by the gaussians from gradients by their splats.

    Parameters
    ----------
    device, rows, visible, counts, camera, sh_degree, defines : as they were for `project`.
    splat_grads : of `blend_adjoint`.
    skipped : uint[1], to which the number of gradients that are not finite is added.
    size : (width, height) of the image, pixels; for the statistics.
    frozen : uint[N], not 0 for gaussians whose gradient is left out; None: none is.
    statistics : real[N] and uint[N], to which the lengths of the screen gradients, in NDC units,
        and the number of views are added; None: they are not needed.
    masked : uchar[4, H, W], the photo, if pixels of it do not count: the view saw what it shows
        elsewhere, and what has a gradient; None: it saw all that are visible.
    with_pose : whether the gradient by the pose of the camera is needed.
    """
    summed, pairs = _summed(splat_grads)
    count, defines = (
        len(visible),
        (
            *of_rows(defines, rows, sh_degree),
            *adjoint_choices(frozen is not None, statistics is not None, masked is not None, with_pose),
            *summed,
        ),
    )
    stored = {
        f.name: device.empty((count, *rows[f.name].shape[1:]))
        for f in LEARNED
        if f.name not in ("sh_constant", "sh_rest")
    }
    norms, seen = statistics or (None, None)
    grad_colours, directions = device.empty((count, 3)), device.empty((count, 3))
    grad_means, active = device.empty((count, 2)), device.empty(count, np.uint32)
    pose_terms = device.empty((count, POSE_REALS)) if with_pose else None
    channels = dict(splat_grads.defines).get("CHANNELS")
    grad_features = device.empty((count, channels)) if channels else None
    device.launch(
        ADJOINT,
        defines,
        work=max(count, 1),
        half_width=size[0] / 2,
        half_height=size[1] / 2,
        counts=counts,
        rows=visible,
        camera=camera,
        **_learned(rows),
        **pairs,
        **{f"grad_{name}": g for name, g in stored.items()},
        grad_colours=grad_colours,
        directions=directions,
        grad_means=grad_means,
        active=active,
        skipped=skipped,
        frozen=frozen,
        grad_norm_sum=norms,
        seen_count=seen,
        photo=masked,
        pose_terms=pose_terms,
        grad_features=grad_features,
    )
    fields = FieldGradients(stored, grad_colours, directions, rows["sh_rest"].shape[1], defines, counts)
    return Gradients(fields, grad_means, active, visible, counts, pose_terms, grad_features)


def sum_pairs(device: Device, splat_grads: SplatGrads, counts: Array, defines: Defines) -> Array:
    """Add the gradients of a band to those of the bands before.

    Parameters
    ----------
    splat_grads : of `blend_adjoint`, for a band.
    counts : uint[FRAME_COUNTS], of the frame.
    defines : the build-time choices of the renderer.

    Returns
    -------
    real[V, S], the sums over these bands.
    """
    summed, pairs = _summed(splat_grads)
    totals = splat_grads.earlier
    if totals is None:
        totals = device.empty((len(splat_grads.offsets), splat_grads.pair_grads.shape[1]))
    device.launch(SUM_PAIRS, (*of_degree(defines, 0), *summed), counts=counts, **pairs, totals=totals)
    return totals


def adjoint_choices(with_frozen: bool, with_statistics: bool, masked: bool, with_pose: bool) -> Defines:
    """The build-time choices of `project_adjoint` besides those of `project`, before those of
    `summed_choices`."""
    return (
        ("WITH_FROZEN", int(with_frozen)),
        ("WITH_STATISTICS", int(with_statistics)),
        ("MASKED", int(masked and with_statistics)),
        ("WITH_POSE", int(with_pose)),
    )


def summed_choices(splat_defines: Defines, carried: bool = False) -> Defines:
    """The build-time choices of kernels that add up gradients of pairs: `SplatGrads.defines`, and
    whether those of earlier bands are there."""
    return *splat_defines, ("CARRIED", int(carried))


def _summed(splat_grads: SplatGrads) -> tuple[Defines, dict[str, Array]]:
    """The defines and arguments of kernels that add up the gradients of pairs."""
    grads, earlier = splat_grads.pair_grads, splat_grads.earlier
    return (
        summed_choices(splat_grads.defines, earlier is not None),
        dict(
            splat_counts=splat_grads.splat_counts,
            offsets=splat_grads.offsets,
            pair_grads=grads,
            earlier=grads if earlier is None else earlier,
        ),
    )


def _learned(rows: Rows) -> dict[str, Array | None]:
    return {**{field.name: rows[field.name] for field in LEARNED}, **{name: rows.get(name) for name in _PAGED}}


def of_rows(defines: Defines, rows: Rows, degree: int) -> Defines:
    """The defines of the build for rows and an active degree of the spherical harmonics."""
    return (*of_degree(defines, degree), *paged_defines(rows, degree))


def paged_defines(rows: Rows, degree: int) -> Defines:
    """The define of kernels that read the harmonics of rows, if these are paged."""
    return (("PAGED", 1),) if degree and "places" in rows else ()


def of_degree(defines: Defines, degree: int) -> Defines:
    """The defines of the build for an active degree of the spherical harmonics."""
    return *defines, ("DEGREE", degree)
