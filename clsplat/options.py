"""The options of a training, composed of the groups that each package declares."""

import dataclasses
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.config.option import AUTO, MOST_STEPS, SHOWN, Option, checked, is_auto, option, options_of, shown_name
from clsplat.densify.options import GrowthOptions
from clsplat.errors import InputError
from clsplat.loss import options as loss
from clsplat.loss.options import REGISTERED as PARTS
from clsplat.optimise.options import OptimiseOptions, PoseOptions
from clsplat.rendering.options import RenderingOptions
from clsplat.schedule.mcmc import McmcOptions
from clsplat.schedule.registry import OURS, others, schedule_of
from clsplat.schedule.registry import REGISTERED as SCHEDULES
from clsplat.schedule.sig_options import SigOptions
from clsplat.schedule.steps import PUBLISHED_LENGTH
from clsplat.schedule.taming import TamingOptions

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef]

MOST_SECONDS = 366 * 24 * 3600.0  # in a time budget
UNIT_SECONDS = {"s": 1, "m": 60, "h": 3600}
UNIT_BYTES = {"GiB": 2**30, "MiB": 2**20, "GB": 10**9, "MB": 10**6}
LEAST_BYTES = 2**24  # of a memory budget


def seconds_of(text: str) -> float:
    """Parse `--time-budget`: a number with the unit s, m or h, or without one for seconds.

    Raises ValueError for anything else.
    """
    try:
        unit = UNIT_SECONDS.get(text[-1:])
        seconds = float(text if unit is None else text[:-1]) * (unit or 1)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < math.inf:
        raise ValueError
    if seconds > MOST_SECONDS:
        raise ValueError("at most a year")
    return seconds


def bytes_of(text: str) -> int:
    """Parse `--memory-budget`: a number of bytes with a unit of UNIT_BYTES, such as 6GiB.

    Raises ValueError for anything else.
    """
    unit = next((unit for unit in UNIT_BYTES if text.endswith(unit)), None)
    if unit is None:
        raise ValueError
    nbytes = float(text.removesuffix(unit)) * UNIT_BYTES[unit]
    if not LEAST_BYTES <= nbytes < math.inf:
        raise ValueError(f"at least {LEAST_BYTES >> 20}MiB")
    return int(nbytes)


@dataclass(frozen=True)
class SceneOptions:
    """Which photos are used, at which size, and the initial gaussians."""

    downscale: float = option(
        1.0, "Scene", "divide the width and height of the photos by this", short="-r", main=True, minimum=1.0
    )
    max_resolution: int = option(
        1600,
        "Scene",
        "reduce photos whose longer side has more pixels than this",
        main=True,
        words={"none": 0},
        minimum=1,
    )
    images: str = option(
        "",
        "Scene",
        "folder of the photos, relative to SCENE, such as images_4; auto: images, else the largest folder images_N",
        main=True,
        words={"auto": ""},
    )
    test_every: int = option(
        8,
        "Scene",
        "hold out every N-th view, in the order of names, for evaluation",
        main=True,
        words={"none": 0},
        minimum=1,
    )
    test_offset: int = option(
        0,
        "Scene",
        "with --test-every N: views before the first one that is "
        "held out, less than N; other offsets hold out other views",
        minimum=0,
    )
    init: str = option(
        AUTO,
        "Scene",
        "initial gaussians: sfm (the sparse points), dense (places "
        "on which several photos agree), random, or a file of gaussians or points; "
        "auto: dense with --schedule sig, where photos overlap and the run is not "
        "short, else sfm",
        main=True,
        measured=True,
    )


