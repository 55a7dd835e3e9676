"""clsplat asks nothing of the operating system that Windows or macOS lacks.

The modules and names that only some systems have are hidden here, and the commands are run without
them. What the hidden names stand for is seen on Linux only: it is no test of the other systems.
What no command of these tests reaches is looked for by `mypy --platform win32` in .ci/run.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat.device import runtimes
from tests.layout import ROOT
from tools.synth.__main__ import synthesise

# not in Windows' standard library; macOS has all but the last two
MODULES = (
    "fcntl",
    "resource",
    "pwd",
    "grp",
    "termios",
    "tty",
    "pty",
    "syslog",
    "posix",
    "curses",
    "readline",
    "crypt",
    "nis",
    "spwd",
    "ossaudiodev",
)
NAMES = {
    "os": (
        "fork",
        "forkpty",
        "killpg",
        "getpgid",
        "getpgrp",
        "setpgid",
        "setsid",
        "getsid",
        "setuid",
        "getloadavg",
        "nice",
        "mkfifo",
        "mknod",
        "openpty",
        "ttyname",
        "fchown",
        "chroot",
        "pwrite",
        "preadv",
        "sendfile",
        "wait3",
        "wait4",
        "pipe2",
        "sched_setaffinity",
        "memfd_create",
        "posix_fadvise",
        "posix_fallocate",
        "pidfd_open",
        "eventfd",
        "copy_file_range",
        "getxattr",
        "setxattr",
        "getrandom",
    ),
    "signal": (
        "SIGKILL",
        "SIGHUP",
        "SIGQUIT",
        "SIGUSR1",
        "SIGUSR2",
        "SIGPIPE",
        "SIGALRM",
        "SIGCHLD",
        "SIGSTOP",
        "SIGCONT",
        "pthread_kill",
        "pthread_sigmask",
        "sigwait",
        "alarm",
        "setitimer",
        "siginterrupt",
        "pause",
    ),
}  # but those that subprocess, tempfile and pathlib of this very system use themselves

# sitecustomize.py of every process below, and of its children: hides when clsplat is first imported
HIDE = f"""
import sys

class Hide:
    def find_spec(self, name, path=None, target=None):
        if name == "clsplat":
            sys.meta_path.remove(self)
            import os, signal, subprocess, tempfile, pathlib, shutil, threading  # the system's own
            for module in {MODULES!r}:
                sys.modules[module] = None
            for module, names in {NAMES!r}.items():
                for name in names:
                    vars(sys.modules[module]).pop(name, None)

sys.meta_path.insert(0, Hide())
"""

IMPORT_ALL = """
import importlib, pkgutil, sys
import clsplat
assert sys.modules["fcntl"] is None and not hasattr(__import__("os"), "fork")
names = []
for module in pkgutil.walk_packages(clsplat.__path__, "clsplat."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
        names.append(module.name)
print(len(names))
"""


@pytest.fixture
def elsewhere(tmp_path):
    """run(words of Python): the outcome on a system without what `HIDE` hides."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(HIDE, "utf-8")
    paths = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])

    def run(*words, **environment):
        return subprocess.run(
            [sys.executable, *map(str, words)],
            cwd=tmp_path,
            stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": paths, **environment},
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=300,
            check=False,
        )

    return run


@pytest.mark.slow
def test_every_module_can_be_imported(elsewhere):
    done = elsewhere("-c", IMPORT_ALL)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100


@pytest.mark.parametrize("words", [("--help",), ("devices",), ("train", "--help")], ids=" ".join)
@pytest.mark.one_in(3)
def test_commands_begin(elsewhere, words):
    done = elsewhere("-m", "clsplat", *words)
    assert done.returncode == 0, done.stderr
    assert done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [("train",), pytest.param(("city", "--grid", "2x1", "--workers", "2"), marks=pytest.mark.nightly)], ids=len
)
def test_a_training_from_scene_to_picture(elsewhere, tmp_path, words):
    """With its children: the COLMAP reader's process, and a city's two workers."""
    synthesise(tmp_path / "town", (1, 1), 12, (96, 64))
    for line in (
        (*words, "town", "-n", "12", "-q", "-o", "run"),
        ("eval", "run"),
        ("export", "run", "-o", "model.ply"),
    ):
        done = elsewhere("-m", "clsplat", *line)
        assert done.returncode == 0, (line, done.stderr)
    assert (tmp_path / "model.ply").stat().st_size > 1000


def test_intels_runtime_is_found_beside_the_others(monkeypatch, tmp_path):
    """In a folder that is there while platforms are listed, and needs no home."""
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "libintelocl.so").touch()
    (tmp_path / "a.icd").write_text("liba.so\n")
    monkeypatch.setattr(runtimes.sys, "prefix", str(tmp_path))
    monkeypatch.setattr(runtimes, "SYSTEM_VENDORS", tmp_path)
    monkeypatch.delenv("OCL_ICD_VENDORS", raising=False)
    with runtimes.intel_runtime():
        folder = Path(os.environ["OCL_ICD_VENDORS"])
        assert {file.read_text("utf-8") for file in folder.iterdir()} == {
            "liba.so\n",
            f"{tmp_path}/lib/libintelocl.so\n",
        }
    assert "OCL_ICD_VENDORS" not in os.environ and not folder.exists()
