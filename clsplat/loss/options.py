"""Options of the losses, one class for each; kernels are not imported, so that --help is fast."""

from dataclasses import dataclass

from clsplat.config.option import option
from clsplat.config.plug_in import Group

REGISTERED = Group("clsplat.parts")  # NAME = MODULE:SUBCLASS_OF_PART


@dataclass(frozen=True)
class ImageLossOptions:
    """The loss between a render and its photo."""

    ssim_weight: float = option(
        0.2,
        "Loss",
        "share of D-SSIM in the image loss, the rest is L1",
        minimum=0.0,
        maximum=1.0,
        flag=False,
        measured=True,
    )


@dataclass(frozen=True)
class RegulariseOptions:
    """Regularisation of the gaussians that a view sees."""

    opacity_weight: float = option(
        0.01, "Loss", "weight of the mean opacity of the gaussians", minimum=0.0, flag=False, measured=True
    )
    scale_weight: float = option(
        0.0,
        "Loss",
        "weight of the mean standard deviation of the gaussians, as a share of the scene extent",
        minimum=0.0,
        flag=False,
        measured=True,
    )


@dataclass(frozen=True)
class ExposureOptions:
    """A colour transform of each photo, learned beside the gaussians."""

    exposure: str = option(
        "auto",
        "Loss",
        "learn a colour transform for each photo; auto: where the brightness of photos drifts",
        main=True,
        choices=("auto", "on", "off"),
        measured=True,
    )
    vignetting: str = option(
        "off",
        "Loss",
        "where exposures are learned, learn how much darker the corners of a camera's photos are; auto: where they are",
        choices=("off", "auto", "on"),
        measured=True,
    )


@dataclass(frozen=True)
class RobustOptions:
    """Pixels of photos that are left out, as something moved or glared."""

    robust: str = option(
        "off",
        "Loss",
        "leave out pixels of a photo that the model cannot explain "
        "though it explains the same place in other photos: people, cars, glare",
        main=True,
        choices=("off", "on"),
        measured=True,
    )


@dataclass(frozen=True)
class DepthOptions:
    """Depth maps that hold the training."""

    depth: str = option(
        "",
        "Loss",
        "folder of depth maps of the photos, relative to SCENE: 16-bit "
        "PNG in mm, or EXR, TIFF or NPY in the scene's units",
        main=True,
        words={"none": ""},
    )
    depth_weight: float = option(
        0.3,
        "Loss",
        "with --depth: weight of the relative difference between the rendered depth and the maps",
        minimum=0.0,
        flag=False,
    )


@dataclass(frozen=True)
class ReprojectOptions:
    """Colour differences between a photo and an adjacent one, through the rendered depth."""

    reproject: str = option(
        "off",
        "Loss",
        "while the model grows, compare each photo with an "
        "adjacent one through the rendered depth; auto: where adjacent photos "
        "exist",
        choices=("off", "auto", "on"),
        part="reprojection",
        measured=True,
    )
    reproject_weight: float = option(
        0.1,
        "Loss",
        "initial weight of that comparison; it decays to a tenth",
        minimum=0.0,
        part="reprojection",
        flag=False,
    )


def _check_names(names: tuple[str, ...]) -> None:
    if unknown := [name for name in names if name not in REGISTERED.others]:
        known = ", ".join(REGISTERED.others) or "nothing"
        raise ValueError(f"names of parts that packages of this environment register ({known}), not {unknown[0]!r}")


@dataclass(frozen=True)
class PartOptions:
    """Parts of other packages; their own options are in their files."""

    add_parts: tuple[str, ...] = option(
        (),
        "Run",
        "parts of other packages that the training has besides, such as a term of the loss",
        words={"none": ()},
        check=_check_names,
        flag=False,
    )
