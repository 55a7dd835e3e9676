"""Options of how a scene is cut into blocks."""

import math
from dataclasses import dataclass, replace

from clsplat.config.option import AUTO, check_flag, is_auto, option, options_of
from clsplat.errors import InputError

METHODS = ("citygs", "blockgs", "vastgs")
LEAST_GAUSSIANS = 100  # of a block
MOST_BLOCKS = 10_000
# where `auto` leaves it open: without a joint training, and with one
BLOCK_STEPS, BLOCK_STEPS_BEFORE_JOINT = 2.0, 0.25
EXCHANGES, JOINT_STEPS = 3, 0.5


@dataclass(frozen=True)
class PartitionOptions:
    """How a scene is cut into blocks.

    Attributes
    ----------
    expected : gaussians of the whole scene at the end of training; 0 if that is not known.
    least_blocks : the least number of blocks of a chosen grid.
    workers, sharing : how many train blocks at the same time, and on the same device.
    least_gaussians : a block with fewer gaussians is joined to a neighbour, too.

    Raises
    ------
    InputError : no scene can be cut with these options.
    """

    method: str = option(
        "citygs",
        "Blocks",
        "citygs: a regular grid, each block with the views "
        "that change without it; blockgs: halves of equal content, with the views "
        "that see it; vastgs: cells with equally many cameras",
        choices=METHODS,
    )
    grid: tuple[int, int] | None = option(
        None,
        "Blocks",
        "number of blocks along both sides of the ground, such as 3x3; auto: as many as --block-gaussians requires",
        words={AUTO: None},
        separator="x",
        minimum=1,
        expects="blocks along both sides, 1 or more each way, such as 3x3",
    )
    block_gaussians: int = option(  # the grid that it chose is kept
        0,
        "Blocks",
        "gaussians that a block may end with; auto: as many as fit the device",
        affects="nothing",
        words={AUTO: 0},
        minimum=LEAST_GAUSSIANS,
    )
    margin: float = option(
        0.3,
        "Blocks",
        "width of the strip around a block that it also trains, as a share of the block's sides",
        minimum=0.0,
        maximum=10.0,
        measured=True,
    )
    threshold: float = option(
        0.003,
        "Blocks",
        "citygs assigns a view to a block if the view without the block changes by more than this, as 1 - SSIM",
        minimum=0.0,
        maximum=2.0,
        measured=True,
    )
    exchanges: int = option(
        AUTO,
        "Blocks",
        "how often neighbouring blocks exchange their "
        "gaussians while they train, so that both sides of a border agree; "
        "blocks with few steps do it less often, and with --time-budget never; "
        "auto: never before a joint training, else 3",
        words={AUTO: AUTO},
        minimum=0,
        maximum=20,
        measured=True,
    )
    block_steps: float = option(
        AUTO,
        "Blocks",
        "steps of all blocks together, as a multiple of "
        "those of one run; with more, each gaussian is seen more often, "
        "which is better and takes longer; auto: 0.25 before a joint "
        "training, else 2",
        words={AUTO: AUTO},
        minimum=0.1,
        maximum=100.0,
        measured=True,
    )
    joint_steps: float = option(
        AUTO,
        "Blocks",
        "steps of the joint training, in which the whole "
        "is trained on one device from points of the blocks' gaussians and "
        "dense points, as a multiple of those of one run; auto: 0.5, where "
        "that device holds the whole and one run takes all the steps that "
        "its photos allow (--visits), with --schedule sig",
        words={AUTO: AUTO, "none": 0.0},
        minimum=0.01,
        maximum=10.0,
        measured=True,
    )
    least_views: int = option(8, "Blocks", "number of views below which a block is joined to a neighbour", minimum=0)
    expected: int = 0
    least_blocks: int = 1
    workers: int = 1
    sharing: int = 1
    least_gaussians: int = LEAST_GAUSSIANS

    def __post_init__(self) -> None:
        for known in options_of(type(self)):
            value = getattr(self, known.name)
            if value is not known.default:
                object.__setattr__(self, known.name, check_flag(known, value))
        most = MOST_BLOCKS  # fewer where it is known for how many there are gaussians
        if self.grid and self.expected:
            most = min(most, max(1, self.expected // max(1, self.least_gaussians)))
        if self.blocks > most:
            given = (
                f"--grid {self.grid[0]}x{self.grid[1]}" if self.grid else f"--block-gaussians {self.block_gaussians}"
            )
            raise InputError(
                f"{given}: makes {self.blocks:,} blocks of about {self.expected:,} "
                f"gaussians, more than {most:,}; make fewer and larger blocks"
            )

    def decided(self, joint: bool = False) -> "PartitionOptions":
        """The options with a number in place of each `auto` that concerns steps; `joint` : whether
        there is a joint training where the options leave that open."""

        def number(value: float, chosen: float) -> float:
            return chosen if is_auto(value) else value

        steps = number(self.joint_steps, JOINT_STEPS if joint else 0.0)
        return replace(
            self,
            joint_steps=steps,
            exchanges=int(number(self.exchanges, 0 if steps else EXCHANGES)),
            block_steps=number(self.block_steps, BLOCK_STEPS_BEFORE_JOINT if steps else BLOCK_STEPS),
        )

    @property
    def blocks(self) -> int:
        """The number of blocks of --grid, or the least number of those of a chosen grid."""
        if self.grid:
            return math.prod(self.grid)
        if not self.block_gaussians:
            return self.least_blocks
        return max(math.ceil(self.trained / self.block_gaussians), self.least_blocks)

    @property
    def trained(self) -> float:
        """About how many gaussians all blocks train, of which those in margins are in several."""
        return self.expected * (1 + 2 * self.margin) ** 2
