"""The engine on one machine: which tasks run, how often, where, and what ends them."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path

import pytest

import clsplat
from clsplat.distribute import Task, Workers, child, cluster, guarded, local, run
from clsplat.distribute.ledger import MOST_LOSSES, Ledger
from clsplat.distribute.task import FAILED, INTERRUPTED, LOCKED, LOG, LOST, Result
from clsplat.errors import InputError, Interrupted
from clsplat.io.lock import HOLDER, LOCK, LockTaken, exclusive, latest_change
from clsplat.training.progress import NotedProgress, SilentProgress
from tests.data.tiny_training import CITY, flags
from tests.distribute.driver import PROGRAM, lines, processes_of, stub_tasks
from tests.distribute.stub_command import ENDS, NO_DEVICE, STARTS, STATE, STEP_SECONDS, STEPPED
from tests.lock_holder import held_elsewhere

ROOT = Path(__file__).resolve().parents[2]


def starts(task):
    return len(lines(task, STARTS))


def eventually(condition, seconds=120.0):
    """Wait until the condition holds; whether it did."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


# --- in this process


def test_in_process_the_tasks_run_in_order_and_once(tmp_path):
    tasks, called, seen = stub_tasks(tmp_path, 3), [], []

    def call(task):
        called.append(task.name)
        task.done.touch()

    tasks[1].folder.mkdir()
    tasks[1].done.touch()
    outcomes = run(tasks, call=call, progress=seen.append)
    assert called == ["000", "002"] == [outcome.task.name for outcome in seen]
    assert [(o.task.name, o.ok, o.tries) for o in outcomes] == [
        ("000", True, 1), ("001", True, 0), ("002", True, 1)]
    assert run(tasks, call=call, progress=seen.append)[0].tries == 0 and len(called) == len(seen)


@pytest.mark.parametrize("error, tries, message", [
    (InputError("no photos: add some"), 1, "no photos: add some"),
    (ValueError("a bug"), 3, "ValueError: a bug"),
    (None, 3, "did not write")])
def test_in_process_failures_are_reported_and_the_other_tasks_run(tmp_path, error, tries, message):
    def call(task):
        if task.name == "001":
            task.done.touch()
        elif error:
            raise error

    bad, good = run(stub_tasks(tmp_path, 2), call=call)
    assert good.ok and not bad.ok
    assert bad.tries == tries and message in bad.message


def test_in_process_an_interrupt_ends_the_run(tmp_path):
    def call(task):
        raise Interrupted("saved")

    with pytest.raises(Interrupted, match="saved"):
        run(stub_tasks(tmp_path, 2), call=call)


def test_two_tasks_of_one_name_are_refused(tmp_path):
    with pytest.raises(ValueError, match="000"):
        run(stub_tasks(tmp_path, 1) * 2)


def test_a_number_of_workers_below_one_is_refused(tmp_path):
    with pytest.raises(InputError, match="expects 1 to 1024"):
        run(stub_tasks(tmp_path, 1), workers=0)


def test_a_task_that_loses_its_worker_is_tried_again_until_the_limit(tmp_path):
    ledger = Ledger(stub_tasks(tmp_path, 1), 0, None)
    for _ in range(MOST_LOSSES):
        assert not ledger.outcomes
        ledger.settle(ledger.waiting.popleft(), Result(LOST, "it died"))
    assert ledger.in_order()[0].message == "it died" and not ledger.waiting


# --- in children


@pytest.mark.slow
def test_as_many_children_as_workers_each_with_its_device_and_cache(tmp_path):
    tasks = stub_tasks(tmp_path, 4, "--steps", 8)
    outcomes = run(tasks, workers=2, devices=("0", "gpu"), program=PROGRAM)
    assert all(outcome.ok and outcome.tries == 1 for outcome in outcomes)
    assert all(outcome.seconds > 8 * STEP_SECONDS for outcome in outcomes)
    assert {outcome.worker.split()[-1] for outcome in outcomes} == {"0", "gpu"}
    spans = [(*lines(task, STARTS)[0].split(), float(lines(task, ENDS)[0].split()[0]))
             for task in tasks]
    for begin, *_ in spans:
        here = [span for span in spans if float(span[0]) <= float(begin) < span[-1]]
        assert len(here) <= 2
        assert len({span[3] for span in here}) == len(here) == len({span[2] for span in here})