@dataclass(frozen=True)
class RunOptions:
    """How long a run is, which schedule it follows, on which device, and what it writes.

    A run may be resumed on another device; its record names the first.
    """

    iterations: int = option(
        AUTO,
        "Run",
        "training steps; auto: 300 for each training photo, at "
        "least 7000 and at most 30000; --visits may end them earlier",
        short="-n",
        main=True,
        words={AUTO: AUTO},
        minimum=1,
        most=MOST_STEPS,
        measured=True,
    )
    steps_scale: float = option(
        1.0,
        "Run",
        "multiply the number of steps, and every step count of the schedule, by this",
        minimum=1e-4,
        most=1e4,
    )
    seed: int = option(
        0, "Run", "seed of all random choices; the same seed and device give the same bytes", main=True, minimum=0
    )
    stop_at: int = option(
        0,
        "Run",
        "stop after this step, as if interrupted; the schedule stays that of -n",
        affects="nothing",
        words={"none": 0},
        minimum=1,
    )
    time_budget: str = option(
        "",
        "Run",
        "time for the whole run, such as 90s, 10m or 2h, in place of -n; the schedule is fitted to it",
        main=True,
        words={"none": ""},
        check=seconds_of,
        expects="a number of seconds, or one with s, m or h such as 10m",
    )
    checkpoint_every: int = option(
        AUTO,
        "Run",
        "steps between checkpoints; auto: half a minute, "
        "or longer where writing them would take more than a twentieth "
        "of the time; end: only at the end",
        affects="nothing",
        words={AUTO: AUTO, "end": 0},
        minimum=1,
    )
    eval_every: int = option(
        AUTO,
        "Run",
        "steps between evaluations on the held-out views; auto: "
        "eight evaluations, fewer where they are slow; end: only at the end",
        affects="time",
        main=True,
        words={AUTO: AUTO, "end": 0},
        minimum=1,
    )
    coarse: bool = option(
        False,
        "Run",
        "train the coarse model of a city: photos at half size, unless -r says otherwise",
        sets={True: {"downscale": 2.0, "max_resolution": SceneOptions.max_resolution // 2}},
    )
    schedule: str = option(
        "sig",
        "Schedule",
        "how resolution and growth are decided: sig follows "
        "the scene frequency; constant is 3DGS; dash is DashGaussian; taming is "
        "Taming 3DGS; mcmc is 3DGS-MCMC",
        main=True,
        choices=tuple(OURS),
        more=others,
        measured=True,
    )
    device: str = option(
        "auto",
        "Device",
        "auto, cpu, gpu, a number of `clsplat devices`, or part of a name",
        affects="nothing",
        main=True,
    )
    memory_budget: str = option(
        "",
        "Device",
        "memory of the device that a training may use, such "
        "as 6GiB; what does not fit waits in host memory, and the bytes of "
        "the result are the same; none: all of it",
        main=True,
        words={"none": ""},
        check=bytes_of,
        expects="a size of at least 16MiB, such as 6GiB or 800MiB",
    )
    form: str = option(
        "auto",
        "Device",
        "form of the kernels: item suits CPUs, group suits GPUs; they agree to rounding",
        choices=("auto", "item", "group"),
        flag=False,
    )


@dataclass(frozen=True)
class ScheduledOptions(
    TamingOptions,
    McmcOptions,
    GrowthOptions,
    SigOptions,
    OptimiseOptions,
    loss.ReprojectOptions,
    loss.ImageLossOptions,
    RenderingOptions,
    RunOptions,
):
    """What a schedule and a step read, which see neither photos nor files."""


@dataclass(frozen=True)
class TrainOptions(
    PoseOptions,
    loss.DepthOptions,
    loss.RobustOptions,
    loss.ExposureOptions,
    loss.RegulariseOptions,
    SceneOptions,
    loss.PartOptions,
    ScheduledOptions,
):
    """Everything that decides a training; defaults are those of Kerbl et al. (2023).

    Its bases are the groups that concerns and parts declare. A function takes the group that it
    reads, and is given the whole. The help lists the groups from the last base to the first.
    """

    def check_agreement(self, given: dict[str, Any]) -> None:
        """InputError for options that contradict each other; `given` are those of the user."""
        for known in options_of(type(self)):
            if given.get(known.name, known.default) != known.default and not serves(known, self.schedule):
                serving = [name for name in OURS if serves(known, name)]
                raise InputError(
                    f"{shown_name(known)}: has no effect with --schedule {self.schedule}; leave "
                    f"it out, or use --schedule {' or '.join(serving)}"
                )
        if self.poses == "on" and self.reproject != "off":
            raise InputError(
                "--poses on: does not go with --reproject, which compares photos by "
                "the poses that were given; leave one of them out"
            )
        if self.test_offset >= max(1, self.test_every):
            every = self.test_every or "none"
            raise InputError(f"--test-offset {self.test_offset}: must be less than --test-every, which is {every}")
        steps = PUBLISHED_LENGTH if is_auto(self.iterations) else self.iterations
        if steps * self.steps_scale > MOST_STEPS:
            raise InputError(
                f"--steps-scale {self.steps_scale:g}: turns {steps:,} "
                f"steps into more than {MOST_STEPS:,}; give a smaller factor"
            )
        if self.time_budget and steps != PUBLISHED_LENGTH:  # the number of presets
            raise InputError("--time-budget: decides the number of steps, as -n does; leave one of them out")


# the options that decide which others there are
_FIRST = {"schedule": TrainOptions.schedule, "add_parts": TrainOptions.add_parts}


def options_with(*schedules: str, parts: Iterable[str] = ()) -> type[TrainOptions]:
    """TrainOptions with the own options of schedules and parts that other packages register."""
    found = [
        SCHEDULES.own_options(name, schedule_of(name).Options, TrainOptions) for name in schedules if name not in OURS
    ]
    found += [PARTS.own_options(name, getattr(PARTS.load(name), "Options", None), TrainOptions) for name in parts]
    groups = tuple(dict.fromkeys(filter(None, found)))
    return (
        dataclasses.make_dataclass(TrainOptions.__name__, [], bases=(*groups, TrainOptions), frozen=True)
        if groups
        else TrainOptions
    )


def checked_values(source: str, values: dict[str, Any], *schedules: str) -> dict[str, Any]:
    """The checked values of options, by name; InputError, which begins with `source`, for others.

    The schedule and the parts among the values add their own options, and so do `schedules`.
    """
    name, named = (checked(TrainOptions, source, key, {**_FIRST, **values}[key]) for key in _FIRST)
    kind = options_with(name, *schedules, parts=named)
    return {key: checked(kind, source, key, value) for key, value in values.items()}


def from_toml(path: str | os.PathLike[str], *schedules: str) -> dict[str, Any]:
    """The options of a training in a TOML file; `schedules` as for `checked_values`."""
    try:  # utf-8-sig: with the mark of Windows editors
        pairs = tomllib.loads(Path(path).read_text("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:  # also from integers of 4301 digits
        raise InputError(f"{path}: not valid TOML: {str(error)[:SHOWN]}") from None
    values = {key.replace("-", "_"): value for key, value in pairs.items()}
    if len(values) < len(pairs):
        raise InputError(f"{path}: an option is set twice, with - and with _; remove one line")
    return checked_values(str(path), values, *schedules)


def resolve(file_values: dict[str, Any], flag_values: dict[str, Any]) -> TrainOptions:
    """Build TrainOptions from the values of a TOML file, overridden by those of the command line.

    An option that neither gives has the value that the schedule, preset, size and the like set.
    Raises InputError for options that contradict each other.
    """
    given = checked_values("", {**file_values, **flag_values})
    name = given.get("schedule", TrainOptions.schedule)
    kind = options_with(name, parts=given.get("add_parts", ()))
    chosen = kind(**given)
    values = checked_values(f"defaults of the schedule {name}", schedule_of(name).defaults, name)
    for known in options_of(kind):
        values |= known.metadata["sets"].get(getattr(chosen, known.name), {})
    if any(
        given.get(known.name, known.default) != known.default
        for known in options_of(kind)
        if known.metadata["part"] == "spheres"
    ):
        values["sphere"] = True
    options = kind(**{**values, **given})
    options.check_agreement(given)
    return options


def recorded(record: dict[str, Any]) -> TrainOptions:
    """The options among the values of a run's options.json; InputError for a damaged one."""
    source, given = "options.json", {**_FIRST, **record}
    schedule, parts = (checked(TrainOptions, source, name, given[name]) for name in _FIRST)
    known = {option.name for option in options_of(options_with(schedule, parts=parts)) if serves(option, schedule)}
    return resolve(checked_values(source, {name: value for name, value in record.items() if name in known}), {})


def serves(known: Option, schedule: str) -> bool:
    """Whether an option has an effect with a schedule."""
    part = known.metadata["part"]
    return part is None or part in schedule_of(schedule).parts
