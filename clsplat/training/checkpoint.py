"""What a checkpoint holds of a training: rows, moments, statistics, exposures, schedule, clocks."""

import dataclasses

import numpy as np

from clsplat.errors import InputError
from clsplat.gaussians import FIELDS, LEARNED, Gaussians
from clsplat.io.run import OPTIONS
from clsplat.options import checked

REALS = (np.float32, np.float64)  # what devices compute in
# key of the state -> (types, least value of a number)
NUMBER, OPTIONAL = (int, float), type(None)
STATE = {"fingerprint": (str, None), "iteration": (int, 0), "level": (NUMBER, 1),
         "train_seconds": (NUMBER, 0), "wall_seconds": (NUMBER, 0), "kernel_bytes": (int, 0),
         "pixel_pairs": (int, 0), "initial_count": (int, 0), "skipped": (dict, None),
         "schedule": (dict, None), "budget": ((dict, OPTIONAL), None)}


def save(training):
    """Write the checkpoint of a `loop.Training` into its run folder.

    Where a number is not finite, InputError: the checkpoint before is worth more.
    """
    model, statistics = training.step.model, training.step.statistics
    m, v = model.adam.download(model.count)
    parts = {"row": model.download().rows, "m": m, "v": v, "statistics": {
        "grad_norm_sum": statistics.grad_norm_sum.download(),
        "seen_count": statistics.seen_count.download()}}
    if training.step.frozen is not None:
        parts["statistics"]["frozen"] = training.step.frozen.download()
    if training.step.exposures:
        parts["exposure"] = training.step.exposures.download()
    arrays = {f"{kind}.{name}": values for kind, fields in parts.items()
              for name, values in fields.items()}
    spoilt = [name for name, values in arrays.items() if not _is_finite(values)]
    if spoilt:
        raise training.broken(f"{', '.join(spoilt)} at step {training.iteration}: not finite")
    training.run.save_checkpoint(arrays, {
        "fingerprint": training.fingerprint, "iteration": training.iteration,
        "level": training.level,
        "train_seconds": training.train_seconds, "wall_seconds": training.elapsed(),
        "kernel_bytes": training.kernel_bytes, "pixel_pairs": training.step.pixel_pairs,
        "skipped": training.step.skipped.state(),
        "schedule": training.schedule.state(),
        "initial_count": training.schedule.subject.count,
        "budget": training.budget and {**training.budget.state(),
                                       "iterations": training.options.iterations}})


def load(training, arrays, state):
    """Take over what a checkpoint holds besides the rows; KeyError names what it lacks."""
    training.use_level(state["level"])
    step = training.step
    step.model.adam.upload(_fields(arrays, "m", LEARNED), _fields(arrays, "v", LEARNED))
    step.statistics.grad_norm_sum.write(arrays["statistics.grad_norm_sum"])
    step.statistics.seen_count.write(arrays["statistics.seen_count"])
    if step.frozen is not None:
        step.frozen.write(arrays["statistics.frozen"])
    if step.exposures:
        step.exposures.upload({name.partition(".")[2]: values for name, values in arrays.items()
                               if name.startswith("exposure.")})
        if training.adjacent:
            training.adjacent.compare_colours()
    step.skipped.load(state["skipped"])
    training.kernel_bytes, step.pixel_pairs = state["kernel_bytes"], state["pixel_pairs"]
    training.iteration = state["iteration"]
    training.train_seconds, training.wall_seconds = state["train_seconds"], state["wall_seconds"]
    training.schedule.subject = dataclasses.replace(
        training.schedule.subject, count=state["initial_count"])
    training.schedule.load(state["schedule"])
    if training.budget:
        training.budget.load(state["budget"])
        training.lay_over(state["budget"]["iterations"])


def check_state(state):
    """KeyError names what a checkpoint's state lacks, ValueError what is not as `save` wrote it."""
    for key, (kinds, least) in STATE.items():
        value = state[key]
        if not isinstance(value, kinds) or least is not None and value is not None and (
                isinstance(value, bool) or not least <= value < 2**63):
            raise ValueError(f"{key} ({str(value)[:20]!r})")


def saved_gaussians(run, record, arrays, state) -> Gaussians:
    """The Gaussians of a run's checkpoint, in the units of training; record: the run's options.

    InputError where the checkpoint, or the options, lack what is needed.
    """
    try:
        check_state(state)
        degree = (record.get("needs") or {}).get("sh_degree", record["sh_degree"])
        return gaussians_of(arrays, checked(str(run.path / OPTIONS), "sh_degree", degree))
    except (KeyError, ValueError) as error:
        raise InputError(f"{run.path}: its checkpoint lacks a good {error}; "
                         "start again with --overwrite") from None


def gaussians_of(arrays, sh_degree) -> Gaussians:
    """The Gaussians of a checkpoint's arrays.

    KeyError names an array that is missing, ValueError one that does not fit the others.
    """
    carried = [field for field in FIELDS if f"row.{field.name}" in arrays or field in LEARNED]
    gaussians = Gaussians(_fields(arrays, "row", carried), sh_degree)
    count = arrays["statistics.seen_count"].size
    shapes = {f"{kind}.{field.name}": field.row_shape(sh_degree)
              for kind, fields in (("row", carried), ("m", LEARNED), ("v", LEARNED))
              for field in fields}
    for name, shape in {**shapes, "statistics.grad_norm_sum": ()}.items():
        values = arrays[name]
        if values.dtype not in REALS or values.shape != (count, *shape) or not _is_finite(values):
            raise ValueError(f"{name} ({values.dtype}{list(values.shape)}, or not finite)")
    return gaussians


def size(model):
    """About how many bytes checkpoint and finished model take."""
    floats = sum(field.width(model.sh_degree) for field in LEARNED)
    return 4 * 4 * floats * model.count  # parameters, two moments, and the PLY


def _fields(arrays, kind, fields):
    return {field.name: arrays[f"{kind}.{field.name}"] for field in fields}


def _is_finite(values):
    """By the extremes, which nan spoils too: no copy of what may be gigabytes."""
    return bool(np.isfinite([values.min(initial=0), values.max(initial=0)]).all())