def test_a_child_stays_for_the_next_task_unless_one_fails(tmp_path):
    tasks = stub_tasks(tmp_path, 4)
    tasks[2] = Task("002", (*tasks[2].command, "--fail", "1"), tasks[2].done)
    assert all(outcome.ok for outcome in run(tasks, program=PROGRAM))
    first, second, third, fourth = processes_of(tasks)  # the third is tried again at the end
    assert first == second == lines(tasks[2], STARTS)[0].split()[-1] != third == fourth


def test_what_a_task_says_goes_to_its_own_log(tmp_path):
    tasks = stub_tasks(tmp_path, 2, "--say", "hello")
    assert all(outcome.ok for outcome in run(tasks, program=PROGRAM))
    for task in tasks:
        assert [line for line in lines(task, LOG) if not line.startswith("---")] == [
            f"hello from {task.folder.name}"]


# --- tasks that wait for others


def test_a_task_begins_after_those_that_it_needs(tmp_path):
    tasks = stub_tasks(tmp_path, 4)
    tasks = [Task(task.name, task.command, task.done, after) for task, after in zip(
        tasks, (("003",), ("000", "002"), (), ()))]
    order = []

    def call(task):
        order.append(task.name)
        task.done.touch()

    assert all(outcome.ok for outcome in run(tasks, call=call)) and order == [
        "002", "003", "000", "001"]


def test_what_needs_a_task_that_failed_is_not_tried(tmp_path):
    tasks = stub_tasks(tmp_path, 3)
    tasks = [Task(task.name, task.command, task.done, after) for task, after in zip(
        tasks, (("001",), (), ("000",)))]
    seen = []

    def call(task):
        raise InputError("no photos")

    first, failed, third = run(tasks, call=call, progress=seen.append)
    assert [outcome.task.name for outcome in seen] == ["001"] and failed.message == "no photos"
    assert [(o.ok, o.tries, o.message) for o in (first, third)] == [
        (False, 0, "it waits for 001"), (False, 0, "it waits for 000")]


def test_a_child_that_fails_is_tried_again(tmp_path):
    [outcome] = run(stub_tasks(tmp_path, 1, "--fail", 2), program=PROGRAM)
    assert outcome.ok and outcome.tries == 3 == starts(outcome.task)


@pytest.mark.parametrize("code, tries, message", [
    (1, 2, "as requested"), (2, 1, "as requested"), (-signal.SIGSEGV, 2, "SIGSEGV")])
def test_a_child_that_fails_for_good_says_why(tmp_path, code, tries, message):
    words = "--fail", 9, "--code", code
    [outcome] = run(stub_tasks(tmp_path, 1, *words), retries=1, program=PROGRAM)
    assert not outcome.ok and outcome.tries == tries == starts(outcome.task)
    assert message in outcome.message and str(outcome.task.folder / LOG) in outcome.message
    assert "\n" not in outcome.message and not outcome.message.startswith("error")


@pytest.mark.parametrize("words, devices, message", [
    (("--forget",), (), "did not write"), ((), (NO_DEVICE,), "it ended with code 2")])
def test_a_child_that_fails_without_output(tmp_path, words, devices, message):
    [task] = stub_tasks(tmp_path, 1, *words)
    task.folder.mkdir()
    (task.folder / LOG).write_text("what an earlier try said\n")
    [outcome] = run([task], retries=0, devices=devices, program=PROGRAM)
    assert not outcome.ok and message in outcome.message


def guarded_child(task, program=PROGRAM):
    """A child as the engine starts it."""
    child = subprocess.Popen([sys.executable, "-m", "clsplat.distribute.guarded"],
                             stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT)
    child.stdin.write(json.dumps([program, str(task.done), *task.command]).encode() + b"\n")
    child.stdin.flush()
    return child


