"""Judge schedules on all photo sets, on several divisions of each, with several seeds.

    python -m tools.studies.judge OUT SETS ... --chosen caliterra,lund:0 -- --exposure on

SETS are scenes or folders of scenes; `PATH:2` halves their photos. Every set is
trained with every schedule, number of steps, offset of the held-out views (`--test-offset`) and
seed, one run after the other on one device. The result of each is a line of OUT/results.jsonl, and
a run that has one is not repeated. OUT/judge.md has the tables of judge_page.py, also of an
unfinished study: means are over the divisions and seeds that all schedules have. What follows --
are flags of `clsplat train` for all runs.

Where time is short, `--minutes` ends a call before a run that would not end in time, and the same
command goes on. `--part 1/4` takes every fourth run only, for four processes or machines; each
writes a file of its own. All files OUT/*.jsonl are read, so results of other machines are merged by
copying their files there.

Other columns than schedules are given by their flags; an ablation, for example:

    --schedules sig --with 'w/o levels: --levels 1' --with 'spheres: --sphere' --baseline sig
"""

import argparse
import json
import re
import shlex
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import clsplat
from clsplat.cli.flags import TrainingCommand, config_options, given_options, training_flags
from clsplat.config.option import plain
from clsplat.device import choose_device
from clsplat.errors import ClsplatError, InputError, Interrupted
from clsplat.io.scenes.read import is_scene
from clsplat.options import resolve
from clsplat.schedule.registry import OURS
from tools.studies.judge_page import Division, Result, is_chosen, write_page
from tools.studies.seen import further_scores
from tools.studies.study import Scene, flags_after, keep, keeps, outermost, refuse

RESULTS = "results.jsonl"
SLOWER = 1.2  # how much longer than the longest run so far the next one may take
CURVE = ("iteration", "train_seconds", "psnr_cc", "psnr", "gaussians")  # of each evaluation
SCORES = ("psnr_cc", "psnr", "ssim_cc", "ssim", "gaussians", "train_seconds", "views")
COMMAND = training_flags(TrainingCommand("judge"), every=True)  # parses flags, and runs nothing
FACTS = ("fingerprint", "opencl_device", "kernel_form", "version", "commit")


@dataclass(frozen=True, eq=False)
class JudgedRun:
    """A run that the study needs."""

    scene: Scene  # the photo set
    name: str  # of the schedule, or of another column
    division: Division
    options: dict  # those that its flags give, by name, without the device
    device: str  # that which they ask for

    @property
    def key(self):
        """Equal for equal runs, whatever the name of their column."""
        return json.dumps([self.scene.name, plain(self.options)], sort_keys=True)


def main(argv):
    """Train what is missing and there is time for, and write the page."""
    begin = time.monotonic()
    arguments = parsed(argv)
    runs = planned(arguments)
    check_chosen(arguments.chosen, {(run.division.set, run.division.offset) for run in runs})
    arguments.out.mkdir(parents=True, exist_ok=True)
    number, parts = arguments.part
    file = arguments.out / (RESULTS if parts == 1 else f"results-{number}-of-{parts}.jsonl")
    known = read_results(arguments.out)
    missing = {run.key: run for run in runs[number - 1 :: parts] if run.key not in known}
    print(f"{len(runs)} runs, {sum(run.key in known for run in runs)} of them finished before", flush=True)
    failed = train_all(list(missing.values()), file, arguments, begin)
    known = read_results(arguments.out)
    results = [Result(run.name, run.division, known[run.key]) for run in runs if run.key in known]
    tables = write_page(
        arguments.out / "judge.md", arguments.baseline, arguments.chosen, arguments.flags, results, len(runs)
    )
    keep(
        arguments.keep,
        tables,
        f"python -m tools.studies.judge {shlex.join(argv)}",
        " / ".join({str(result.values.get("opencl_device")) for result in results}),
    )
    refuse(failed)


