"""Options of growth and pruning."""

from dataclasses import dataclass

from clsplat.config.option import AUTO, option


@dataclass(frozen=True)
class GrowthOptions:
    """When the model grows, which gaussians grow, and which are pruned."""

    size: str = option(
        "S",
        "Growth",
        "growth threshold of the paper's small (S) or large (L) model",
        choices=("S", "L"),
        sets={"L": {"grow_threshold": 1.25e-4}},
    )
    max_gaussians: int = option(0, "Growth", "largest number of gaussians", main=True, words={"none": 0}, minimum=1)
    densify_from: int = option(500, "Growth", "first step after which the model may grow", minimum=0, flag=False)
    densify_until: int = option(
        0,
        "Growth",
        "last step after which the model may grow; auto: the schedule decides",
        words={AUTO: 0},
        minimum=1,
        flag=False,
    )
    densify_every: int = option(
        0,
        "Growth",
        "steps between rounds of growth; auto: the schedule decides",
        words={AUTO: 0},
        minimum=1,
        flag=False,
    )
    grow_threshold: float = option(
        2e-4,
        "Growth",
        "mean gradient of the screen position, in NDC units, above which a gaussian is cloned or split",
        minimum=0.0,
        flag=False,
    )
    prune_opacity: float = option(
        0.005, "Growth", "remove gaussians of lower opacity", minimum=0.0, maximum=1.0, flag=False
    )
    prune_size: float = option(
        0.0,
        "Growth",
        "remove gaussians that are larger than this share of the scene extent",
        words={"none": 0.0},
        minimum=0.0,
        flag=False,
        measured=True,
    )
    reset_every: int = option(0, "Growth", "steps between opacity resets", words={"none": 0}, minimum=1, flag=False)
    # spheres around the initial points
    sphere: bool = option(
        False,
        "Spheres",
        "remove gaussians that leave the sphere around their anchor; on where another option of spheres is given",
        part="spheres",
        flag=False,
        measured=True,
    )
    sphere_neighbours: int = option(
        15,
        "Spheres",
        "number of nearest points whose mean distance is the unit of a sphere's radius",
        minimum=1,
        part="spheres",
        flag=False,
    )
    sphere_reach: float = option(
        30.0, "Spheres", "radius of a sphere, in these units", minimum=0.0, part="spheres", flag=False, measured=True
    )
    sphere_shrink: float = option(
        0.7,
        "Spheres",
        "radius of the children of a split, as a share of their parent's",
        minimum=0.0,
        part="spheres",
        flag=False,
    )
    sphere_rule: str = option(
        "paper",
        "Spheres",
        "anchor of the children of a split: their parent's anchor (paper), or their own position (release)",
        choices=("paper", "release"),
        part="spheres",
        flag=False,
    )
