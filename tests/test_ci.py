"""What .ci/run builds on: lowest versions come from setup.cfg, README's commands are run."""

import configparser
import importlib.util
import re
import shutil
import subprocess
import sys
from importlib.machinery import SourceFileLoader

import pytest

import clsplat
from tests.layout import ROOT
from tests.shared_kernels import SharedKernels

CONFIG = configparser.ConfigParser()
CONFIG.read(ROOT / "setup.cfg", encoding="utf-8")


def loaded(path):
    """The module of a script without a suffix."""
    loader = SourceFileLoader("script", str(ROOT / path))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("script", loader))
    loader.exec_module(module)
    return module


def test_every_requirement_has_a_lowest_version_and_ci_installs_it():
    done = subprocess.run(
        [sys.executable, ROOT / ".ci/requirements", "lowest"], check=False, capture_output=True, text=True
    )
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


@pytest.fixture
def release(tmp_path, monkeypatch):
    """tools/release of a checkout in tmp_path, and a function that runs git there."""
    module = loaded("tools/release")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    for name in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{name}_NAME", "nobody")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "nobody@example.org")
    (tmp_path / "clsplat").mkdir()
    (tmp_path / "clsplat" / "__init__.py").write_text('__version__ = "0.1.0"\n')
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## 0.1.0 (2026-12-01)\n")
    module.git = lambda *words: module.run("git", *words, cwd=tmp_path)
    module.git("init", "--quiet")
    module.git("add", ".")
    module.git("commit", "--quiet", "-m", "all")
    return module


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_release_is_refused_with_its_cause(release, tmp_path):
    def refused(word, version="0.1.0"):
        with pytest.raises(SystemExit, match=word):
            release.check(version)

    release.check("0.1.0")
    refused("0.2.0 is asked for, .* has 0.1.0, .* 0.1.0", "0.2.0")
    release.git("tag", "v0.1.0")
    release.check("0.1.0")  # in CI the tag is there
    for text, word in (
        ("0.2.0 (2026-12-01)", "CHANGELOG.md 0.2.0"),
        ("0.1.0 (unreleased)", "write its date"),
        ("0.1.0 (2026-12-02)", "commit"),
    ):
        (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n## {text}\n")
        refused(word)
    release.git("commit", "--quiet", "-am", "later")
    refused("never replaced")


def test_the_recipe_of_conda_asks_for_what_setup_cfg_does():
    recipe = (ROOT / "tools/packaging/recipe.yaml").read_text("utf-8")
    asked = dict(re.findall(r"(?m)^    - ([\w-]+) >=([\w.]+)", recipe.partition("  run:")[2]))
    other = {"matplotlib": "matplotlib-base", "OpenImageIO": "py-openimageio"}
    declared = dict(re.findall(r"(?m)^([\w-]+)>=([\w.]+)", CONFIG["options"]["install_requires"]))
    assert asked == {other.get(name, name): version for name, version in declared.items()}
    assert f'version: "{clsplat.__version__}"' in recipe


@pytest.mark.parametrize("name", ["Containerfile", "clsplat.def"])
def test_a_container_has_what_a_wheel_is_built_of(name):
    recipe = (ROOT / "tools/packaging" / name).read_text("utf-8")
    needed = {
        "setup.cfg",
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "clsplat",
        "cl",
        *(ROOT / "MANIFEST.in").read_text("utf-8").partition("\n")[0].split()[1:],
    }
    copied = {word for line in recipe.splitlines() if "/src/" in line for word in line.split()}
    assert needed <= copied and all((ROOT / each).exists() for each in needed)


needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")


def repository(folder, readme, **scripts):
    """A git repository with this README and these scripts in tools/."""
    (folder / "tools").mkdir(parents=True)
    (folder / "README.md").write_text(f"```\n{readme}\n```\n", encoding="utf-8")
    for name, text in scripts.items():
        (folder / "tools" / name).write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
        (folder / "tools" / name).chmod(0o755)
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "."], [*identity, "commit", "-qm", "made"]):
        subprocess.run(["git", *words], cwd=folder, check=True)


