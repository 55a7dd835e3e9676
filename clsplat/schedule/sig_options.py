"""Options of the SIG schedule, and the presets of its authors."""

from dataclasses import dataclass

from clsplat.config.option import AUTO, option
from clsplat.schedule.plan import AS_PUBLISHED

# the choices of the authors' paper and of their released code, whose Adam is sparse
PAPER = {
    **AS_PUBLISHED,
    "iterations": 30_000,
    "init": "sfm",
    "levels": (5.0, 4.0, 3.0, 2.0, 1.0),
    "frequency": "paper",
    "convergence": "paper",
    "convergence_rate": 5e-5,
    "convergence_hits": 1,
    "level_share": 1.0,
    "densify_every": 200,
    "pixels_per_gaussian": 0.0,
    "prune_size": 0.1,
    "opacity_rate": 0.05,
    "sphere": True,
    "sphere_reach": 15.0,
    "reproject": "on",
    "visits": 0.0,
}
RELEASE = {
    **AS_PUBLISHED,
    "iterations": 30_000,
    "init": "sfm",
    "sphere": True,
    "levels": (5.0, 2.5, 5 / 3, 1.25, 1.0),
    "frequency": "release",
    "convergence": "release",
    "convergence_hits": 5,
    "level_share": 1.0,
    "densify_every": 200,
    "pixels_per_gaussian": 0.0,
    "prune_size": 0.05,
    "opacity_rate": 0.02,
    "grow_threshold": 1.25e-4,
    "sphere_neighbours": 8,
    "sphere_reach": 15.0,
    "sphere_shrink": 0.8,
    "sphere_rule": "release",
    "visits": 0.0,
    "ssim_weight": 0.33,
}
VARIANTS = ("robust", "paper", "release")


def check_levels(levels: tuple[float, ...]) -> None:
    """Raise ValueError for factors that do not fall to 1."""
    if levels[-1:] != (1.0,) or any(a <= b for a, b in zip(levels, levels[1:])):
        raise ValueError


@dataclass(frozen=True)
class SigOptions:
    """Options of the `sig` schedule: when the next level begins, and how much each grows."""

    preset: str = option(
        "ours",
        "Schedule",
        "choices of the SIG paper, of its released code, or ours",
        main=True,
        choices=("ours", "paper", "release"),
        part="sig",
        sets={"paper": PAPER, "release": RELEASE},
    )
    levels: tuple[float, ...] = option(
        (),
        "Levels",
        "down-sampling factors of the levels, from coarse to fine, such as 4,2,1; "
        "auto: 5,4,3,2,1, or from dense points 8,4,2,1, without those whose images are too small "
        "to matter",
        words={AUTO: ()},
        minimum=1.0,
        expects="factors that fall and end at 1, such as 4,2,1",
        check=check_levels,
        part="sig",
        measured=True,
    )
    frequency: str = option(
        "robust",
        "Levels",
        "which scene frequency is tested for convergence",
        choices=VARIANTS,
        part="sig",
        flag=False,
        measured=True,
    )
    convergence: str = option(
        "robust",
        "Levels",
        "how it is tested",
        choices=VARIANTS,
        sets={"paper": {"convergence_rate": 5e-5}},
        part="sig",
        flag=False,
    )
    convergence_rate: float = option(
        1e-4,
        "Levels",
        "a level has converged when the scene frequency grows by less than this "
        "share of itself a step (convergence = paper: of the points' mean 1 / distance)",
        minimum=0.0,
        part="sig",
        flag=False,
        measured=True,
    )
    convergence_hits: int = option(
        2, "Levels", "tests in a row that must find convergence", minimum=1, part="sig", flag=False
    )
    level_share: float = option(
        AUTO,
        "Levels",
        "share of the run that the coarser levels may take together, each in "
        "proportion to its resolution; auto: as much as its resolution is of that of all levels; "
        "all: they have no deadlines",
        words={AUTO: AUTO, "all": 1.0},
        minimum=0.0,
        maximum=1.0,
        part="sig",
        flag=False,
        measured=True,
    )
    rounds: int = option(
        12,
        "Levels",
        "largest number of rounds of growth at each level",
        minimum=1,
        part="sig",
        flag=False,
        measured=True,
    )
    pixels_per_gaussian: float = option(
        AUTO,
        "Levels",
        "the model grows only while each gaussian has at least this many training "
        "pixels, at the level's size; auto: fewer where the photos agree about the colours",
        words={AUTO: AUTO, "none": 0.0},
        minimum=0.0,
        part="sig",
        measured=True,
    )
    visits: float = option(
        AUTO,
        "Levels",
        "most steps for each training photo; auto: 75, or 3500 in all, and "
        "fewer where the photos disagree about the colours, if -n is auto; all: any number",
        words={AUTO: AUTO, "all": 0.0},
        minimum=0.0,
        part="sig",
        measured=True,
    )