def test_two_children_on_one_task_work_once(tmp_path):
    task = stub_tasks(tmp_path, 1, "--steps", 10)[0]
    task.folder.mkdir()
    children = [guarded_child(task), guarded_child(task)]
    assert [child.stdout.readline() for child in children] == [b"done\n", b"done\n"]
    assert starts(task) == 1 and task.done.exists()
    for process in children:
        process.stdin.close()
    assert [process.wait() for process in children] == [0, 0]


def test_a_folder_that_stays_locked_is_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(guarded, "LOCK_SECONDS", 0.3)
    monkeypatch.setattr(guarded, "_log_to", lambda path: None)
    with held_elsewhere(tmp_path) as other, pytest.raises(SystemExit) as ended:
        guarded._run(PROGRAM, [str(tmp_path)], tmp_path / "done")
    assert ended.value.code == LOCKED
    assert f"process {other} on" in capsys.readouterr().err


def test_a_folder_at_work_is_waited_for(tmp_path, monkeypatch):
    """By a second child: a worker that the scheduler has lost may still train."""
    monkeypatch.setattr(guarded, "LOCK_SECONDS", 0.1)
    changes = iter([0, 1, 1, 2, 2, 2])
    monkeypatch.setattr(guarded, "latest_change", lambda folder: next(changes))
    with held_elsewhere(tmp_path), pytest.raises(LockTaken), ExitStack() as stack:
        guarded._lock(stack, tmp_path)
    assert next(changes, None) is None  # three tries


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="a process cannot be stopped here")
def test_a_child_that_hangs_is_ended_and_tried_again(tmp_path, monkeypatch, caplog):
    def latest_change(folder):
        if starts(task) == 1:
            with suppress(ProcessLookupError):  # the next one may start slowly
                os.kill(int(processes_of([task])[0]), 0)
                return 0
        return next(changes)

    [task] = stub_tasks(tmp_path, 1, "--fail", 1, "--code", -int(signal.SIGSTOP))
    changes = count()
    monkeypatch.setattr(child, "HANG_SECONDS", 0.3)
    monkeypatch.setattr(child, "latest_change", latest_change)
    [outcome] = run([task], retries=1, workers=1, program=PROGRAM)
    assert outcome.ok and outcome.tries == 2 == starts(task)
    [task] = stub_tasks(tmp_path / "again", 1, "--fail", 1, "--code", -int(signal.SIGSTOP))
    [outcome] = run([task], retries=0, program=PROGRAM)
    assert not outcome.ok and "it did nothing for 0.3 s, and was ended" in outcome.message
    [task] = stub_tasks(tmp_path / "quiet", 1, "--fail", 1, "--code", -int(signal.SIGSTOP))
    monkeypatch.setattr(child, "QUIET_SECONDS", 0.1)
    monkeypatch.setattr(child, "HANG_SECONDS", 1.5)
    run([task], retries=0, program=PROGRAM)
    assert f"{task.folder}: process " in caplog.text and "has reported nothing for" in caplog.text


def test_a_folder_that_was_removed_is_no_traceback(tmp_path):
    result = child.in_child(Task("000", (), tmp_path / "gone" / "done"), PROGRAM)
    assert result.ending == FAILED and "gone: No such file" in result.message


def test_a_training_notes_that_it_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.training.progress.NOTE_SECONDS", 0.0)
    assert latest_change(tmp_path / "gone") == 0
    with exclusive(tmp_path):
        for path in tmp_path.iterdir():
            os.utime(path, (1, 1))
        noted = NotedProgress(tmp_path, SilentProgress())
        told = {"iteration": 1, "total": 5, "loss": 1.0, "gaussians": 1, "memory_bytes": 0,
                "level": 2.0}
        for note in (lambda: noted.phase("reading"), lambda: noted(**told),
                     lambda: noted.message("so")):
            os.utime(tmp_path / HOLDER, (1, 1))
            assert latest_change(tmp_path) == 10**9
            note()
            assert latest_change(tmp_path) > 10**9


def test_a_try_to_lock_is_no_sign_of_work(tmp_path):
    """Some versions of filelock write the lock file whenever they try."""
    with exclusive(tmp_path):
        for path in tmp_path.iterdir():
            os.utime(path, (1, 1))
        os.utime(tmp_path / LOCK)
        assert latest_change(tmp_path) == 10**9


