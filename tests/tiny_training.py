"""Short trainings on the sample city in which everything happens: growth, resets, degrees."""

import hashlib
import json
from pathlib import Path

from clsplat.io.run import RunFolder
from clsplat.options import TrainOptions
from clsplat.train.loop import train

CITY = Path(__file__).resolve().parents[1] / "data_samples" / "city"

# everything that happens in a real run, within 150 steps of 40 x 30 pixels
EVENTFUL = {"schedule": "constant", "iterations": 150, "downscale": 8.0, "densify_from": 20,
            "densify_every": 20,
            "densify_until": 120, "reset_every": 50, "grow_threshold": 5e-4, "sh_every": 30,
            "prune_opacity": 0.009, "checkpoint_every": 0}
# what a test of something else needs: no growth, few steps
STILL = {"densify_from": 1000, "reset_every": 0}


def options_of(**changes):
    return TrainOptions(**{**EVENTFUL, **changes})


def trained(folder, scene, device, **changes):
    """The RunFolder of a training with EVENTFUL's options, changed."""
    run = RunFolder.create(folder)
    train(scene, options_of(**changes), device, run)
    return run


def model_digest(run):
    """Equal for equal bytes; pytest would take minutes to explain how bytes differ."""
    return hashlib.sha256((run.path / "point_cloud.ply").read_bytes()).hexdigest()


def records(run, event):
    """The metrics of one kind of event, in order."""
    lines = (run.path / "metrics.jsonl").read_text().splitlines()
    return [record for record in map(json.loads, lines) if record["event"] == event]


def flags(**changes):
    """The command line's words for EVENTFUL's options, changed."""
    return [word for name, value in {**EVENTFUL, **changes}.items()
            for word in (f"--{name.replace('_', '-')}", str(value))]
