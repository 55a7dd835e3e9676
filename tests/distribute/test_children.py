"""Child processes: when they are started, which tasks they serve, and when they end."""

import os
import signal
import time

import pytest

from clsplat.distribute import Children, child, run
from clsplat.distribute.task import DONE
from tests.distribute.driver import PROGRAM, processes_of, stub_tasks


def test_a_child_that_is_killed_between_tasks_is_replaced(tmp_path):
    first, second = stub_tasks(tmp_path, 2)
    for task in (first, second):
        task.folder.mkdir()
    worker = child.Child()
    try:
        assert worker.work(first, PROGRAM).ending == DONE
        os.kill(int(processes_of([first])[0]), signal.SIGKILL)
        worker._process.wait()
        assert worker.work(second, PROGRAM).ending == DONE
    finally:
        worker.close()
    assert worker._process.returncode == 0 and len(set(processes_of([first, second]))) == 2


@pytest.mark.parametrize("module, same", [("json", True), ("clsplat.no_such_module", False)])
def test_a_child_may_be_started_before_its_first_task(tmp_path, module, same):
    """One that could not import what it was to import is replaced."""
    task, worker = stub_tasks(tmp_path, 1)[0], child.Child()
    task.folder.mkdir()
    try:
        worker.start([module])
        early = worker._process
        if not same:
            assert early.wait(60) == 1
        assert worker.work(task, PROGRAM).ending == DONE
        assert (int(processes_of([task])[0]) == early.pid) == same
    finally:
        worker.close()


def test_a_child_that_is_started_early_calls_what_is_needed(tmp_path):
    """It opens its device, for example; where that cannot be had, the tasks will tell."""
    task, folder, worker = stub_tasks(tmp_path, 1)[0], tmp_path / "called", child.Child()
    task.folder.mkdir()
    try:
        worker.start([f"os:makedirs:{folder}", "clsplat.io.scenes.read:read_scene:nowhere"])
        early = worker._process
        assert worker.work(task, PROGRAM).ending == DONE
        assert folder.is_dir() and int(processes_of([task])[0]) == early.pid
    finally:
        worker.close()


def test_children_serve_one_run_after_the_other(tmp_path):
    first, second, third = stub_tasks(tmp_path, 3)
    with Children(5, ("7",), ("json",)) as children:
        processes = [worker._process for worker in children._children]
        for task in (first, second):
            assert run([task], workers=2, program=PROGRAM, children=children)[0].ok
        process = processes[0]
        assert process.poll() is None
    assert process.returncode == 0 and None not in processes[:os.cpu_count()]
    assert not any(processes[os.cpu_count():])
    assert processes_of([first, second]) == 2 * [str(process.pid)]
    assert run([third], workers=2, program=PROGRAM)[0].ok
    assert processes_of([third]) != [str(process.pid)]


def test_children_end_when_there_are_no_more_tasks(tmp_path):
    with Children(2, needed=("json",)) as children:
        assert run(stub_tasks(tmp_path, 1), workers=2, program=PROGRAM, children=children)[0].ok
        children.end()
        assert [worker._process.wait(60) for worker in children._children if worker._process
                ] == [0] * min(2, os.cpu_count())


def test_a_child_without_a_task_ends_while_it_makes_ready(tmp_path):
    """So an error that a command finds at once is not shown seconds later."""
    worker = child.Child()
    worker.start([f"os:makedirs:{tmp_path / 'called'}", "tests.distribute.driver:wait_for_ever"])
    until = time.monotonic() + 60
    while not (tmp_path / "called").is_dir():
        assert time.monotonic() < until
        time.sleep(0.01)
    worker.end()
    assert worker._process.wait(60) == 0


def test_the_first_task_leaves_the_first_device_to_the_command(tmp_path):
    with Children(3, ("0", "1")) as children:
        assert [worker.device for worker in children._children] == ["1", "0", "1"]
        task = stub_tasks(tmp_path, 1)[0]
        task.folder.mkdir()
        assert children.work(task, PROGRAM).worker.endswith("device 1")