def test_a_worker_that_has_another_clsplat_or_not_the_files_is_unfit(tmp_path):
    [task] = stub_tasks(tmp_path, 1)
    assert "does not see" in cluster._fault(task, str(tmp_path), clsplat.__version__)
    task.folder.mkdir()
    assert cluster._fault(task, str(tmp_path), clsplat.__version__) == ""
    assert "not 0.0; install" in cluster._fault(task, str(tmp_path), "0.0")


def driver(*words, on_interrupt=signal.SIG_DFL):
    """The engine in a new process; background jobs of a shell ignore Ctrl-C."""
    return subprocess.Popen([sys.executable, "-m", "tests.distribute.driver", *map(str, words)],
                            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                            start_new_session=True,
                            preexec_fn=lambda: signal.signal(signal.SIGINT, on_interrupt))


@pytest.mark.parametrize("number, on_interrupt", [
    (signal.SIGINT, signal.SIG_DFL), (signal.SIGKILL, signal.SIG_IGN)], ids=["Ctrl-C", "kill -9"])
def test_children_save_and_end_with_their_parent(tmp_path, number, on_interrupt):
    tasks = stub_tasks(tmp_path, 3, "--steps", 9999)
    parent = driver(tmp_path, 3, 9999, 2, on_interrupt=on_interrupt)
    assert eventually(lambda: all(lines(task, STEPPED) for task in tasks[:2]))
    os.killpg(parent.pid, number)  # as a terminal does, to all its foreground processes
    said = parent.communicate(timeout=120)[1]
    assert parent.returncode == (2 if number == signal.SIGINT else -number)
    if number == signal.SIGINT:
        assert "Interrupted: stopped, 0 of 3 tasks finished" in said
        assert "the same command continues" in said
    assert eventually(lambda: all((task.folder / STATE).exists() for task in tasks[:2]))
    with exclusive(tasks[0].folder, 60), exclusive(tasks[1].folder, 60):
        pass  # no process is left
    steps = int((tasks[0].folder / STATE).read_text())
    assert steps > 0 and starts(tasks[2]) == 0
    again = [Task(task.name, (*task.command[:-1], str(steps + 1)), task.done) for task in tasks[:1]]
    assert run(again, program=PROGRAM)[0].ok
    assert int((tasks[0].folder / STATE).read_text()) == steps + 1


# --- the cluster, without one


def test_without_dask_the_cure_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="pip install dask distributed"):
        run(stub_tasks(tmp_path, 1), scheduler="tcp://127.0.0.1:1")


@pytest.mark.slow
def test_a_real_training_saves_when_its_parent_goes_and_ends_in_the_same_bytes(tmp_path):
    words = "train", str(CITY), "-q", *flags(checkpoint_every=10)
    tasks = [Task(name, (*words, "-o", str(tmp_path / name)), tmp_path / name / "point_cloud.ply")
             for name in ("plain", "stopped")]
    assert run(tasks[:1])[0].ok
    stopped = tmp_path / "stopped"
    stopped.mkdir()
    child = guarded_child(tasks[1], "clsplat")
    assert eventually(lambda: (stopped / "checkpoint.npz").exists())
    child.stdin.close()
    assert child.wait(300) == INTERRUPTED
    assert not tasks[1].done.exists()
    assert run([Task("stopped", ("train", str(CITY), "-q", "-o", str(stopped), "--resume"),
                     tasks[1].done)])[0].ok
    assert tasks[0].done.read_bytes() == tasks[1].done.read_bytes()


def test_all_tasks_of_a_command_run_where_its_workers_are(tmp_path):
    assert [each.several for each in (Workers(), Workers(2), Workers(scheduler="tcp://a:1"))] == [
        False, True, True]
    here = Workers().run(stub_tasks(tmp_path / "here", 1), call=lambda task: task.done.touch())
    assert [(outcome.ok, outcome.worker) for outcome in here] == [(True, local.HERE)]
    outcomes = Workers(2, devices=("0", "gpu")).run(stub_tasks(tmp_path, 2), program=PROGRAM)
    assert {outcome.worker.split()[-1] for outcome in outcomes} == {"0", "gpu"}
