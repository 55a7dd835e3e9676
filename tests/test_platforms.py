"""clsplat asks nothing of the operating system that Windows or macOS lacks.

The modules and names that only some systems have are hidden here, and the commands are run without
them. What the hidden names stand for is seen on Linux only: it is no test of the other systems.
"""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat.device import runtimes
from tests.test_layout import ROOT, sources
from tools.synth.__main__ import synthesise

# not in Windows' standard library; macOS has all but the last two
MODULES = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "posix", "curses",
           "readline", "crypt", "nis", "spwd", "ossaudiodev")
NAMES = {
    "os": ("fork", "forkpty", "killpg", "getpgid", "getpgrp", "setpgid", "setsid", "getsid",
           "getuid", "geteuid", "getgid", "getegid", "setuid", "getloadavg", "uname", "sysconf",
           "statvfs", "nice", "mkfifo", "mknod", "openpty", "ttyname", "chown",
           "fchown", "chroot", "pread", "pwrite", "preadv", "sendfile", "wait3", "wait4", "pipe2",
           "sched_getaffinity", "sched_setaffinity", "memfd_create", "posix_fadvise",
           "posix_fallocate", "posix_spawn", "pidfd_open", "eventfd", "copy_file_range",
           "getxattr", "setxattr", "getrandom", "O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC"),
    "signal": ("SIGKILL", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGPIPE", "SIGALRM",
               "SIGCHLD", "SIGSTOP", "SIGCONT", "pthread_kill", "pthread_sigmask", "sigwait",
               "alarm", "setitimer", "siginterrupt", "pause"),
}
# names that subprocess, tempfile and pathlib of this very system use themselves: only looked for
# in clsplat's own code
KEPT = {"getuid", "geteuid", "uname", "sysconf", "statvfs", "pread", "O_NOFOLLOW", "O_CLOEXEC",
        "O_DIRECTORY", "posix_spawn", "chown", "sched_getaffinity", "getgid", "getegid"}

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
                for name in set(names) - {KEPT!r}:
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
            [sys.executable, *map(str, words)], cwd=tmp_path, stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": paths, **environment}, capture_output=True, text=True,
            encoding="utf-8", timeout=300, check=False)
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
def test_a_training_from_scene_to_picture(elsewhere, tmp_path):
    """With its children: the COLMAP reader's process, and a city's two workers."""
    synthesise(tmp_path / "town", (1, 1), 12, (96, 64))
    for words in (("train", "town", "-n", "12", "-q", "-o", "run"), ("eval", "run"),
                  ("export", "run", "-o", "model.ply"),
                  ("city", "town", "-n", "12", "--grid", "2x1", "--workers", "2", "-o", "cut")):
        done = elsewhere("-m", "clsplat", *words)
        assert done.returncode == 0, (words, done.stderr)
    assert (tmp_path / "model.ply").stat().st_size > 1000
    assert (tmp_path / "cut" / "point_cloud.ply").is_file()


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
            "liba.so\n", f"{tmp_path}/lib/libintelocl.so\n"}
    assert "OCL_ICD_VENDORS" not in os.environ and not folder.exists()


def foreign(path, text):
    """Lines of a module that use what not every system has, or the system's own text encoding."""
    nodes = list(ast.walk(ast.parse(text)))
    guarded = {node.args[1].value for node in nodes if isinstance(node, ast.Call)
               and ast.unparse(node.func) in ("hasattr", "getattr") and len(node.args) > 1
               and isinstance(node.args[1], ast.Constant)}
    guarded |= {child.attr for node in nodes if isinstance(node, ast.Try)
                if any("AttributeError" in ast.unparse(handler.type or ast.Constant(""))
                       for handler in node.handlers)
                for child in ast.walk(ast.Module(node.body, []))
                if isinstance(child, ast.Attribute)}
    tried = {id(child) for node in nodes if isinstance(node, ast.Try)
             and any("ImportError" in ast.unparse(handler.type or ast.Constant(""))
                     for handler in node.handlers) for child in node.body}
    for node in nodes:
        said = _foreign(node, guarded, tried)
        if said:
            yield f"{path}:{node.lineno}: {said}"


def _foreign(node, guarded, tried):
    if isinstance(node, (ast.Import, ast.ImportFrom)) and id(node) not in tried:
        names = ([node.module or ""] if isinstance(node, ast.ImportFrom)
                 else [alias.name for alias in node.names])
        hit = set(names) & set(MODULES)
        return hit and f"imports {', '.join(sorted(hit))}"
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        if node.attr in NAMES.get(node.value.id, ()) and node.attr not in guarded:
            return f"uses {node.value.id}.{node.attr}"
    if isinstance(node, ast.Attribute) and node.attr == "NamedTemporaryFile":
        return "uses NamedTemporaryFile, which Windows cannot open a second time"
    if isinstance(node, ast.Call) and _is_text_without_encoding(node):
        return "reads or writes text without encoding=: Windows' is not UTF-8"
    return ""


def _is_text_without_encoding(call):
    if any(keyword.arg in ("encoding", None) for keyword in call.keywords):
        return False
    name = call.func.attr if isinstance(call.func, ast.Attribute) else ast.unparse(call.func)
    if name == "read_text":
        return not call.args
    if name == "write_text":
        return len(call.args) < 2
    if isinstance(call.func, ast.Name) and name == "open":
        modes = [argument.value for argument in call.args[1:2]
                 if isinstance(argument, ast.Constant)]
        modes += [keyword.value.value for keyword in call.keywords if keyword.arg == "mode"]
        return "b" not in (modes or [""])[0]
    return False


def test_nothing_foreign_in_what_ships():
    found = [line for path, file in sources(ROOT, "clsplat")
             for line in foreign(path, file.read_text("utf-8"))]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("text, said", [
    ("import fcntl", "imports fcntl"),
    ("from pwd import getpwuid", "imports pwd"),
    ("import os\nos.fork()", "uses os.fork"),
    ("import signal\nsignal.pthread_kill(1, 2)", "uses signal.pthread_kill"),
    ("open('a')", "without encoding"), ("open('a', 'w')", "without encoding"),
    ("p.read_text()", "without encoding"), ("p.write_text('a')", "without encoding"),
    ("with tempfile.NamedTemporaryFile() as f: pass", "NamedTemporaryFile")])
def test_what_is_foreign_is_noticed(text, said):
    line, = foreign("m.py", text)
    assert said in line


@pytest.mark.parametrize("text", [
    "try:\n    import resource\nexcept ImportError:\n    resource = None",
    "try:\n    os.getloadavg()\nexcept AttributeError:\n    pass",
    "if hasattr(signal, 'pthread_kill'):\n    signal.pthread_kill(1, 2)",
    "open('a', 'rb')", "open('a', encoding='utf-8')", "p.read_text('utf-8')", "os.replace(a, b)"])
def test_what_every_system_has_passes(text):
    assert not list(foreign("m.py", text))
