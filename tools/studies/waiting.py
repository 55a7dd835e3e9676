"""Error on held-out photos against the seconds of the whole process, of clsplat and of peers.

    python -m tools.studies.waiting OUT SCENE ... [--steps 500,1500,auto] [--budgets 3,6,12,25]
        [--peer 'NAME 1000,7000 COMMAND'] [-- FLAGS of clsplat train]

All run in turns on one machine. A training of each number of steps is a process of its own; its
seconds begin before Python's and end with its last file. The COMMAND of a peer has {scene} and
{steps}, and prints its scores as its last line: a JSON object with psnr, cc_psnr and ssim of every
eighth photo, and process_seconds, where its process does more than train. The same command
continues where the last one ended.
"""

import argparse
import json
import shlex
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from clsplat.io.runs.run import RunFolder
from clsplat.report.page import Table
from tools.studies.study import cell, flags_after, keep, keeps, markdown, outermost, refuse, timed_training

OURS = "clsplat"
SCORES = "cc_psnr", "psnr", "ssim"


def trained(scene, steps, flags):
    """The scores of a training by clsplat, and its seconds."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        length = [] if steps == "auto" else ["-n", steps]
        seconds = timed_training(scene, run, [*length, *flags])
        records = list(RunFolder(run).records())
        scores = [record for record in records if record["event"] == "eval"][-1]
        return {
            "cc_psnr": scores["psnr_cc"],
            "psnr": scores["psnr"],
            "ssim": scores["ssim"],
            "gaussians": scores["gaussians"],
            "process_seconds": seconds,
            "spent": records[-1].get("seconds"),
            "device": RunFolder(run).read_options()["opencl_device"],
        }


def peer_trained(command, scene, steps):
    """The scores that a peer's command prints, and its seconds."""
    begin = time.perf_counter()
    words = shlex.split(command.format(scene=scene, steps=steps))
    printed = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout
    return {"process_seconds": time.perf_counter() - begin, **json.loads(printed.strip().splitlines()[-1])}


def within(results, seconds):
    """The best scores of the trainings that end in so many seconds, by `cc_psnr`; or None."""
    ended = [each for each in results if each["process_seconds"] <= seconds]
    return max(ended, key=lambda each: each["cc_psnr"], default=None)


def budget_table(results, names, scenes, budgets):
    """Means over the scenes of the best scores within each budget."""
    rows = []
    for name in names:
        for budget in budgets:
            best = [within(results[name, scene], budget) for scene in scenes]
            found = [each for each in best if each]
            means = [np.mean([each[score] for each in found]) if found else np.nan for score in SCORES]
            rows.append(
                (
                    name,
                    f"{budget:g}",
                    f"{len(found)} of {len(scenes)}",
                    *(cell(mean, None, digits) for mean, digits in zip(means, (2, 2, 4))),
                )
            )
    return Table(
        "What a user has after so many seconds",
        ("program", "seconds", "sets with a model", "PSNR cc", "PSNR", "SSIM"),
        rows,
        range(1, 6),
        (
            "Means over the sets that have a model, of the best training that ended by then; seconds "
            "are those of the whole process, from its start to its last file.",
        ),
    )


def race_table(results, names, scenes):
    """For each scene the seconds until clsplat's end has the score of each peer's last training."""
    rows = []
    for name in names[1:]:
        for scene in scenes:
            last = results[name, scene][-1]
            reached = [each for each in results[OURS, scene] if each["cc_psnr"] >= last["cc_psnr"]]
            first = min((each["process_seconds"] for each in reached), default=np.nan)
            rows.append(
                (
                    name,
                    Path(scene).name,
                    cell(last["cc_psnr"], None, 2),
                    cell(last["process_seconds"], None, 1),
                    cell(first, None, 1),
                    cell(first / last["process_seconds"], None, 2),
                )
            )
    return Table(
        "Until clsplat has what a peer ends with",
        ("peer", "set", "its PSNR cc", "its seconds", "clsplat's seconds", "ratio"),
        rows,
        range(2, 6),
        (
            "The shortest training of clsplat that ends with at least the peer's score; "
            "-: none of those that were tried.",
        ),
    )


def main(argv):
    """Train what is missing, and write the page."""
    words, flags = flags_after(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--steps", default="500,1500,auto")
    parser.add_argument("--budgets", default="3,6,12,25", help="seconds")
    parser.add_argument("--peer", action="append", default=[], metavar="'NAME STEPS COMMAND'")
    keeps(parser)
    options = parser.parse_args(words)
    programs = [(OURS, options.steps, None), *(peer.split(maxsplit=2) for peer in options.peer)]
    options.out.mkdir(parents=True, exist_ok=True)
    file, results, failed = options.out / "waiting.jsonl", {}, []
    known = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    for scene in options.scenes:
        for name, lengths, command in programs:
            for steps in lengths.split(","):
                key = {"program": name, "scene": scene, "steps": steps}
                made = next((each for each in known if key.items() <= each.items()), None)
                if made is None:
                    try:
                        made = {
                            **key,
                            **(
                                trained(scene, steps, flags) if command is None else peer_trained(command, scene, steps)
                            ),
                        }
                    except subprocess.CalledProcessError:
                        failed.append(" ".join(key.values()))
                        continue
                    with file.open("a") as stream:
                        stream.write(json.dumps(made) + "\n")
                results.setdefault((name, scene), []).append(made)
    names = [name for name, _, _ in programs]
    whole = [scene for scene in options.scenes if all((name, scene) in results for name in names)]
    tables = [budget_table(results, names, whole, list(map(float, options.budgets.split(","))))]
    if options.peer:
        tables.append(race_table(results, names, whole))
    (options.out / "waiting.md").write_text("\n\n".join(map(markdown, tables)) + "\n")
    keep(
        options.keep,
        tables,
        f"python -m tools.studies.waiting {shlex.join(argv)}",
        " / ".join({made["device"] for scene in whole for made in results[OURS, scene]}),
    )
    refuse(failed)


if __name__ == "__main__":
    outermost(main)
