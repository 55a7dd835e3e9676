"""Made surveys as cities, by numbers of photos, devices and schedules, beside one run.

    python -m tools.studies.survey OUT [--photos 400,1600] [--size 1152x864] [--devices 0 0,1]
        [--schedules sig,constant] [--steps 7000] [--one-run] [--limit 550] [--keep PAGE]
        [-- FLAGS of clsplat city]

A survey is drawn once (`tools.synth --large`). A city that was stopped, as by --limit, goes on with
the same command, and its seconds are those of all its commands; a finished one is not repeated.
While one runs, the memory of the host and the load of NVIDIA devices are read every two seconds.
"""

import argparse
import json
import shlex
import subprocess
import sys
import threading
import time
from pathlib import Path

from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.report.page import Table
from tools.studies.study import cell, flags_after, keep, keeps, markdown, outermost

TITLE = "Made surveys as cities"
STAGES = ("coarse run", "dense points", "cut", "blocks", "merge", "evaluation")
HEAD = (
    "photos",
    "devices",
    "schedule",
    "whole, s",
    *(f"{stage}, s" for stage in STAGES),
    "cc, dB",
    "worst seam, dB",
    "gaussians, M",
    "largest block, M",
    "its device, GiB",
    "training on devices, s",
    "devices' load",
    "host at most, GiB",
    "disk, GB",
)
GIB, SAMPLE_SECONDS = 2**30, 2.0
MEMORY = Path("/proc/meminfo")


class Watched:
    """Reads the memory of the host and the load of devices while its block runs.

    Attributes
    ----------
    host : bytes that were used more than before, at most.
    loads : per cent, of each sample the mean of the devices.
    """

    def __init__(self, devices):
        self.devices, self.host, self.loads = devices, 0, []
        self._ended, self._before = threading.Event(), used_memory()

    def __enter__(self):
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._ended.set()
        self._thread.join()

    def _read(self):
        while not self._ended.wait(SAMPLE_SECONDS):
            self.host = max(self.host, used_memory() - self._before)
            loads = device_loads()
            chosen = [loads[int(each)] for each in self.devices.split(",") if each.isdigit() and int(each) < len(loads)]
            self.loads += [sum(chosen) / len(chosen)] if chosen else []


def used_memory():
    """Bytes of the host's memory that are in use; 0 where that is not known."""
    if not MEMORY.exists():
        return 0
    values = {
        name: int(value.split()[0]) for name, value in (line.split(":") for line in MEMORY.read_text().splitlines())
    }
    return 1024 * (values["MemTotal"] - values["MemAvailable"])


def device_loads():
    """Per cent of the time in which each NVIDIA device works; none without nvidia-smi."""
    try:
        text = subprocess.run(
            ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits"],
            capture_output=True,
            text=True,
        )
    except OSError:
        return []
    return [float(line) for line in text.stdout.split()] if text.returncode == 0 else []


def trained(folder, words, devices, limit):
    """Run a command of clsplat that trains in a folder, unless it has finished; its record, with
    the seconds of all commands so far. What it prints goes to FOLDER.log."""
    path = folder.with_suffix(".json")
    record = json.loads(path.read_text()) if path.exists() else {"seconds": 0.0, "host": 0, "loads": [], "done": False}
    if record["done"]:
        return record
    begin = time.perf_counter()
    with open(folder.with_suffix(".log"), "ab") as log, Watched(devices) as watched:
        process = subprocess.Popen([sys.executable, "-m", "clsplat", *words], stdout=log, stderr=log)
        try:
            process.wait(limit)
        except subprocess.TimeoutExpired:
            process.terminate()  # it saves its state
            process.wait()
    record = {
        "seconds": record["seconds"] + time.perf_counter() - begin,
        "host": max(record["host"], watched.host),
        "loads": record["loads"] + watched.loads,
        "done": process.returncode == 0,
    }
    path.write_text(json.dumps(record))
    return record


