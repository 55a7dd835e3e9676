"""What .ci/run builds on: lowest versions come from setup.cfg, README's commands are run."""

import configparser
import importlib.util
import re
import subprocess
import sys
from importlib.machinery import SourceFileLoader

import pytest

from tests.test_layout import ROOT

CONFIG = configparser.ConfigParser()
CONFIG.read(ROOT / "setup.cfg", encoding="utf-8")


def loaded(path):
    """The module of a script without a suffix."""
    loader = SourceFileLoader("script", str(ROOT / path))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("script", loader))
    loader.exec_module(module)
    return module


def test_every_requirement_has_a_lowest_version_and_ci_installs_it():
    done = subprocess.run([sys.executable, ROOT / ".ci/requirements", "lowest"], check=False,
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pinned = dict(re.findall(r"(?m)^([\w.-]+)==([\w.]+)", done.stdout))
    lists = [CONFIG["options"]["install_requires"], *CONFIG["options.extras_require"].values()]
    declared = dict(re.findall(r"(?m)^([\w.-]+)>=([\w.]+)", "\n".join(lists)))
    assert pinned == declared and len(pinned) > 10
    assert len(declared) == len([line for line in "\n".join(lists).split("\n") if line.strip()])


@pytest.fixture(scope="module")
def readme():
    return loaded("tools/readme")


@pytest.fixture(scope="module")
def listed(readme):
    return list(readme.commands((ROOT / "README.md").read_text("utf-8")))


def test_readme_is_run(listed):
    """Every command that it names in a block; tools/readme runs them all."""
    assert len(listed) > 10 and all(run for _, run in listed)


def test_readme_has_no_placeholder_that_nothing_replaces(listed):
    for _, run in listed:
        assert not re.search(r"\b[A-Z]{3,}\b", run.replace(str(ROOT), "")), run


def test_every_replacement_is_used(readme, listed):
    for pattern in readme.REPLACEMENTS:
        assert any(re.search(pattern, said) for said, _ in listed), pattern
