"""Compare the predictions of `clsplat plan` with the training; write OUT/predicted.md.

    python -m tools.studies.predicted OUT SCENE[:DOWNSCALE] ... -- --schedule sig

Each scene is planned, then trained on the same device. Gaussians and memory are the largest during
the training, also while the model grows; time is that of the training. The machine should do
nothing else.
"""

from clsplat.device import choose_device
from clsplat.estimate.forecast import MIB, Planned
from clsplat.io.scenes.read import read_scene
from clsplat.report.page import Table
from tools.studies.evidence import outermost, parsed, parser, refuse, write
from tools.studies.runs import planned, trained

BOUNDS = {"MiB": 0.15, "s": 0.30}  # relative errors that are allowed


def main(argv):
    """Make the forecasts, train what is missing, and write the table."""
    arguments = parsed(parser(__doc__, 7000), argv)
    runs = [planned(arguments, scene, "planned", 0, ()) for scene in arguments.scenes]
    forecasts = {run.scene.name: forecast(run) for run in runs}
    groups, failed = trained(runs, arguments.jobs, arguments.gpus)
    rows = []
    for scene, by_name in groups.items():
        for run in by_name["planned"]:
            rows.append((scene, *compared(forecasts[scene], run.records)))
    within = ", ".join(f"{unit} within {bound:.0%}" for unit, bound in BOUNDS.items())
    table = Table("Predicted and measured", (
        "scene", "gaussians predicted", "measured", "ratio", "MiB predicted", "measured", "ratio",
        "s predicted", "measured", "ratio"), rows, range(1, 10), (f"Required: {within}.",))
    write(arguments.out / "predicted.md", "What plan predicts", arguments, groups, [table])
    refuse(failed)


def forecast(run):
    """The forecast of a `runs.PlannedRun`, on a device of its own, as `clsplat plan` makes it."""
    device = choose_device(run.options.device, form=run.options.form)
    result = Planned(read_scene(run.scene.path), run.options, device).forecast()
    print(f"{run.scene.name}: {result.gaussians:,} gaussians, "
          f"{result.memory.total / MIB:,.0f} MiB, {result.seconds:,.0f} s", flush=True)
    return result


def compared(forecast, records):
    """The cells of a run: predicted, measured and ratio, for gaussians, MiB and seconds."""
    steps = [record for record in records if record["event"] == "step"]
    pairs = ((forecast.gaussians, max(record["gaussians"] for record in records)),
             (forecast.memory.total / MIB, max(record["peak_bytes"] for record in steps) / MIB),
             (forecast.seconds, records[-1]["train_seconds"]))
    return [text for expected, measured in pairs
            for text in (f"{expected:,.0f}", f"{measured:,.0f}", f"{expected / measured:.2f}")]


if __name__ == "__main__":
    outermost(main)
