"""One process at a time locks a folder; others are told which, and its death frees the lock."""

import os
import subprocess
import sys

import pytest

from clsplat.errors import InputError
from clsplat.io.lock import LockTaken, check_unlocked, exclusive
from clsplat.io.runs.run import RunFolder
from tests.lock_holder import HOLD, held_elsewhere


def test_another_process_is_refused_and_told_who_locked_it(tmp_path):
    with held_elsewhere(tmp_path) as other:
        with pytest.raises(LockTaken, match=rf"process {other} on \S+, since 20\d\d-.*; wait for it"):
            with exclusive(tmp_path):
                pass
        with pytest.raises(LockTaken):
            check_unlocked(tmp_path)
    with exclusive(tmp_path):
        check_unlocked(tmp_path)  # by another process
    assert not (tmp_path / ".lock.txt").exists()


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    child = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert child.stdout.readline() == "held\n"
    child.kill()
    child.communicate()
    assert (tmp_path / ".lock.txt").exists()  # what it left says nothing any more
    check_unlocked(tmp_path)
    with exclusive(tmp_path):
        assert str(os.getpid()) in (tmp_path / ".lock.txt").read_text()


def test_the_same_process_may_lock_again(tmp_path):
    with exclusive(tmp_path):
        with exclusive(tmp_path / ".." / tmp_path.name):
            pass
        assert (tmp_path / ".lock.txt").exists()
        done = subprocess.run(
            [sys.executable, "-c", HOLD, str(tmp_path)],
            capture_output=True,
            text=True,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        assert "LockTaken" in done.stderr


def test_a_folder_that_cannot_be_locked(tmp_path):
    with pytest.raises(InputError, match="cannot be locked"):
        with exclusive(tmp_path / "missing"):
            pass


def test_a_run_folder_that_stays_empty_is_removed(tmp_path):
    run = RunFolder(tmp_path / "new")
    with pytest.raises(ZeroDivisionError), run.locked():
        RunFolder.create(run.path)
        raise ZeroDivisionError
    assert not run.path.exists()
    with run.locked():
        RunFolder.create(run.path).write_options({})
    assert run.is_begun
