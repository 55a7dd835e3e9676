"""What a checkpoint holds of a training: rows, moments, statistics, exposures, schedule, clocks."""

import dataclasses

import numpy as np

from clsplat.gaussians import FIELDS, LEARNED, Gaussians


def save(training):
    """Write the checkpoint of a `loop.Training` into its run folder."""
    model, statistics = training.step.model, training.step.statistics
    m, v = model.adam.download(model.count)
    parts = {"row": model.download().rows, "m": m, "v": v, "statistics": {
        "grad_norm_sum": statistics.grad_norm_sum.download(),
        "seen_count": statistics.seen_count.download()}}
    if training.step.exposures:
        parts["exposure"] = training.step.exposures.download()
    arrays = {f"{kind}.{name}": values for kind, fields in parts.items()
              for name, values in fields.items()}
    training.run.save_checkpoint(arrays, {
        "fingerprint": training.fingerprint, "iteration": training.iteration,
        "evaluated_at": training.evaluated_at, "level": training.level,
        "train_seconds": training.train_seconds, "wall_seconds": training.elapsed(),
        "skipped_rows": int(training.renderer.skipped.download()[0]),
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
    if step.exposures:
        step.exposures.upload({name.partition(".")[2]: values for name, values in arrays.items()
                               if name.startswith("exposure.")})
        if training.adjacent:
            training.adjacent.compare_colours()
    training.renderer.skipped.write(np.array([state["skipped_rows"]], np.uint32))
    training.iteration, training.evaluated_at = state["iteration"], state["evaluated_at"]
    training.train_seconds, training.wall_seconds = state["train_seconds"], state["wall_seconds"]
    training.schedule.subject = dataclasses.replace(
        training.schedule.subject, count=state["initial_count"])
    training.schedule.load(state["schedule"])
    if training.budget:
        training.budget.load(state["budget"])
        training.lay_over(state["budget"]["iterations"])


def gaussians_of(arrays, sh_degree):
    """The Gaussians of a checkpoint's arrays."""
    carried = [field for field in FIELDS if f"row.{field.name}" in arrays or field in LEARNED]
    return Gaussians(_fields(arrays, "row", carried), sh_degree)


def size(model):
    """About how many bytes checkpoint and finished model take."""
    floats = sum(field.width(model.sh_degree) for field in LEARNED)
    return 4 * 4 * floats * model.count  # parameters, two moments, and the PLY


def _fields(arrays, kind, fields):
    return {field.name: arrays[f"{kind}.{field.name}"] for field in fields}
