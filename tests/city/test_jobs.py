"""Jobs of a city: which run, how often, where, and what ends them."""

import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import clsplat
from clsplat.cities import cluster, workers
from clsplat.cities.cluster import Cluster
from clsplat.cities.jobs import HERE, Lost
from clsplat.cities.workers import LOG, MOST_TRIES, Workers
from clsplat.errors import InputError, OutOfDeviceMemory
from clsplat.io.lock import exclusive
from tests.city.jobs_driver import DONE, ENDS, NO_DEVICE, STARTS, STATE, STEPPED, lines, some_jobs
from tests.signals import needs_signals

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def caches(monkeypatch, tmp_path):
    """A folder of kernel caches for the processes of this test alone."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "kernels"))


def starts(job):
    return len(lines(job, STARTS))


def processes_of(given):
    """The process of each job's last start."""
    return [lines(job, STARTS)[-1].split()[1] for job in given]


def eventually(condition, seconds=120.0):
    """Wait until the condition holds; whether it did."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def run(given, number=1, devices=(), here=None, **rest):
    with Workers(number, devices=devices) as workers:
        return workers.run(given, here, **rest)


def test_jobs_run_in_order_and_once(tmp_path):
    given, called, began, seen = some_jobs(tmp_path, 3), [], [], []

    def here(job):
        called.append(job.name)
        job.done.touch()
        return len(called)

    given[1].folder.mkdir()
    given[1].done.touch()
    outcomes = run(given, here=here, began=lambda job: began.append(job.name), ended=seen.append)
    assert called == began == ["000", "002"] == [outcome.job.name for outcome in seen]
    assert [(o.ok, o.tries, o.value) for o in outcomes] == [(True, 1, 1), (True, 0, None), (True, 1, 2)]
    assert outcomes[0].worker == HERE
    assert run(given, here=here)[0].tries == 0 and len(called) == len(seen)


@pytest.mark.slow
def test_a_job_runs_beside_what_this_process_does(tmp_path):
    works, fails, late = (replace(job, failures=number == 1) for number, job in enumerate(some_jobs(tmp_path, 3)))
    with Workers(1) as workers:  # there is no other process
        assert workers.begin(works) is None and workers.end(None) is None
    with Workers(2, devices=("0", "0")) as workers:  # nor one with another device
        assert workers.begin(works) is None
    with Workers(2, devices=("0", "1")) as workers:
        begun = [workers.begin(works), workers.begin(fails)]
        assert workers.end(begun[0]) == (1, f"{HERE}, device 1")
        assert workers.end(begun[1]) is None
        assert workers.begin(works) is None  # it is done
        assert [outcome.ok for outcome in workers.run([late], None)] == [True]


@pytest.mark.parametrize(
    "error, tries, message",
    [
        (InputError("no photos: add some"), 1, "no photos: add some"),
        (OutOfDeviceMemory("no memory"), 1, "no memory"),
        (ValueError("a bug"), MOST_TRIES, "a bug"),
        (Lost("it died"), MOST_TRIES, "it died"),
    ],
)
def test_failures_are_reported_and_the_other_jobs_run(tmp_path, error, tries, message):
    def here(job):
        if job.name == "001":
            job.done.touch()
        else:
            raise error

    bad, good = run(some_jobs(tmp_path, 2), here=here)
    assert good.ok and not bad.ok
    assert bad.tries == tries and message in str(bad.error)
    assert bad.error is error


def test_a_number_of_workers_below_one_is_refused():
    with pytest.raises(InputError, match="expects 1 to 1024"):
        Workers(0)


def test_a_job_begins_after_those_that_it_needs(tmp_path):
    first, second, *others = some_jobs(tmp_path, 4)
    given = [replace(first, after=("003",)), replace(second, after=("000", "002")), *others]
    order = []

    def here(job):
        order.append(job.name)
        job.done.touch()

    assert all(outcome.ok for outcome in run(given, here=here))
    assert order == ["002", "003", "000", "001"]


def test_what_needs_a_job_that_failed_is_not_tried(tmp_path):
    first, second, third = some_jobs(tmp_path, 3)
    given = [replace(first, after=("001",)), second, replace(third, after=("000",))]
    seen = []

    def here(job):
        raise InputError("no photos")

    first, failed, third = run(given, here=here, ended=seen.append)
    assert [outcome.job.name for outcome in seen] == ["001"] and str(failed.error) == "no photos"
    assert [(o.ok, o.tries, str(o.error)) for o in (first, third)] == [
        (False, 0, "it waits for 001"),
        (False, 0, "it waits for 000"),
    ]


@pytest.mark.slow
def test_each_process_has_its_device_and_cache_and_stays(tmp_path):
    given = some_jobs(tmp_path, 6, steps=8)
    outcomes = run(given, 2, ("cpu", "0"))
    assert all(outcome.ok and outcome.tries == 1 and outcome.value == 8 for outcome in outcomes)
    assert {outcome.worker.split()[-1] for outcome in outcomes} == {"0", "cpu"}
    seen = {tuple(lines(job, STARTS)[0].split()[1:]) for job in given}
    assert len(seen) == 2 == len({each[0] for each in seen}) == len({each[3] for each in seen})


@needs_signals
@pytest.mark.slow
def test_a_process_is_replaced_after_a_failure_and_when_it_dies(tmp_path):
    """What a job prints goes to its own log."""
    plain = some_jobs(tmp_path / "plain", 2, says="hello")
    dies = some_jobs(tmp_path / "dies", 1, failures=1, fault=str(int(signal.SIGKILL)))
    fails = some_jobs(tmp_path / "fails", 1, failures=2)
    refused = some_jobs(tmp_path / "refused", 1, failures=9, fault="memory")
    with Workers(2) as workers:
        first, second = (workers.run([job], None)[0] for job in plain)
        assert first.ok and second.ok and len(set(processes_of(plain))) == 1
        assert [line for line in lines(plain[0], LOG) if line[:3] != "---"] == ["hello from 000"]
        [died], [failed], [memory] = (workers.run(each, None) for each in (dies, fails, refused))
        workers._pool.all[0].executor.submit(os._exit, 1).exception()  # while it has no job
        [last] = workers.run(some_jobs(tmp_path / "last", 1), None)
    assert died.ok and died.tries == 2 == starts(died.job)
    assert failed.ok and failed.tries == 3 == starts(failed.job)
    assert len({line.split()[1] for line in lines(fails[0], STARTS)}) == 3
    assert "ValueError: as requested" in (fails[0].folder / LOG).read_text()
    assert isinstance(memory.error, OutOfDeviceMemory) and memory.tries == 1 and last.ok


def test_a_job_goes_where_the_latest_one_of_its_folder_was(tmp_path, monkeypatch):
    began = []

    def executor(*_, **__):
        number = len(began)
        began.append(number)
        return SimpleNamespace(submit=lambda call, job: begun(number), shutdown=lambda: None)

    def begun(number):
        futures.append(Future())
        return futures[-1]

    def places(names):
        futures.clear()
        for name in names:
            pool.submit(SimpleNamespace(folder=tmp_path / name))
        for future in futures:
            future.set_result(None)
        return [str(each.folder.name) for each in pool.all]

    futures, pool = [], workers._Processes(3)
    monkeypatch.setattr(workers, "ProcessPoolExecutor", executor)
    assert places("abc") == places("cab") == places("bca") == ["a", "b", "c"]
    assert places("xc") == ["x", "b", "c"] and began == [0, 1, 2]
    pool.all[2].future = Future()
    pool.all[2].future.set_exception(RuntimeError("the device is gone"))
    assert places("c") == ["c", "b", "c"]  # perhaps another device can do it


def driver(*words, on_interrupt=signal.SIG_DFL):
    """`Workers.run` in a new process; background jobs of a shell ignore Ctrl-C."""
    return subprocess.Popen(
        [sys.executable, "-m", "tests.city.jobs_driver", *map(str, words)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Windows has none
        preexec_fn=None if os.name == "nt" else (lambda: signal.signal(signal.SIGINT, on_interrupt)),
    )


@needs_signals
@pytest.mark.slow
@pytest.mark.parametrize(
    "name, on_interrupt", [("SIGINT", signal.SIG_DFL), ("SIGKILL", signal.SIG_IGN)], ids=["Ctrl-C", "kill -9"]
)
def test_processes_save_and_end_with_their_parent(tmp_path, name, on_interrupt):
    number = getattr(signal, name)
    given = some_jobs(tmp_path, 3)
    parent = driver(tmp_path, 3, 9999, 2, on_interrupt=on_interrupt)
    assert eventually(lambda: all(lines(job, STEPPED) for job in given[:2]))
    os.killpg(parent.pid, number)  # as a terminal does, to all its foreground processes
    said = parent.communicate(timeout=120)[1]
    assert parent.returncode == (2 if number == signal.SIGINT else -number), said
    if number == signal.SIGINT:
        assert "Interrupted: stopped, 0 of 3 jobs finished" in said
        assert "the same command continues" in said and "Traceback" not in said
    assert eventually(lambda: all((job.folder / STATE).exists() for job in given[:2]))
    processes = [int(each) for each in processes_of(given[:2])]
    assert eventually(lambda: not any(map(is_alive, processes)))
    steps = int((given[0].folder / STATE).read_text())
    assert steps > 0 and starts(given[2]) == 0
    [again] = run(some_jobs(tmp_path, 1, steps=steps + 1), 2)
    assert again.ok and int((given[0].folder / STATE).read_text()) == steps + 1


def is_alive(process):
    try:
        os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


def test_without_dask_the_cure_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="pip install dask distributed"):
        Workers(scheduler="tcp://127.0.0.1:1").run(some_jobs(tmp_path, 1), None)


@pytest.fixture
def dask():
    pytest.importorskip("distributed")
    from tests.city.dask_processes import DaskProcesses

    with DaskProcesses() as started:
        yield started


def on_cluster(dask, given, **rest):
    with Workers(scheduler=dask.address) as workers:
        return workers.run(given, None, **rest)


def dask_workers(dask):
    import distributed

    with distributed.Client(dask.address, set_as_default=False) as client:
        return client.scheduler_info()["workers"]


def at_work(given):
    """Those that have made a step since their last start, and have not ended."""
    return [
        job
        for job in given
        if lines(job, STEPPED)
        and not lines(job, ENDS)
        and lines(job, STEPPED)[-1] > lines(job, STARTS)[-1]
        and is_alive(int(processes_of([job])[0]))
    ]


@pytest.mark.slow
def test_jobs_are_spread_over_workers_and_failures_tried_again(dask, tmp_path):
    for resources in ("device=1", "device=1", ""):
        dask.start_worker(resources=resources)
    assert eventually(lambda: len(dask_workers(dask)) == 3)
    outcomes = on_cluster(dask, some_jobs(tmp_path, 4, failures=1, steps=8))
    assert all(outcome.ok and outcome.tries == 2 and outcome.value == 8 for outcome in outcomes)
    assert all(len(lines(outcome.job, ENDS)) == 1 for outcome in outcomes)
    assert len({outcome.worker for outcome in outcomes}) == 2  # not the one without a device
    [refused] = on_cluster(dask, some_jobs(tmp_path / "bad", 1, failures=9, fault="memory"))
    assert isinstance(refused.error, OutOfDeviceMemory) and refused.tries == 1


@pytest.mark.slow
def test_workers_are_killed_and_every_job_is_done_once(dask, tmp_path):
    """Each is killed while it works, and replaced; the saved states are continued."""
    given = some_jobs(tmp_path, 3)
    for _ in range(2):
        dask.start_worker()
    parent = driver(tmp_path, 3, 80, 1, dask.address)
    for _ in range(2):
        assert eventually(lambda: at_work(given))
        process = int(processes_of(at_work(given)[:1])[0])
        dask.kill(next(worker for worker in dask.workers if worker.pid == process))
        dask.start_worker()
    output, errors = parent.communicate(timeout=300)
    assert parent.returncode == 0, errors
    assert all((job.folder / DONE).exists() and len(lines(job, ENDS)) == 1 for job in given)
    assert sum(map(starts, given)) == len(given) + 2
    assert all((job.folder / STATE).read_text() == "80" for job in given)


@pytest.mark.nightly
def test_a_scheduler_that_is_restarted(dask, tmp_path):
    """Its workers end with it, as those of Dask do, and are started again."""
    given = some_jobs(tmp_path, 3)
    dask.start_worker()
    parent = driver(tmp_path, 3, 60, 1, dask.address)
    assert eventually(lambda: given[0].done.exists() and len(at_work(given)) == 1)
    [interrupted] = at_work(given)
    dask.kill(dask.scheduler)
    assert eventually(lambda: (interrupted.folder / STATE).exists(), 40)  # it has saved
    dask.start_scheduler()
    dask.start_worker()
    output, errors = parent.communicate(timeout=300)
    assert parent.returncode == 0, errors
    assert all(len(lines(job, ENDS)) == 1 for job in given) and starts(interrupted) == 2
    assert sum(map(int, re.findall(r" (\d+)\n", output))) == len(given) + 1


@needs_signals
@pytest.mark.slow
def test_ctrl_c_stops_the_jobs_of_the_cluster(dask, tmp_path):
    given = some_jobs(tmp_path, 2)
    dask.start_worker()
    parent = driver(tmp_path, 2, 9999, 1, dask.address)
    assert eventually(lambda: len(at_work(given)) == 1)
    parent.send_signal(signal.SIGINT)
    _, errors = parent.communicate(timeout=300)
    assert "Interrupted: stopped, 0 of 2 jobs finished" in errors
    assert eventually(lambda: (given[0].folder / STATE).exists())
    with exclusive(given[0].folder, 60):
        assert sum(map(starts, given)) == 1
    steps = int((given[0].folder / STATE).read_text())
    [outcome] = on_cluster(dask, some_jobs(tmp_path, 1, steps=steps))
    assert outcome.ok  # the worker is free again


@pytest.mark.slow
def test_unfit_workers_are_named_and_their_jobs_go_elsewhere(dask, tmp_path, caplog, monkeypatch):
    dask.start_worker("--no-nanny", "--name", "mole", device=NO_DEVICE)
    dask.start_worker("--no-nanny", "--name", "lynx")
    assert eventually(lambda: len(dask_workers(dask)) == 2)
    outcomes = on_cluster(dask, some_jobs(tmp_path, 4, steps=20))
    assert all(outcome.ok for outcome in outcomes)
    assert sum(outcome.tries for outcome in outcomes) == len(outcomes) + 1
    [warning] = [record.getMessage() for record in caplog.records if "mole" in record.getMessage()]
    assert f"no device matches '{NO_DEVICE}'" in warning and "gets no more jobs" in warning
    assert eventually(lambda: len(dask_workers(dask)) == 1)
    monkeypatch.setattr(cluster, "WAIT_SECONDS", 3)
    monkeypatch.setattr(clsplat, "__version__", "0.0")
    with pytest.raises(InputError, match="no worker with a device for 3 s"):
        on_cluster(dask, some_jobs(tmp_path / "hidden", 1))
    assert any("not 0.0; install" in record.getMessage() for record in caplog.records)


@pytest.mark.slow
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense://x"])
def test_a_scheduler_that_does_not_answer(monkeypatch, address):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    with pytest.raises(InputError, match="dask scheduler") as error:
        Cluster(address)
    assert address in str(error.value) and "\n" not in str(error.value)
