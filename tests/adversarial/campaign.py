"""Runs hostile cases as real processes and says what was wrong with each."""

import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
import traceback
from pathlib import Path

from tests.adversarial.case import INTERRUPTED, REFUSED, WORKS, Case, Result
from tests.adversarial.prepared import environment, provide
from tests.adversarial.whole import changes, fault, listing
from tests.signals import listen

MARKS = ("Traceback (most recent call last)", "this is a bug")
NOISE = (".lock", ".lock.json")  # a lock says nothing about what a folder holds


def patience() -> float:
    """By how much more time everything takes on a machine that is busy already."""
    return min(4.0, 2 * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)))


def run_line(line: str, folder: Path, scratch: Path, seconds: float = 60, extra=None,
             signals=()) -> Result:
    """A shell line in a folder, killed with all it started after `seconds`.

    signals: [(seconds after its start, signal), ...] that the line, then one command, gets.
    """
    begin = time.monotonic()
    words = f"exec {line}" if signals else f"set -o pipefail\n{line}"
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            ["bash", "-c", words], cwd=folder, stdin=subprocess.DEVNULL,
            stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
            preexec_fn=listen, env={**environment(scratch), **(extra or {})})
        try:
            for moment, number in signals:
                _wait_until(process, begin + moment)
                process.send_signal(number)
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            try:
                os.killpg(process.pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
            process.wait()
        output.seek(0)
        text = output.read().decode(errors="replace")
    return Result(code, text, time.monotonic() - begin)


def _wait_until(process, moment):
    try:
        process.wait(max(0.0, moment - time.monotonic()))
    except subprocess.TimeoutExpired:
        pass


def faults_of(result: Result, exits) -> list[str]:
    """What is wrong with how a command ended and what it said."""
    if result.code is None:
        return [f"did not end within {result.seconds:.0f} s"]
    found = [f"says '{mark}'" for mark in MARKS if mark in result.output]
    if result.code not in exits:
        found.append(f"exit code {result.code}, not {' or '.join(map(str, exits))}")
    if result.code == REFUSED and len(result.errors) != 1:
        found.append(f"{len(result.errors)} lines begin with 'error: ', not one")
    if result.code in (WORKS, INTERRUPTED) and result.errors:
        found.append(f"exit code {result.code} beside an error")
    return found


def faults_of_files(folder: Path, before: dict[str, str], writes) -> list[str]:
    """What is wrong with the files that a command left."""
    after = {name: state for name, state in listing(folder).items()
             if Path(name).name not in NOISE}
    before = {name: state for name, state in before.items() if Path(name).name not in NOISE}
    found = changes(before, after, writes)
    for name, state in after.items():
        if before.get(name) == state:
            continue
        if name.endswith(".part"):
            found.append(f"{name} was left")
        elif len(state) == 64 and (broken := fault(folder / name)):
            found.append(f"{name}: {broken}")
    return found


def run_case(case: Case) -> tuple[Result, list[str]]:
    """How a case ended and what was wrong with it, in a folder of its own."""
    base = Path(tempfile.mkdtemp(prefix="clsplat-case-"))
    folder, scratch = base / "case", base / "scratch"
    folder.mkdir()
    try:
        provide(case.needs, folder)
        if callable(case.setup):
            case.setup(folder)
        elif case.setup:
            done = run_line(case.setup, folder, scratch, 600)
            if done.code:
                return done, [f"its setup ended with {done.code}"]
        environment(scratch)
        before = listing(folder)
        result = run_line(case.line, folder, scratch, case.seconds * patience(),
                          case.environment)
        return result, _judge(case, folder, scratch, before, result)
    except Exception as error:  # noqa: BLE001  (one case does not end the campaign)
        return Result(None, traceback.format_exc(), 0.0), [f"the harness failed: {error}"]
    finally:
        _release(base)


def _judge(case, folder, scratch, before, result):
    found = faults_of(result, case.exits)
    found += faults_of_files(folder, before, case.writes)
    left = [path.name for path in (scratch / "tmp").iterdir() if path.name.startswith("clsplat")]
    if left and result.code is not None and "kill -" not in case.line:  # the dead do not tidy
        found.append(f"left in TMPDIR: {', '.join(left)}")
    if case.says and not re.search(case.says, result.output):
        found.append(f"does not say '{case.says}'")
    if case.never and re.search(case.never, result.output):
        found.append(f"says '{case.never}'")
    return found + [broken for check in case.checks if (broken := check(folder, result))]


def _release(base):
    """Remove a case's folder, with whatever it mounted."""
    mounts = [line.split()[1] for line in Path("/proc/mounts").read_text().splitlines()
              if str(base) in line] if Path("/proc/mounts").exists() else []
    for mount in reversed(mounts):
        subprocess.run(["umount", "-l", mount], check=False)
    subprocess.run(["chmod", "-R", "u+rwX", str(base)], check=False, stderr=subprocess.DEVNULL)
    shutil.rmtree(base, ignore_errors=True)