def parsed(argv):
    """The arguments; those that follow -- are `flags` of all runs."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="Flags of `clsplat train` for all runs may follow after --.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path, help="folder of the results and the page")
    parser.add_argument("sets", nargs="+", metavar="SETS[:DOWNSCALE]")
    parser.add_argument(
        "-n", dest="steps", type=numbers, default=[7000, 30000], help="numbers of steps (default 7000,30000)"
    )
    parser.add_argument("--every", type=int, default=8, help="--test-every of all runs (default 8)")
    parser.add_argument(
        "--offsets", type=numbers, default=[0, 3, 6], help="--test-offset of the divisions (default 0,3,6)"
    )
    parser.add_argument("--seeds", type=int, default=3, help="default 3")
    parser.add_argument("--schedules", default=",".join(OURS), help=f"default {','.join(OURS)}")
    parser.add_argument(
        "--with", dest="others", action="append", default=[], metavar="'NAME: FLAGS'", help="another column; repeatable"
    )
    parser.add_argument(
        "--baseline", help="the column that others are compared with (default: constant, else the first)"
    )
    parser.add_argument(
        "--chosen", default="", help="sets, or SET:OFFSET, on which choices were made; all others confirm them"
    )
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="end the call after so long (default: when all is done)"
    )
    parser.add_argument(
        "--part", type=part, default=(1, 1), metavar="I/N", help="take the I-th of N shares of the runs"
    )
    keeps(parser)
    parser.add_argument("--keep-runs", action="store_true", help="keep the folders in OUT/runs")
    words, flags = flags_after(argv)
    arguments = parser.parse_args(words, argparse.Namespace(flags=flags))
    arguments.chosen = [word for word in arguments.chosen.split(",") if word]
    arguments.columns = columns(arguments)
    names = list(arguments.columns)
    if arguments.baseline is None:
        arguments.baseline = "constant" if "constant" in names else names[0]
    if arguments.baseline not in names:
        raise InputError(f"--baseline {arguments.baseline}: is not one of {', '.join(names)}")
    return arguments


def numbers(text):
    """The whole numbers of a list with commas."""
    return [int(word) for word in text.split(",")]


def part(text):
    """(I, N) of I/N; ValueError for anything else."""
    number, parts = map(int, text.split("/"))
    if not 1 <= number <= parts:
        raise ValueError
    return number, parts


def columns(arguments):
    """The name of each column and its flags."""
    result = {name: ["--schedule", name] for name in arguments.schedules.split(",") if name}
    for text in arguments.others:
        name, colon, flags = text.partition(":")
        if not colon:
            raise InputError(
                f"--with {text}: expects a name, a colon and flags, such as "
                "'sig+opacity: --schedule sig --opacity-weight 0.01'"
            )
        result[name.strip()] = shlex.split(flags)
    return result


def scenes_of(words):
    """The photo sets among some paths, of which a folder may hold several; InputError for none."""
    found = []
    for word in words:
        given = Scene(word)
        folder = Path(given.path)
        if folder.is_dir() and not is_scene(folder):
            inside = [path for path in sorted(folder.iterdir()) if path.is_dir() and is_scene(path)]
            if not inside:
                raise InputError(f"{folder}: neither a scene nor a folder of scenes")
            found += [Scene(f"{path}:{given.downscale:g}") for path in inside]
        else:
            found.append(given)
    names = [scene.name for scene in found]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{name}: two sets have this name; rename one")
    return found


def check_chosen(chosen, places):
    """InputError for a choice on what is no division (set, offset) of the study."""
    for word in chosen:
        if not any(is_chosen(place, [word]) for place in places):
            raise InputError(
                f"--chosen {word}: is no set of "
                f"{', '.join(sorted({name for name, _ in places}))}, nor one of them "
                "with an offset, such as SET:0"
            )


def planned(arguments):
    """All runs of the study: first one seed of everything, then the others."""
    runs = []
    for steps in arguments.steps:
        for seed in range(arguments.seeds):
            for scene in scenes_of(arguments.sets):
                for offset in arguments.offsets:
                    division = Division(scene.name, steps, offset, seed)
                    for name, flags in arguments.columns.items():
                        given = options_of(scene, division, arguments.every, [*arguments.flags, *flags])
                        device = given.pop("device", "auto")
                        runs.append(JudgedRun(scene, name, division, given, device))
    if len({(run.device, run.options.get("form", "auto")) for run in runs}) > 1:
        raise InputError("--device and --form: give them after --, for all columns; a study runs on one device")
    return runs


def options_of(scene, division, every, flags):
    """The options that flags give, by name; InputError for invalid ones."""
    words = [
        "-n",
        division.steps,
        "-r",
        f"{scene.downscale:g}",
        "--seed",
        division.seed,
        "--test-every",
        every,
        "--test-offset",
        division.offset,
        "--checkpoint-every",
        "end",
        *flags,
    ]
    context = COMMAND.make_context("judge", [str(word) for word in words])
    given = {**config_options(context), **given_options(context)}
    resolve({}, given)
    return given


def read_results(folder):
    """Key -> result of all finished runs, of this and of other calls."""
    results = {}
    for path in sorted(folder.glob("*.jsonl")):
        for line in path.read_text("utf-8").splitlines():
            try:
                result = json.loads(line)
                results[result["key"]] = result
            except (ValueError, KeyError, TypeError):  # a line that a killed call was writing
                print(f"{path}: a damaged line is left out")
    return results


def train_all(runs, file, arguments, begin):
    """Train runs until the time is over; the result of each becomes a line of `file`. Returns what
    failed, and why."""
    device, scenes, longest, failed = None, {}, {}, []
    for number, run in enumerate(runs, 1):
        left = 60 * arguments.minutes - (time.monotonic() - begin)
        if left < SLOWER * longest.get(run.division.steps, 0):
            print(f"{len(runs) - number + 1} runs are left for the next call", flush=True)
            break
        started = time.monotonic()
        device = device or choose_device(run.device, form=run.options.get("form", "auto"))
        if run.scene.name not in scenes:  # the runs of a set follow each other
            scenes = {run.scene.name: clsplat.Scene.read(run.scene.path, run.options.get("images", ""))}
        folder = arguments.out / "runs" / re.sub(r"[^\w+.]+", "-", f"{run.division} {run.name}")
        try:
            made = clsplat.train(
                scenes[run.scene.name],
                clsplat.TrainOptions(**run.options),
                output=folder,
                device=device,
                overwrite=True,
            )
            result = {**result_of(run, made), **further_scores(made, device)}
        except Interrupted:
            raise
        except ClsplatError as error:
            failed.append(f"{run.division} {run.name} ({error})")
            print(f"[{number}/{len(runs)}] {failed[-1]}", flush=True)
            continue
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(result) + "\n")
        if not arguments.keep_runs:
            shutil.rmtree(folder)
        seconds = time.monotonic() - started
        longest[run.division.steps] = max(seconds, longest.get(run.division.steps, 0))
        print(
            f"[{number}/{len(runs)}] {run.division} {run.name}: {result['psnr_cc']:.2f} dB cc, "
            f"{result['psnr']:.2f} dB, {result['gaussians']:,} gaussians, {seconds:.0f} s",
            flush=True,
        )
    return failed


def result_of(run, made):
    """What is kept of a finished run; InputError if it was not evaluated."""
    evaluations = [record for record in made.metrics if record["event"] == "eval"]
    if not evaluations:
        raise InputError("no view is held out; use another --every or --offsets")
    return {
        "key": run.key,
        "set": run.scene.name,
        "name": run.name,
        "options": plain(run.options),
        **{name: evaluations[-1][name] for name in SCORES},
        "curve": [[record[name] for name in CURVE] for record in evaluations],
        **{name: made.record.get(name) for name in FACTS},
    }


if __name__ == "__main__":
    outermost(main)
