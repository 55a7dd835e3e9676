"""The options of a run: one table is the command line, the TOML file, the defaults and the record.

Each field carries its help text and unit; `cli/flags.py` derives the flags, `from_toml` the file
format, and the run folder stores the resolved values.
"""

import dataclasses
import math
import os
from dataclasses import dataclass, field
from typing import get_args

from clsplat import extensions
from clsplat.errors import InputError

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib


AUTO = "auto"


def option(default, group, text, short=None, choices=None, minimum=None, maximum=None, most=None,
           wish=None, only=None, auto=False, extensions=None):
    """A field of `TrainOptions`: its default and what the command line says about it.

    choices, minimum, maximum: of a value, or of each element of a tuple; most: the same as maximum,
    where that is no end of a scale but what a training can still be made with (None: MOST of its
    type); wish: what a refusal says is wanted, where these and the type do not say it well; only:
    the schedules it means something to (None: all); auto: whether a number may also be "auto", for
    training/decisions.py to find; extensions: the group of entry points by which other packages add
    choices.
    """
    return field(default=default, metadata={
        "group": group, "help": text, "short": short, "choices": choices, "minimum": minimum,
        "maximum": maximum, "most": most, "wish": wish, "only": only, "auto": auto,
        "extensions": extensions})


MOST = {int: 2**63 - 1, float: 1e15}  # squares and their sums stay far within float32
MOST_STEPS = 10_000_000  # of a training: 300 times the default
MOST_ELEMENTS = 1000  # of a list
LONGEST_TEXT = 4096  # characters: the longest path that Linux takes
LARGEST_FILE = 1 << 20  # bytes of a TOML file
MOST_SECONDS = 366 * 24 * 3600.0  # of a time budget
SHOWN = 200  # characters, of what a user gave, in a message
SIG = ("sig",)
LEVELLED = ("sig", "dash")  # schedules that change the level


