"""What a schedule says of one step."""

import dataclasses
from dataclasses import dataclass


@dataclass(frozen=True)
class Plan:
    """level: down-sampling factor of the training images; degree: of the harmonics; gathers:
    whether densification statistics are kept; grows, resets_opacity: what follows the step."""

    level: float
    degree: int
    gathers: bool
    grows: bool
    resets_opacity: bool
    prunes_large: bool


STEP_COUNTS = ("iterations", "sh_every", "densify_from", "densify_until", "densify_every",
               "reset_every")


def scaled_steps(options):
    """TrainOptions with every step count times `steps_scale` and `densify_until` filled in."""
    until = options.densify_until or options.iterations // 2
    scaled = {name: getattr(options, name) for name in STEP_COUNTS} | {"densify_until": until}
    scaled = {name: max(1, round(value * options.steps_scale)) if value else 0
              for name, value in scaled.items()}
    return dataclasses.replace(options, **scaled, steps_scale=1.0)
