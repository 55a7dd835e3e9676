"""Options of the losses, one class for each; kernels are not imported, so that --help is fast."""

from dataclasses import dataclass

from clsplat.config.option import option


@dataclass(frozen=True)
class ImageLossOptions:
    """The loss between a render and its photo."""

    ssim_weight: float = option(0.2, "Loss", "share of D-SSIM in the image loss, the rest is L1",
                                minimum=0.0, maximum=1.0)


@dataclass(frozen=True)
class ExposureOptions:
    """A colour transform of each photo, learned beside the gaussians."""

    exposure: str = option("auto", "Loss", "learn a colour transform for each photo; auto: where "
                           "the brightness of photos drifts", main=True,
                           choices=("auto", "on", "off"))


@dataclass(frozen=True)
class ReprojectOptions:
    """Colour differences between a photo and an adjacent one, through the rendered depth."""

    reproject: str = option("off", "Loss", "while the model grows, compare each photo with an "
                            "adjacent one through the rendered depth; auto: where adjacent photos "
                            "exist", choices=("off", "auto", "on"), part="reprojection")
    reproject_weight: float = option(
        0.1, "Loss", "initial weight of that comparison; it decays to a tenth", minimum=0.0,
        part="reprojection")
