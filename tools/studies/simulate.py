"""Simulate large scenes on a cluster: `clsplat.distribute` and Dask are real, the blocks are not.

    python -m tools.studies.simulate OUT [--photos 1000 10000 100000 1000000] [--workers 40] ...

All Dask workers are in this process and connected by TCP. Instead of training a block in a child
process, a worker sleeps for a time that is --scale times shorter. Tries fail and workers die at
random. As there is --scale times less time for the same messages, the engine's share of the time is
no smaller than on a real cluster. Writes OUT/simulation.jsonl and OUT/simulation.md.
"""

import argparse
import asyncio
import json
import logging
import random
import shutil
import threading
import time
from collections import defaultdict
from pathlib import Path

import distributed
import numpy as np
from distributed.comm.tcp import TCP

from clsplat.distribute import Result, Task, cluster, run
from clsplat.distribute.task import DONE, FAILED, LOST
from clsplat.report.page import Table
from tools.studies.evidence import markdown, outermost

# of 30 000 steps, from 7000: 9.4 s on an H200, 211 s on two cores
SECONDS = (40.0, 900.0)
MOST_ROUNDS = 10  # of the same command, as a user would repeat it


class Workers:
    """A context manager of a scheduler and its workers in a thread; dead workers are replaced."""

    def __init__(self, count):
        self._count, self._ready = count, threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)

    def __enter__(self):
        self._thread.start()
        self._ready.wait()
        return self

    def __exit__(self, *_):
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join()

    async def _serve(self):
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        async with distributed.Scheduler(host="127.0.0.1", port=0, dashboard=False,
                                         dashboard_address=":0") as scheduler:
            self.address = scheduler.address
            lives = [asyncio.create_task(self._live()) for _ in range(self._count)]
            while len(scheduler.workers) < self._count:
                await asyncio.sleep(0.05)
            self._ready.set()
            await self._over.wait()
            await scheduler.close()
            await asyncio.gather(*lives)

    async def _live(self):
        while not self._over.is_set():
            worker = await distributed.Worker(
                self.address, nthreads=1, resources={cluster.DEVICE: 1}, host="127.0.0.1",
                dashboard=False, memory_limit=0)
            await worker.finished()


class Stub:
    """A replacement of `in_child` that sleeps and records its tries.

    Durations and failures depend on the task's name, the number of the try and the seed.

    Attributes
    ----------
    spans : address of a worker -> (begin, end) of each try, seconds.
    """

    def __init__(self, given):
        self.given, self.tries = given, defaultdict(int)
        self.spans, self.failed, self.died = defaultdict(list), 0, 0
        self.true_seconds = 0.0

    def __call__(self, task, program, folder, stopping):
        if task.done.exists():  # its result was lost with a worker; the child would see that too
            return Result(DONE)
        self.tries[task.name] += 1
        chance = random.Random(f"{self.given.seed} {task.name} {self.tries[task.name]}")
        worker, begin = distributed.get_worker(), time.monotonic()
        fate, seconds = chance.random(), chance.choice(self.given.seconds)
        dies = fate < self.given.deaths
        fails = not dies and fate < self.given.deaths + self.given.failures
        seconds *= chance.random() if dies or fails else 1
        time.sleep(seconds / self.given.scale)
        self.spans[worker.address].append((begin, time.monotonic()))
        self.true_seconds += seconds
        if dies:
            self.died += 1
            worker.loop.add_callback(worker.batched_stream.comm.abort)
            return Result(LOST)
        if fails:
            self.failed += 1
            return Result(FAILED, "as simulated")
        task.done.touch(exist_ok=False)  # a second completion would raise
        return Result(DONE)

    def gaps(self):
        """Seconds between one try and the next, for every worker."""
        return [later[0] - earlier[1] for spans in self.spans.values()
                for earlier, later in zip(spans, spans[1:])]


