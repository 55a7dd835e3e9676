"""Short trainings on the sample city in which everything happens: growth, resets, degrees, levels."""

import hashlib
import json
from pathlib import Path
from tempfile import mkstemp
from unittest.mock import patch

from clsplat.errors import Interrupted
from clsplat.io.runs.run import RunFolder
from clsplat.options import resolve
from clsplat.training.run import resumed as training_resumed
from clsplat.training.run import train

ROOT = Path(__file__).resolve().parents[2]
CITY = ROOT / "data_samples" / "city"

# everything that happens in a real run, within 150 steps of 40 x 30 pixels
EVENTFUL = {
    "schedule": "constant",
    "iterations": 150,
    "downscale": 8.0,
    "densify_from": 20,
    "densify_every": 20,
    "densify_until": 120,
    "reset_every": 50,
    "grow_threshold": 5e-4,
    "sh_every": 30,
    "prune_opacity": 0.009,
    "checkpoint_every": 0,
    "eval_every": 0,
}
# the same of the whole method: within 120 steps of 40 x 30 and then 80 x 60 pixels, a level that
# converges, growth in rounds at both, spheres, exposures and adjacent photos
LEVELLED = {
    "schedule": "sig",
    "levels": (2.0, 1.0),
    "iterations": 120,
    "downscale": 4.0,
    "rounds": 2,
    "densify_every": 8,
    "reset_every": 0,
    "exposure": "on",
    "reproject": "on",
    "level_share": 0.7,
    "convergence_rate": 0.02,
    "pixels_per_gaussian": 0.0,
    "sphere_reach": 3.0,
    "eval_every": 0,
}
# what a test of something else needs: no growth, few steps
STILL = {"densify_from": 1000, "reset_every": 0}


def resume(*arguments, **named):
    """Go on with a run until its end, or until it is stopped."""
    training_resumed(*arguments, **named).take()


def options_of(**changes):
    return resolve({}, {**EVENTFUL, **changes})


def trained(folder, scene, device, **changes):
    """The RunFolder of a training with EVENTFUL's options, changed; `stop_at` may end it early."""
    return _taken(train, RunFolder.create(folder), scene, device, changes)


def resumed(run, scene, device, **changes):
    """The RunFolder after going on, with the options that it was begun with."""
    return _taken(resume, RunFolder.open(run.path), scene, device, changes)


def _taken(start, run, scene, device, changes):
    parts = changes.pop("parts", ())
    options = options_of(**changes)
    # the curves of a report take half a second: tests/report draws them
    try:
        with patch("clsplat.report.run.drawn", return_value=""):
            start(scene, options, device, run, parts=parts)
        assert not 0 < options.stop_at < options.iterations
    except Interrupted:
        if not options.stop_at:
            raise
    return run


def model_digest(run):
    """Equal for equal bytes; pytest would take minutes to explain how bytes differ."""
    return hashlib.sha256((run.path / "point_cloud.ply").read_bytes()).hexdigest()


def records(run, event):
    """The metrics of one kind of event, in order."""
    lines = (run.path / "metrics.jsonl").read_text().splitlines()
    return [record for record in map(json.loads, lines) if record["event"] == event]


def flags(**changes):
    """The command line's words for EVENTFUL's options, changed: a file of them."""
    values = {**EVENTFUL, **changes}
    file, path = mkstemp(".toml")
    with open(file, "w", encoding="utf-8") as lines:
        lines.writelines(f"{name} = {json.dumps(value)}\n" for name, value in values.items())
    return ["--config", path]
