"""The options of a run: one table is the command line, the TOML file, the defaults and the record.

Each field carries its help text and unit; `cli/flags.py` derives the flags, `from_toml` the file
format, and the run folder stores the resolved values.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import get_args

from clsplat.errors import InputError

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib


def option(default, group, text, short=None, choices=None, minimum=None, maximum=None, wish=None):
    """A field of `TrainOptions`: its default and what the command line says about it.

    choices, minimum, maximum: of a value, or of each element of a tuple; wish: what a refusal says
    is wanted, where these and the type do not say it well.
    """
    return field(default=default, metadata={
        "group": group, "help": text, "short": short, "choices": choices,
        "minimum": minimum, "maximum": maximum, "wish": wish})


@dataclass(frozen=True)
class TrainOptions:
    """Everything that decides a training; defaults are those of Kerbl et al. (2023)."""

    iterations: int = option(30000, "Run", "training steps", short="-n", minimum=1)
    steps_scale: float = option(
        1.0, "Run", "multiply every step count of the schedule (and -n) by this", minimum=1e-4)
    seed: int = option(0, "Run", "same seed and device, same bytes", minimum=0)
    stop_at: int = option(0, "Run", "stop after this step; the schedule stays that of -n (0: off)",
                          minimum=0)
    checkpoint_every: int = option(1000, "Run", "steps between checkpoints (0: only at the end)",
                                   minimum=0)
    eval_at: tuple[int, ...] = option((), "Run", "also evaluate after these steps; repeatable",
                                     minimum=1, wish="a list of steps, each at least 1")
    eval_every: int = option(0, "Run", "also evaluate every so many steps (0: off)", minimum=0)

    downscale: float = option(1.0, "Scene", "divide image width and height by this", short="-r",
                              minimum=1.0)
    max_resolution: int = option(0, "Scene", "limit of the longer image side, pixels (0: none)",
                                 minimum=0)
    test_every: int = option(8, "Scene", "hold out every N-th view by name (0: none)", minimum=0)
    init: str = option("sfm", "Scene", "initial gaussians: sfm, random, or a PLY file")
    background: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "Scene", "background colour, three numbers from 0 to 1",
        minimum=0.0, maximum=1.0, wish="three numbers from 0 to 1")

    schedule: str = option("constant", "Method", "how resolution and growth are decided",
                           choices=("constant",))
    sh_degree: int = option(3, "Method", "highest degree of the spherical harmonics", minimum=0,
                            maximum=3)
    sh_every: int = option(1000, "Method", "steps between degrees", minimum=1)
    ssim_weight: float = option(0.2, "Method", "share of D-SSIM in the loss", minimum=0.0,
                                maximum=1.0)
    antialiased: bool = option(False, "Method", "scale opacity by the area the low-pass adds")
    optimizer: str = option("dense", "Method", "Adam on all rows, or on those seen in the view",
                            choices=("dense", "sparse"))
    engine: str = option("auto", "Method", "where Adam runs: its moments on the device, or in "
                         "host memory by numpy", choices=("auto", "device", "numpy"))
    near: float = option(0.0, "Method", "near plane, world units (0: 1/500 of the scene extent)",
                         minimum=0.0)

    max_gaussians: int = option(0, "Growth", "never more gaussians than this (0: no limit)",
                                minimum=0)
    densify_from: int = option(500, "Growth", "first step that may grow", minimum=0)
    densify_until: int = option(0, "Growth", "last step that may grow (0: half of -n)", minimum=0)
    densify_every: int = option(100, "Growth", "steps between rounds of growth", minimum=1)
    grow_threshold: float = option(2e-4, "Growth", "mean screen gradient that grows, NDC units",
                                   minimum=0.0)
    split_size: float = option(0.01, "Growth", "larger ones split, smaller ones clone; x extent",
                               minimum=0.0)
    prune_opacity: float = option(0.005, "Growth", "fainter gaussians are removed", minimum=0.0,
                                  maximum=1.0)
    prune_size: float = option(0.1, "Growth", "larger gaussians are removed once opacities were "
                               "reset; x extent", minimum=0.0)
    reset_every: int = option(3000, "Growth", "steps between opacity resets (0: never)", minimum=0)

    device: str = option("auto", "Device", "auto, cpu, gpu, a number of `clsplat devices`, or part "
                         "of a name")
    form: str = option("auto", "Device", "kernel form: item suits CPUs, group suits GPUs",
                       choices=("auto", "item", "group"))


def from_toml(path):
    """The values a TOML file sets, as a dict; unknown keys and wrong types raise InputError."""
    try:
        with open(path, "rb") as file:
            table = tomllib.load(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    return {key.replace("-", "_"): checked(str(path), key.replace("-", "_"), value)
            for key, value in table.items()}


def checked(source, key, value):
    """`value` in the type of option `key`, within its limits; InputError names `source`.

    Whole numbers serve as fractions, and lists (what TOML and JSON have) as tuples.
    """
    known = {f.name: f for f in dataclasses.fields(TrainOptions)}
    if key not in known:
        raise InputError(f"{source}: unknown option '{key}'; see `clsplat train --help`")
    kind, meta = known[key].type, known[key].metadata
    elements = get_args(kind)  # of a tuple; none otherwise
    try:
        if not elements:
            return _checked_one(kind, meta, value)
        if not isinstance(value, (list, tuple)) or (
                ... not in elements and len(value) != len(elements)):
            raise ValueError
        return tuple(_checked_one(elements[0], meta, element) for element in value)
    except ValueError as wish:
        raise InputError(
            f"{source}: option '{key}' wants {meta['wish'] or wish}, got {value!r}") from None


def _checked_one(kind, meta, value):
    """`value` as `kind`; ValueError says what is wanted."""
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise ValueError(kind.__name__)
    low, high = meta["minimum"], meta["maximum"]
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        raise ValueError(f"at least {low}" if high is None else f"from {low} to {high}")
    if kind is float and not math.isfinite(value):
        raise ValueError("a finite number")
    if meta["choices"] and value not in meta["choices"]:
        raise ValueError(f"one of {', '.join(meta['choices'])}")
    return value


def resolve(file_values, flag_values):
    """TrainOptions from a TOML file's values overridden by the command line's."""
    values = {**file_values, **flag_values}
    return TrainOptions(**{k: checked("command line", k, v) for k, v in values.items()})