def simulated(given, photos):
    """The record of a scene with this number of photos."""
    blocks = max(1, round(photos / given.block))
    folder = given.out / f"blocks-{blocks}"
    shutil.rmtree(folder, ignore_errors=True)
    tasks = [Task(f"{number:06d}", ("block", str(number)), folder / f"{number:06d}" / "done")
             for number in range(blocks)]
    stub, sent, original = Stub(given), [], TCP.write

    async def counted(self, *arguments, **named):
        size = await original(self, *arguments, **named)
        sent.append(size)
        return size

    in_child, cluster.in_child, TCP.write = cluster.in_child, stub, counted
    try:
        with Workers(given.workers) as workers:
            begin, cpu, sent[:] = time.monotonic(), time.process_time(), []
            rounds, unfinished = 0, True
            while unfinished and rounds < MOST_ROUNDS:
                rounds += 1
                unfinished = not all(outcome.ok for outcome in run(
                    tasks, scheduler=workers.address))
            seconds, cpu, size = time.monotonic() - begin, time.process_time() - cpu, sum(sent)
    finally:
        cluster.in_child, TCP.write = in_child, original
    lost = sum(not task.done.exists() for task in tasks)
    shutil.rmtree(folder)
    gap = float(np.mean(stub.gaps() or [0.0]))
    return {"photos": photos, "blocks": blocks, "workers": given.workers, "scale": given.scale,
            "lost": lost, "rounds": rounds, "tries": sum(stub.tries.values()),
            "failed_tries": stub.failed, "worker_deaths": stub.died,
            "block_seconds": stub.true_seconds / blocks, "gap_seconds": gap,
            "overhead": gap * sum(stub.tries.values()) / stub.true_seconds,
            "engine_cpu_seconds": cpu / blocks, "bytes": size / blocks, "wall_seconds": seconds}


COLUMNS = (("photos", "photos", ",d"), ("blocks", "blocks", ",d"), ("lost", "lost", "d"),
           ("runs of the command", "rounds", "d"), ("tries", "tries", ",d"),
           ("failed", "failed_tries", ",d"), ("worker deaths", "worker_deaths", ",d"),
           ("true block, s", "block_seconds", ",.0f"), ("gap, s", "gap_seconds", ".3f"),
           ("overhead, %", "overhead", ".3%"),
           ("engine CPU a block, s", "engine_cpu_seconds", ".4f"),
           ("bytes a block", "bytes", ",.0f"), ("took, s", "wall_seconds", ",.0f"))


def table(records):
    """A row for each size of scene."""
    first = records[0]
    return Table(
        f"{first['workers']} workers, time {first['scale']:g} times faster",
        tuple(title for title, _, _ in COLUMNS),
        [tuple(format(record[key], digits).rstrip("%") for _, key, digits in COLUMNS)
         for record in records], range(len(COLUMNS)),
        ("gap: of a worker between a try and its next one, in real seconds; overhead: all gaps "
         "against all true work. Engine CPU and bytes are totals of client, scheduler and "
         "workers.",))


def main(argv):
    """Simulate and write the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--photos", type=int, nargs="+", default=[1000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--block", type=int, default=100, help="photos a block; default 100")
    parser.add_argument("--workers", type=int, default=40)
    parser.add_argument("--seconds", type=float, nargs="+", default=SECONDS,
                        help="true seconds of a block, drawn from these; default "
                        f"{' '.join(map(str, SECONDS))}")
    parser.add_argument("--scale", type=float, default=200.0, help="default 200")
    parser.add_argument("--failures", type=float, default=0.02, help="share of tries; default 0.02")
    parser.add_argument("--deaths", type=float, default=0.005,
                        help="share of tries during which the worker dies; default 0.005")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(argv)
    given.out.mkdir(parents=True, exist_ok=True)
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it reports every death
    records = []
    with open(given.out / "simulation.jsonl", "w") as file:
        for photos in given.photos:
            records.append(simulated(given, photos))
            print(json.dumps(records[-1]), file=file, flush=True)
            print(json.dumps(records[-1]), flush=True)
    (given.out / "simulation.md").write_text(markdown(table(records)) + "\n")
    print(f"\n{table(records).text()}")


if __name__ == "__main__":
    outermost(main)
