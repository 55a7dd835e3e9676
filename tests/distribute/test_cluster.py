"""The engine on a Dask cluster of processes: workers that are killed, unfit or absent, a scheduler
that is restarted, Ctrl-C."""

import re
import signal

import pytest

from clsplat.distribute import cluster, run
from clsplat.errors import InputError
from clsplat.io.lock import exclusive
from tests.distribute.driver import PROGRAM, lines, stub_tasks
from tests.distribute.stub_command import ENDS, NO_DEVICE, STARTS, STATE, STEPPED
from tests.distribute.test_distribute import driver, eventually, starts

pytest.importorskip("distributed")
from tests.distribute.dask_processes import DaskProcesses  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture
def dask():
    with DaskProcesses() as started:
        yield started


def at_work(tasks):
    """The tasks that have made a step since their last start, and have not ended."""
    return [task for task in tasks if starts(task) == len(lines(task, STEPPED)) > 0
            and not lines(task, ENDS)]


def workers_at_work(dask, tasks):
    """The workers that wait for a child, which noted its parent at its last start."""
    parents = {int(lines(task, STARTS)[-1].split()[1]) for task in at_work(tasks)}
    return [worker for worker in dask.workers if worker.poll() is None and worker.pid in parents]


def reported_tries(output):
    """The sum of tries in the outcomes that the driver printed."""
    return sum(map(int, re.findall(r"tries=(\d+)", output)))


def finished_once(tasks):
    return all(task.done.exists() and len(lines(task, ENDS)) == 1 for task in tasks)


def test_tasks_are_spread_over_workers_and_failures_tried_again(dask, tmp_path):
    for resources in ("device=1", "device=1", ""):
        dask.start_worker(resources=resources)
    assert eventually(lambda: len(dask_workers(dask)) == 3)
    outcomes = run(stub_tasks(tmp_path, 8, "--fail", 1, "--steps", 8), scheduler=dask.address,
                   program=PROGRAM)
    assert all(outcome.ok and outcome.tries == 2 for outcome in outcomes)
    assert finished_once(outcome.task for outcome in outcomes)
    assert len({outcome.worker for outcome in outcomes}) == 2  # not the one without a device
    [refused] = run(stub_tasks(tmp_path / "bad", 1, "--fail", 9, "--code", 2),
                    scheduler=dask.address, program=PROGRAM)
    assert not refused.ok and refused.tries == 1 and "as requested" in refused.message


def test_three_workers_are_killed_and_every_task_is_done_once(dask, tmp_path):
    """Each is killed while it works, and replaced; the saved states are continued."""
    tasks = stub_tasks(tmp_path, 3, "--steps", 80)
    for _ in range(2):
        dask.start_worker()
    parent = driver(tmp_path, 3, 80, 1, dask.address)
    for _ in range(3):
        assert eventually(lambda: workers_at_work(dask, tasks))
        dask.kill(workers_at_work(dask, tasks)[0])
        dask.start_worker()
    output, errors = parent.communicate(timeout=300)
    assert parent.returncode == 0, errors
    assert finished_once(tasks)
    assert sum(map(starts, tasks)) == len(tasks) + 3
    assert reported_tries(output) == len(tasks) + 3
    assert all((task.folder / STATE).read_text() == "80" for task in tasks)


def test_a_scheduler_that_is_restarted(dask, tmp_path):
    """Its workers end with it, as those of Dask do, and are started again."""
    tasks = stub_tasks(tmp_path, 3, "--steps", 60)
    dask.start_worker()
    parent = driver(tmp_path, 3, 60, 1, dask.address)
    assert eventually(lambda: tasks[0].done.exists() and len(at_work(tasks)) == 1)
    [interrupted] = at_work(tasks)
    dask.kill(dask.scheduler)
    assert eventually(lambda: (interrupted.folder / STATE).exists(), 40)  # told to save
    dask.start_scheduler()
    dask.start_worker()
    output, errors = parent.communicate(timeout=300)
    assert parent.returncode == 0, errors
    assert finished_once(tasks) and starts(interrupted) == 2
    assert reported_tries(output) == len(tasks) + 1  # the new scheduler reports what began, too


def test_ctrl_c_stops_the_children_of_the_cluster(dask, tmp_path):
    tasks = stub_tasks(tmp_path, 2, "--steps", 9999)
    dask.start_worker()
    parent = driver(tmp_path, 2, 9999, 1, dask.address)
    assert eventually(lambda: len(at_work(tasks)) == 1)
    parent.send_signal(signal.SIGINT)
    _, errors = parent.communicate(timeout=300)
    assert "Interrupted: stopped, 0 of 2 tasks finished" in errors
    assert eventually(lambda: (tasks[0].folder / STATE).exists())
    with exclusive(tasks[0].folder, 60):
        assert sum(map(starts, tasks)) == 1
    [outcome] = run(stub_tasks(tmp_path, 1), scheduler=dask.address, program=PROGRAM)
    assert outcome.ok  # the worker is free again


def test_a_worker_without_a_device_is_named_and_its_tasks_go_elsewhere(dask, tmp_path, caplog):
    dask.start_worker("--no-nanny", "--name", "mole", device=NO_DEVICE)
    dask.start_worker("--no-nanny", "--name", "lynx")
    assert eventually(lambda: len(dask_workers(dask)) == 2)
    outcomes = run(stub_tasks(tmp_path, 4), scheduler=dask.address, program=PROGRAM)
    assert all(outcome.ok for outcome in outcomes)
    assert sum(outcome.tries for outcome in outcomes) == len(outcomes) + 1
    [warning] = [record.getMessage() for record in caplog.records if "mole" in record.getMessage()]
    assert f"no device matches '{NO_DEVICE}'" in warning and "gets no more tasks" in warning
    assert eventually(lambda: len(dask_workers(dask)) == 1)


def test_workers_that_declare_no_device(dask, tmp_path):
    dask.start_worker(resources="")
    assert eventually(lambda: len(dask_workers(dask)) == 1)
    with pytest.raises(InputError, match="none of its 1 workers declares a device; start") as error:
        run(stub_tasks(tmp_path, 1), scheduler=dask.address, program=PROGRAM)
    assert "--resources device=1" in str(error.value)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense://x"])
def test_a_scheduler_that_does_not_answer(tmp_path, monkeypatch, address):
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    with pytest.raises(InputError, match="dask scheduler") as error:
        run(stub_tasks(tmp_path, 1), scheduler=address)
    assert address in str(error.value) and "\n" not in str(error.value)


def test_a_cluster_that_stays_empty(dask, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "WAIT_SECONDS", 1)
    with pytest.raises(InputError, match="no worker with a device for 1 s"):
        run(stub_tasks(tmp_path, 1), scheduler=dask.address, program=PROGRAM)


def test_a_worker_that_does_not_see_the_folder(dask, tmp_path, caplog, monkeypatch):
    dask.start_worker()
    assert eventually(lambda: len(dask_workers(dask)) == 1)
    hidden = stub_tasks(tmp_path, 1)
    monkeypatch.setattr(cluster, "WAIT_SECONDS", 3)
    monkeypatch.setattr(cluster.os, "getcwd", lambda: str(tmp_path / "elsewhere"))
    with pytest.raises(InputError, match="no worker with a device"):
        run(hidden, scheduler=dask.address, program=PROGRAM)
    assert any("does not see" in record.getMessage() and "mount" in record.getMessage()
               for record in caplog.records)


def dask_workers(dask):
    import distributed

    with distributed.Client(dask.address, set_as_default=False) as client:
        return client.scheduler_info()["workers"]