def row_of(folder, photos, devices, schedule, record):
    """The row of a city, or of one run."""
    runs = [RunFolder(block.run) for block in CityFolder(folder).blocks()]
    coarse, whole = RunFolder(folder / "coarse"), RunFolder(folder)
    spent = dict.fromkeys(STAGES, 0.0)
    stages = CityFolder(folder).stages()
    blocks = [stage for stage in stages if ", stage " in stage.name or stage.name.isdigit()]
    for stage in stages:
        if stage.name in spent:
            spent[stage.name] += stage.seconds
    spent["blocks"] = covered(blocks)
    last = {each["event"]: each for each in whole.records()}
    each = [run.records() for run in runs or [whole]]
    trainings = each if not runs else [*each, coarse.records()]
    disk = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    cells = (
        f"{photos:,}",
        devices,
        schedule,
        f"{record['seconds']:.0f}",
        *(f"{spent[stage]:.0f}" if stages else "" for stage in STAGES),
        cell(last.get("eval", {}).get("psnr_cc"), None, 2),
        cell(last.get("seams", {}).get("worst_seam_db"), None, 2),
        cell((last.get("eval") or last["merge"])["gaussians"] / 1e6, None, 1),
        cell(max(most(records, "gaussians") for records in each) / 1e6, None, 1),
        cell(max(most(records, "peak_bytes") for records in each) / GIB, None, 1),
        cell(sum(most(records, "train_seconds") for records in trainings), None, 0),
        f"{sum(record['loads']) / len(record['loads']):.0f} %" if record["loads"] else "",
        cell(record["host"] / GIB, None, 1),
        cell(disk / 1e9, None, 1),
    )
    print(*cells, sep="  ", flush=True)
    return cells


def covered(stages):
    """Seconds in which at least one of these stages was done."""
    total = end = 0.0
    for stage in sorted(stages, key=lambda stage: stage.began):
        total += max(0.0, stage.began + stage.seconds - max(end, stage.began))
        end = max(end, stage.began + stage.seconds)
    return total


def most(records, key):
    """The largest value of a key."""
    return max((record.get(key) or 0 for record in records), default=0)


def main(argv):
    """Draw surveys, train what is not finished, and print the table."""
    words, flags = flags_after(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--photos", default="400,1600")
    parser.add_argument("--size", default="1152x864")
    parser.add_argument("--devices", nargs="+", default=["auto"])
    parser.add_argument("--schedules", default="sig")
    parser.add_argument("--steps", default="auto", help="of one run; default auto")
    parser.add_argument("--one-run", action="store_true", help="`clsplat train` of each, too")
    parser.add_argument("--limit", type=float, help="seconds of a command")
    keeps(parser)
    options = parser.parse_args(words)
    options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for photos in map(int, options.photos.split(",")):
        scene = options.output / f"survey-{photos}"
        if not scene.exists():
            subprocess.run(
                [
                    sys.executable,
                    "-m",
                    "tools.synth",
                    scene,
                    "--large",
                    "--views",
                    str(photos),
                    "--size",
                    options.size,
                    "--drift",
                    "0.15",
                    "--device",
                    options.devices[0].split(",")[0],
                ],
                check=True,
            )
        for devices in options.devices:
            for schedule in options.schedules.split(","):
                kinds = {"city": flags, **({"train": []} if options.one_run else {})}
                for kind, more in kinds.items():
                    if kind == "train" and devices != options.devices[0]:
                        continue
                    on = devices if kind == "city" else devices.split(",")[0]
                    folder = options.output / f"{kind}-{photos}-{on.replace(',', '+')}-{schedule}"
                    record = trained(
                        folder,
                        [
                            kind,
                            str(scene),
                            "-o",
                            str(folder),
                            "--schedule",
                            schedule,
                            "-n",
                            options.steps,
                            "--device",
                            on,
                            *more,
                        ],
                        on,
                        options.limit,
                    )
                    if record["done"]:
                        rows.append(
                            row_of(folder, photos, on, f"{schedule}, one run" if kind == "train" else schedule, record)
                        )
                    else:
                        print(f"{folder}: not finished after {record['seconds']:.0f} s")
    table = Table(TITLE, HEAD, rows, range(3, len(HEAD)), (f"Photos of {options.size} pixels.",))
    print(markdown(table))
    if rows:
        device = RunFolder(folder).read_options()["opencl_device"]
        keep(options.keep, [table], f"python -m tools.studies.survey {shlex.join(argv)}", device)


if __name__ == "__main__":
    outermost(main)