@needs_git
def test_readme_runs_in_a_bare_clone(readme, tmp_path, monkeypatch, capfd):
    """What is not committed is not there, nor what CI has set."""
    made = tmp_path / "made"
    show = 'echo given "$@" ${CI-bare} ${CLSPLAT_VENV-bare} ${PYTHONPATH-bare}; ls'
    repository(made, "tools/quickstart   # trains\ntools/test", quickstart=show, test=show)
    (made / "uncommitted").touch()
    monkeypatch.setattr(readme, "ROOT", made)
    for name in ("CI", "CLSPLAT_VENV", "PYTHONPATH"):
        monkeypatch.setenv(name, "set")
    (tmp_path / "there").mkdir()
    assert readme.main(tmp_path / "there") == 0
    said = capfd.readouterr().out
    assert "given -n 100 bare bare bare" in said and "tests/test_camera.py bare bare bare" in said
    assert (tmp_path / "there/clsplat/README.md").is_file() and "uncommitted" not in said


@needs_git
def test_a_command_of_readme_that_fails_is_named(readme, tmp_path, monkeypatch, capfd):
    repository(tmp_path / "made", "tools/test\ntouch never", test="exit 3")
    monkeypatch.setattr(readme, "ROOT", tmp_path / "made")
    assert readme.main(tmp_path) == 1
    assert "error: README: tools/test" in capfd.readouterr().out
    assert not (tmp_path / "clsplat/never").exists()


@pytest.mark.parametrize(
    "rows, passes",
    [
        (["*  0  cpu   Xeon  Intel(R) OpenCL  works"], True),
        (["   0  cpu   Xeon  Portable Computing Language  works"], False),
        (["   0  cpu   Xeon  Portable Computing Language  works", "*  1  cpu   Xeon  Intel(R) OpenCL  works"], False),
        (["*  0  cpu   Xeon  Intel(R) OpenCL  works", "   1  -     -  rusticl  does not work"], False),
        ([], False),
    ],
)
def test_a_bare_clone_must_see_one_runtime(tmp_path, rows, passes):
    """Before any test runs there."""
    for name, text in {
        ".ci/bare": (ROOT / ".ci/bare").read_text(),
        "tools/test": "echo tests $@",
        ".venv/bin/clsplat": "cat ../rows",
    }.items():
        path = tmp_path / "clone" / name
        path.parent.mkdir(parents=True)
        path.write_text(text if name == ".ci/bare" else f"#!/bin/sh\n{text}\n", encoding="utf-8")
        path.chmod(0o755)
    (tmp_path / "rows").write_text("\n".join(["   #  type", *rows, "      note", "* is auto"]))
    done = subprocess.run(
        [tmp_path / "clone/.ci/bare", "Intel(R) OpenCL", "-q"], check=False, capture_output=True, text=True
    )
    assert (done.returncode == 0, "tests -q" in done.stdout) == (passes, passes), done.stdout


def test_workers_share_what_they_compile(tmp_path, monkeypatch):
    monkeypatch.setenv("POCL_CACHE_DIR", "")
    one, other = (SharedKernels(name, tmp_path) for name in ("gw0", "gw1"))
    (one.own / "AA/kernel").mkdir(parents=True)
    (one.own / "AA/kernel/a.so").write_text("compiled")
    one.exchange()
    other.exchange()
    assert (other.own / "AA/kernel/a.so").read_text() == "compiled"
    (other.own / "AA/kernel/b.so").write_text("compiled")
    other.exchange()
    assert not (other.shared / "AA/kernel/b.so").exists()  # not for each file of tests
    other.exchange(at_once=True)
    assert sorted(path.name for path in (one.shared / "AA/kernel").iterdir()) == ["a.so", "b.so"]
