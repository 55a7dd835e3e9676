"""Options of the optimiser."""

from dataclasses import dataclass

from clsplat.config.option import option


@dataclass(frozen=True)
class PoseOptions:
    """Corrections of the poses of training views."""

    poses: str = option(
        "off",
        "Optimisation",
        "on: correct the poses of the training photos a little, beside the gaussians",
        choices=("off", "on"),
        measured=True,
    )


@dataclass(frozen=True)
class OptimiseOptions:
    """How gradients move the gaussians."""

    batch: int = option(
        1,
        "Optimisation",
        "photos in each step; their mean gradient moves the gaussians once, and a step takes as many times longer",
        minimum=1,
        most=1024,
        measured=True,
    )
    engine: str = option(
        "auto",
        "Optimisation",
        "where Adam's moments are kept: device, coded on "
        "it in three bytes in place of eight, or numpy in host memory; auto: "
        "device, or coded if all would take more than a third of its memory",
        choices=("auto", "device", "coded", "numpy"),
        flag=False,
    )
    position_noise: float = option(
        0.0,
        "Optimisation",
        "random steps of nearly transparent gaussians, as a multiple of the learning rate of the positions",
        minimum=0.0,
        flag=False,
        measured=True,
    )
    opacity_rate: float = option(
        0.025, "Optimisation", "learning rate of the opacity logits", minimum=0.0, flag=False, measured=True
    )
    average: float = option(
        0.2,
        "Optimisation",
        "the finished gaussians are the mean of those in this last share of the steps, all of which are larger then",
        words={"none": 0.0},
        minimum=0.0,
        maximum=1.0,
        flag=False,
        measured=True,
    )