@dataclass(frozen=True)
class TrainOptions:
    """Everything that decides a training; defaults are those of Kerbl et al. (2023)."""

    iterations: int = option(30000, "Run", "training steps", short="-n", minimum=1,
                             most=MOST_STEPS)
    steps_scale: float = option(
        1.0, "Run", "multiply every step count of the schedule (and -n) by this", minimum=1e-4,
        most=1e4)
    seed: int = option(0, "Run", "same seed and device, same bytes", minimum=0)
    stop_at: int = option(0, "Run", "stop after this step; the schedule stays that of -n (0: off)",
                          minimum=0)
    time_budget: str = option("", "Run", "instead of -n: seconds, or 90s, 10m, 2h; the schedule is "
                              "laid over the time that steps take here")
    checkpoint_every: int = option(1000, "Run", "steps between checkpoints (0: only at the end)",
                                   minimum=0)
    eval_at: tuple[int, ...] = option((), "Run", "also evaluate after these steps; repeatable",
                                     minimum=1, wish="a list of steps, each at least 1")
    eval_every: int = option(AUTO, "Run", "steps between evaluations of the held-out views; auto: "
                             "eight, evenly over the run, as long as they take no more than a "
                             "third of the time so far, or a tenth of a time budget (0: only at "
                             "the end)", minimum=0, auto=True)
    snapshots: bool = option(False, "Run", "keep the model as each level leaves it: the levels of "
                             "detail of `clsplat render --lod`", only=LEVELLED)

    downscale: float = option(1.0, "Scene", "divide image width and height by this", short="-r",
                              minimum=1.0)
    max_resolution: int = option(1600, "Scene", "photos whose longer side has more pixels than "
                                 "this are reduced to it (0: photos keep their size)", minimum=0)
    images: str = option("", "Scene", "folder of the photos, from SCENE's own: images_4, say, "
                         "whose photos are smaller than the model's cameras (none: images)")
    test_every: int = option(8, "Scene", "hold out every N-th view by name (0: none)", minimum=0)
    init: str = option("sfm", "Scene", "initial gaussians: sfm, random, or a PLY file")
    background: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "Scene", "background colour, three numbers from 0 to 1",
        minimum=0.0, maximum=1.0, wish="three numbers from 0 to 1")

    schedule: str = option("sig", "Method", "how resolution and growth are decided: sig follows "
                           "the scene's frequency; constant is 3DGS",
                           choices=("sig", "constant", "dash", "taming"),
                           extensions=extensions.SCHEDULES)
    preset: str = option("ours", "Method", "choices of the SIG paper, its released code, or ours",
                         choices=("ours", "paper", "release"), only=SIG)
    coarse: bool = option(False, "Method", "a scaffold for the blocks of a larger scene: photos at "
                          "half size, unless -r says otherwise")
    size: str = option("S", "Method", "growth threshold of the paper's small or large model",
                       choices=("S", "L"))
    exposure: str = option("auto", "Method", "learn a colour transform a photo; auto: where photos "
                           "drift in brightness", choices=("auto", "on", "off"))
    sh_degree: int = option(3, "Method", "highest degree of the spherical harmonics; auto: what "
                            "the angles under which points are seen can tell apart", minimum=0,
                            maximum=3, auto=True)
    sh_every: int = option(1000, "Method", "steps between degrees", minimum=1)
    ssim_weight: float = option(0.2, "Method", "share of D-SSIM in the loss", minimum=0.0,
                                maximum=1.0)
    antialiased: bool = option(False, "Method", "scale opacity by the area the low-pass adds")
    batch: int = option(1, "Method", "photos a step learns from: their mean gradient moves the "
                        "gaussians once; a step costs as many times as much", minimum=1, most=1024)
    optimizer: str = option("dense", "Method", "Adam on all rows, or on those seen in the view",
                            choices=("dense", "sparse"))
    engine: str = option("auto", "Method", "where Adam runs: its moments on the device, or in "
                         "host memory by numpy", choices=("auto", "device", "numpy"))
    near: float = option(0.0, "Method", "near plane, world units (0: 1/500 of the scene extent)",
                         minimum=0.0)

    opacity_rate: float = option(0.025, "Method", "learning rate of the opacity logits",
                                 minimum=0.0)

    levels: tuple[float, ...] = option(
        (), "Levels", "down-sampling factors, coarse to fine, ending at 1; repeatable (none given: "
        "5 4 3 2 1 without those too small to matter)", minimum=1.0, only=SIG,
        wish="factors of at least 1, coarse to fine")
    frequency: str = option("robust", "Levels", "which scene frequency decides", only=SIG,
                            choices=("robust", "paper", "release"))
    convergence: str = option("robust", "Levels", "test of its convergence", only=SIG,
                              choices=("robust", "paper", "release"))
    convergence_rate: float = option(
        1e-4, "Levels", "converged when the frequency grows by less a step than this share of it "
        "(paper: of the points' mean 1 / distance; release: not used)", minimum=0.0, only=SIG)
    convergence_hits: int = option(2, "Levels", "tests in a row that must agree", minimum=1,
                                   only=SIG)
    level_share: float = option(0.7, "Levels", "share of the run that the coarser levels may take "
                                "together (1: no deadlines)", minimum=0.0, maximum=1.0, only=SIG)
    rounds: int = option(12, "Levels", "at most so many rounds of growth a level (0: grow as "
                         "constant does)", minimum=0, only=SIG)
    level_reset: bool = option(True, "Levels", "reset opacities at the start of each level, so "
                               "that gaussians the sharper images do not need are pruned", only=SIG)
    pixels_per_gaussian: float = option(
        40.0, "Levels", "training pixels, at the level's size, that a gaussian must have for the "
        "model to grow (0: any)", minimum=0.0, only=SIG)

    sphere: bool = option(True, "Sphere", "remove gaussians that leave the sphere around their "
                          "anchor", only=SIG)
    sphere_neighbours: int = option(15, "Sphere", "its radius: mean distance of a point to so many "
                                    "others", minimum=1, only=SIG)
    sphere_reach: float = option(30.0, "Sphere", "... times this", minimum=0.0, only=SIG)
    sphere_shrink: float = option(0.7, "Sphere", "radius of split children, share of the parent's",
                                  minimum=0.0, only=SIG)
    sphere_rule: str = option("paper", "Sphere", "anchor of split children: the parent's (paper) "
                              "or their own place (release)", choices=("paper", "release"),
                              only=SIG)
    sphere_columns: bool = option(False, "Sphere", "also write anchors and radii to the PLY",
                                  only=SIG)

    reproject: str = option("off", "Regularisation", "while growing, compare each photo with an "
                            "adjacent one through the rendered depth; auto: where there are any",
                            choices=("off", "auto", "on"), only=SIG)
    reproject_weight: float = option(0.1, "Regularisation", "its weight, which decays to a tenth",
                                     minimum=0.0, only=SIG)

    taming_budget: float = option(15.0, "Growth", "gaussians at the end, times those at the start",
                                  minimum=1.0, only=("taming",))
    max_gaussians: int = option(0, "Growth", "never more gaussians than this (0: no limit)",
                                minimum=0)
    densify_from: int = option(500, "Growth", "first step that may grow", minimum=0)
    densify_until: int = option(0, "Growth", "last step that may grow (0: half of -n, "
                               "dash 0.9 of it, sig any)", minimum=0)
    densify_every: int = option(0, "Growth", "steps between rounds of growth (0: 100, under sig "
                                "up to 200 where the levels are long, under taming a 60th of -n "
                                "if that is more)", minimum=0)
    grow_threshold: float = option(2e-4, "Growth", "mean screen gradient that grows, NDC units",
                                   minimum=0.0)
    split_size: float = option(0.01, "Growth", "larger ones split, smaller ones clone; x extent",
                               minimum=0.0)
    prune_opacity: float = option(0.005, "Growth", "fainter gaussians are removed", minimum=0.0,
                                  maximum=1.0)
    prune_size: float = option(0.0, "Growth", "larger gaussians are removed, under constant once "
                               "opacities were reset; x extent (0: none)", minimum=0.0)
    reset_every: int = option(0, "Growth", "steps between opacity resets (0: never)", minimum=0)

    device: str = option("auto", "Device", "auto, cpu, gpu, a number of `clsplat devices`, or part "
                         "of a name")
    form: str = option("auto", "Device", "kernel form: item suits CPUs, group suits GPUs",
                       choices=("auto", "item", "group"))


