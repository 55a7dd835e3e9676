"""What `clsplat plan` predicts beside what training then takes: writes OUT/predicted.md.

    python -m tools.studies.predicted OUT SCENE[:DOWNSCALE] ... -- --schedule sig

Each scene is planned, then trained on the same device. Gaussians: the most at a time; memory: the
most at a time, while the model grows too; time: of training. Take it on a machine that does
nothing else.
"""

from clsplat.device import choose_device
from clsplat.estimate.forecast import MIB, Planned
from clsplat.io.scenes import read_scene
from clsplat.report.page import Table
from tools.studies.evidence import outermost, parsed, parser, refuse, write
from tools.studies.runs import trained, wanted

BOUNDS = {"MiB": 0.15, "s": 0.30}  # relative errors that issue 4 allows


def main(argv):
    given = parsed(parser(__doc__, 7000), argv)
    runs = [wanted(given, scene, "planned", 0, ()) for scene in given.scenes]
    forecasts = {run.scene.name: forecast(run) for run in runs}
    groups, failed = trained(runs, given.jobs, given.gpus)
    rows = []
    for scene, found in groups.items():
        for run in found["planned"]:
            rows.append((scene, *compared(forecasts[scene], run.records)))
    within = ", ".join(f"{unit} within {bound:.0%}" for unit, bound in BOUNDS.items())
    table = Table("Foretold and taken", (
        "scene", "gaussians predicted", "taken", "ratio", "MiB predicted", "taken", "ratio",
        "s predicted", "taken", "ratio"), rows, range(1, 10), (
        f"Wanted: {within}.",))
    write(given.out / "predicted.md", "What plan predicts", given, groups, [table])
    refuse(failed)


def forecast(run):
    """The Forecast of a `runs.Wanted`, on a device of its own, as `clsplat plan` makes it."""
    device = choose_device(run.options.device, form=run.options.form)
    found = Planned(read_scene(run.scene.path), run.options, device).forecast()
    print(f"{run.scene.name}: {found.gaussians:,} gaussians, {found.memory.total / MIB:,.0f} MiB, "
          f"{found.seconds:,.0f} s", flush=True)
    return found


def compared(forecast, records):
    """Cells: predicted, taken and their ratio of gaussians, MiB, and seconds."""
    steps = [record for record in records if record["event"] == "step"]
    pairs = ((forecast.gaussians, max(record["gaussians"] for record in records)),
             (forecast.memory.total / MIB, max(record["peak_bytes"] for record in steps) / MIB),
             (forecast.seconds, records[-1]["train_seconds"]))
    return [text for told, took in pairs
            for text in (f"{told:,.0f}", f"{took:,.0f}", f"{told / took:.2f}")]


if __name__ == "__main__":
    outermost(main)
