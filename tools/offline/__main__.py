"""Compile every program that real work builds for devices of all vendors, without the devices.

    python -m tools.offline [TARGET ...] [--check | --keep]

Small work of every kind runs here first, and says which programs there are. Then the compilers of
the vendors say what each kernel takes. --keep puts that into the evidence (`python -m
tools.evidence` makes its page), --check compares with it: a spilled vector register, and lost
waves, are errors unless the table has them. Targets are those of tools/offline/compilers.py.
CLSPLAT_COMPILERS may name a folder with unpacked packages of Debian.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from clsplat.errors import InputError
from clsplat.report.page import Table
from tools.evidence import RESULTS, records
from tools.offline.compilers import TARGETS, Target, Usage, compiled, missing
from tools.offline.work import Program, gather, unbuilt
from tools.studies.study import keep, outermost

PAGE = "compilers"
REGISTERS = "Registers and waves"
MEMORY = "Scalar spills, scratch and local memory"
NOTES = {
    REGISTERS: "Vector registers of a lane / waves, and in brackets vector registers that were "
    "spilled (of sm and of Intel, bytes of a lane). Waves are those that run at a time on a SIMD "
    "(gfx), or warps on a multiprocessor (sm), as registers and local memory allow; of Intel, which "
    "has tgllp, acm-g10 and bmg, they are lanes of a thread, which the compiler makes fewer where "
    "its 128 registers do not suffice. Of several builds of a kernel, the worst of each number. All "
    "programs are also SPIR-V that spirv-val finds valid, in both forms.",
    MEMORY: "Scalar registers spilled (gfx alone) / bytes of scratch of a lane / bytes of local "
    "memory of a group, the worst of each of all builds; 0 / 0 / 0 is left out.",
}
FEATURES = ", features"  # after a kernel's name: blends numbers of the user in place of colours
Found = dict[tuple[str, str], Usage]  # (kernel, target) -> the worst of its builds


def compile_all(targets: Iterable[Target], programs: Sequence[Program]) -> tuple[Found, list[str]]:
    """The worst usage of each kernel, and a line for each program that does not compile."""

    def one(job: tuple[Target, Program]) -> tuple[Target, list[Usage], str]:
        target, program = job
        more = FEATURES * ("WITH_FEATURES" in dict(program.choices))
        with TemporaryDirectory() as folder:
            try:
                return (
                    target,
                    [
                        dataclasses.replace(usage, kernel=usage.kernel + more)
                        for usage in compiled(target, program, Path(folder))
                    ],
                    "",
                )
            except InputError as error:
                choices = " ".join(f"{name}={value}" for name, value in program.choices)
                return target, [], f"{target.name} {program.file} {choices}: {error}"

    builds, errors = defaultdict(list), []
    jobs = [(target, program) for target in targets for program in programs]
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        for target, usages, error in threads.map(one, jobs):
            errors += [error] if error else []
            for usage in usages:
                builds[usage.kernel, target.name].append(usage)
    return {key: worst(usages) for key, usages in builds.items()}, errors


def worst(usages: Sequence[Usage]) -> Usage:
    """The worst of each number of several builds of a kernel."""
    rows = [dataclasses.asdict(usage) for usage in usages]
    return Usage(**{name: (min if name == "waves" else max)(row[name] for row in rows) for name in rows[0]})


def tables(found: Found) -> list[Table]:
    """Kernels in rows and targets in columns."""

    def of(usage: Usage) -> tuple[str, str]:
        spills = f" ({usage.vector_spills})" * bool(usage.vector_spills)
        memory = usage.scalar_spills, usage.scratch, usage.local
        return (f"{usage.vector} / {usage.waves}{spills}", " / ".join(map(str, memory)) if any(memory) else "")

    targets = [name for name in TARGETS if any(target == name for _, target in found)]
    kernels = sorted({kernel for kernel, _ in found})
    texts = {key: of(usage) for key, usage in found.items()}
    return [
        Table(
            title,
            ("kernel", *targets),
            [
                row
                for kernel in kernels
                for row in [(kernel, *(texts.get((kernel, target), ("", ""))[number] for target in targets))]
                if any(row[1:])
            ],
            (),
            (NOTES[title],),
        )
        for number, title in enumerate((REGISTERS, MEMORY))
    ]


def stored_limits(lines: Iterable[Mapping[str, str]]) -> dict[tuple[str, str], tuple[int, int]]:
    """(kernel, target) -> the waves and the vector spills that the lines of the evidence have."""
    title, limits = "", dict[tuple[str, str], tuple[int, int]]()
    for line in lines:
        title = line.get("table", title)
        if title == REGISTERS and "kernel" in line:
            limits |= {
                (line["kernel"], target): (int(match[1]), int(match[2] or 0))
                for target, cell in line.items()
                if (match := re.fullmatch(r"\d+ / (\d+)(?: \((\d+)\))?", cell))
            }
    return limits


def complaints(found: Found, stored: Mapping[tuple[str, str], tuple[int, int]]) -> Iterator[str]:
    """A line for each kernel that spills vector registers or has lost waves, unless its line of the
    evidence allows it."""
    for (kernel, target), usage in sorted(found.items()):
        name = f"{target} {kernel}"
        if (kernel, target) not in stored:
            yield f"{name}: has no line in the evidence; run with --keep"
        waves, spills = stored.get((kernel, target), (0, 0))
        if usage.vector_spills > spills:
            yield f"{name}: vector spills: {spills} before, {usage.vector_spills} now"
        if usage.waves < waves:
            yield f"{name}: waves: {waves} before, {usage.waves} now"


def main(argv: Sequence[str]) -> None:
    """Compile, and print, keep or check what was found."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.offline", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("targets", nargs="*", metavar="TARGET")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args(argv)
    if unknown := set(options.targets) - TARGETS.keys():
        raise InputError(f"{min(unknown)}: not a target; use {', '.join(TARGETS)}")
    targets = [TARGETS[name] for name in options.targets or TARGETS]
    if options.keep and options.targets:
        raise InputError("--keep: goes with all targets; give none")
    if lacking := missing(targets):
        raise InputError("; ".join(lacking))
    programs = gather()
    errors = [f"{kernel}: no work of tools/offline/work.py launches it" for kernel in unbuilt(programs)]
    found, failed = compile_all(targets, programs)
    errors += failed
    if options.check:
        errors += complaints(found, stored_limits(records(RESULTS / f"{PAGE}.jsonl")))
    elif options.keep and not errors:
        keep(PAGE, tables(found), "python -m tools.offline --keep", "no device")
    elif not options.keep:
        for (_, target), usage in sorted(found.items()):
            print(target, usage)
    print(
        f"{len(programs)} programs, {len({kernel for kernel, _ in found})} kernels, "
        f"{len(targets)} targets, {len(errors)} errors"
    )
    print("\n".join(errors), file=sys.stderr)
    sys.exit(bool(errors))


if __name__ == "__main__":
    outermost(main)