# what a choice sets besides itself, unless the user says otherwise; later ones win
CHOICES = {
    "schedule": {
        "constant": {"reset_every": 3000, "exposure": "off", "opacity_rate": 0.05,
                     "prune_size": 0.1},
        "dash": {"reset_every": 3000, "exposure": "off"},
        "taming": {"reset_every": 3000, "exposure": "off", "prune_size": 0.1},
    },
    "convergence": {"paper": {"convergence_rate": 5e-5}},
    "preset": {
        "paper": {
            "levels": (5.0, 4.0, 3.0, 2.0, 1.0), "frequency": "paper", "convergence": "paper",
            "convergence_rate": 5e-5, "convergence_hits": 1, "level_share": 1.0,
            "densify_every": 200, "level_reset": False, "pixels_per_gaussian": 0.0,
            "prune_size": 0.1, "opacity_rate": 0.05, "sphere_reach": 15.0, "reproject": "on",
            "exposure": "off"},
        "release": {
            "levels": (5.0, 2.5, 5 / 3, 1.25, 1.0), "frequency": "release",
            "convergence": "release", "convergence_hits": 5, "level_share": 1.0,
            "densify_every": 200, "level_reset": False, "pixels_per_gaussian": 0.0,
            "prune_size": 0.05, "opacity_rate": 0.02, "grow_threshold": 1.25e-4,
            "sphere_neighbours": 8, "sphere_reach": 15.0, "sphere_shrink": 0.8,
            "sphere_rule": "release", "exposure": "off",
            "optimizer": "sparse", "ssim_weight": 0.33},
    },
    "size": {"L": {"grow_threshold": 1.25e-4}},
    "coarse": {True: {"downscale": 2.0, "max_resolution": TrainOptions.max_resolution // 2}},
}
UNITS = {"s": 1, "m": 60, "h": 3600}


def seconds_of(text):
    """The seconds of `--time-budget`: a number, or one with the unit s, m or h."""
    try:
        unit = UNITS[text[-1]] if text[-1] in UNITS else None
        seconds = float(text if unit is None else text[:-1]) * (unit or 1)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < math.inf:
        raise InputError(f"--time-budget: wants seconds, or a number with s, m or h such as 90s, "
                         f"10m or 2h; got {text[:SHOWN]!r}")
    if seconds > MOST_SECONDS:
        raise InputError(f"--time-budget {text[:SHOWN]}: is longer than a year; give less time")
    return seconds


def from_toml(path):
    """The values a TOML file sets, as a dict; unknown keys and wrong types raise InputError."""
    try:
        if os.path.exists(path) and not os.path.isfile(path):
            raise InputError(f"{path}: cannot be read (it is not a file); give a TOML file of "
                             "options")
        with open(path, "rb") as file:
            data = file.read(LARGEST_FILE + 1)
        if len(data) > LARGEST_FILE:
            raise InputError(f"{path}: is larger than {LARGEST_FILE >> 20} MiB; give a TOML file "
                             "of options, such as iterations = 7000")
        table = tomllib.loads(data.decode("utf-8-sig"))  # Windows editors begin with a mark
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:  # tomllib: also of integers with 4301 digits
        raise InputError(f"{path}: not valid TOML: {str(error)[:SHOWN]}") from None
    values = {}
    for key, value in table.items():
        name = key.replace("-", "_")
        if name in values:
            raise InputError(f"{path}: option '{name}' is set twice; remove one of the two lines")
        values[name] = checked(str(path), name, value)
    return values


def checked(source, key, value):
    """`value` in the type of option `key`, within its limits; InputError names `source`.

    Whole numbers serve as fractions, and lists (what TOML and JSON have) as tuples.
    """
    known = {f.name: f for f in dataclasses.fields(TrainOptions)}
    if key not in known:
        raise InputError(f"{source}: unknown option {key[:SHOWN]!r}; see `clsplat train "
                         "--help-all`")
    kind, meta = known[key].type, known[key].metadata
    elements = get_args(kind)  # of a tuple; none otherwise
    try:
        if not elements:
            return _checked_one(kind, meta, value)
        if not isinstance(value, (list, tuple)) or (
                ... not in elements and len(value) != len(elements)):
            raise ValueError
        if len(value) > MOST_ELEMENTS:
            raise _TooMuch(f"at most {MOST_ELEMENTS} values")
        return tuple(_checked_one(elements[0], meta, element) for element in value)
    except ValueError as error:
        wish = error if isinstance(error, _TooMuch) else meta["wish"] or error
        raise InputError(f"{source}: option '{key.replace('_', '-')}' wants {wish}, "
                         f"got {_shown(value)}") from None


def _shown(value):
    try:
        return repr(value)[:SHOWN]
    except ValueError:  # Python does not write out integers of more than 4300 digits
        return "a number of thousands of digits"


class _TooMuch(ValueError):
    """More than an option may have; says how much it may."""


def _checked_one(kind, meta, value):
    """`value` as `kind`; ValueError says what is wanted."""
    if meta["auto"] and value == AUTO:
        return value
    if type(value) is int and abs(value) >= 2**63:
        raise ValueError("a number below 2^63")
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise ValueError(kind.__name__)
    low, high = meta["minimum"], meta["maximum"]
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        raise ValueError(f"at least {low}" if high is None else f"from {low} to {high}")
    if kind is float and not math.isfinite(value):
        raise ValueError("a finite number")
    most = MOST.get(kind) if meta["most"] is None else meta["most"]
    if most is not None and value > most:
        raise _TooMuch(f"at most {most:,}" if kind is int else f"at most {most:g}")
    if meta["choices"] and value not in meta["choices"]:
        others = extensions.names(meta["extensions"]) if meta["extensions"] else ()
        if value not in others:
            raise ValueError(f"one of {', '.join((*meta['choices'], *others))}")
    if kind is str:
        _check_text(value)
    return value


def _check_text(text):
    """ValueError for what a record, or the path of a file, cannot hold."""
    if len(text) > LONGEST_TEXT:
        raise ValueError(f"at most {LONGEST_TEXT} characters")
    if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
        raise ValueError("text in Unicode")


def resolve(file_values, flag_values) -> TrainOptions:
    """TrainOptions from a TOML file's values overridden by the command line's.

    Unless given, an option has the value that the given schedule, preset and size choose for it.
    Raises InputError for options that contradict each other.
    """
    given = {k: checked("command line", k, v) for k, v in {**file_values, **flag_values}.items()}
    chosen = TrainOptions(**given)
    values = _defaults_of(chosen.schedule)
    for choice, table in CHOICES.items():
        values |= table.get(getattr(chosen, choice), {})
    options = TrainOptions(**{**values, **given})
    _check_agreement(options, given)
    return options


def _defaults_of(schedule):
    """{option: value} that a schedule of another package sets unless the user says otherwise."""
    if schedule in TrainOptions.__dataclass_fields__["schedule"].metadata["choices"]:
        return {}
    defaults = getattr(extensions.load(extensions.SCHEDULES, schedule), "defaults", {})
    return {key: checked(f"defaults of the schedule {schedule}", key, value)
            for key, value in defaults.items()}


def _check_agreement(options, given):
    for known in dataclasses.fields(TrainOptions):
        only = known.metadata["only"]
        if only and options.schedule not in only and given.get(
                known.name, known.default) != known.default:
            raise InputError(
                f"--{known.name.replace('_', '-')}: means nothing to --schedule "
                f"{options.schedule}; leave it out, or use --schedule {' or '.join(only)}")
    levels = options.levels
    if levels and (levels[-1] != 1 or any(a <= b for a, b in zip(levels, levels[1:]))):
        raise InputError(f"--levels {','.join(f'{v:g}' for v in levels)}: wants factors that fall "
                         "and end at 1, such as 4,2,1")
    if options.iterations * options.steps_scale > MOST_STEPS:
        raise InputError(f"--steps-scale {options.steps_scale:g}: makes {options.iterations:,} "
                         f"steps more than {MOST_STEPS:,}; give a smaller one")
    if options.time_budget:
        seconds_of(options.time_budget)
        if options.iterations != TrainOptions.iterations:
            raise InputError("--time-budget: decides the number of steps, as -n does; "
                             "leave one of them out")
