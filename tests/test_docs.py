"""Every page of docs/ is reachable, and what it lists is what there is; `.ci/run` builds them."""

import importlib.util
import re

import pytest

import clsplat
from clsplat.cli.main import main
from tests.data.tiny_training import CITY
from tests.layout import ROOT
from tests.test_sentences import package_text

DOCS = ROOT / "docs"
SETTINGS = (DOCS / "mkdocs.yml").read_text("utf-8")
SHOWN = re.compile(r'(?m)^--8<-- "(.*)"$')


def page(name):
    return (DOCS / "guide" / name).read_text("utf-8")


def test_every_page_is_in_the_navigation():
    listed = re.findall(r"(?m)^ +- [^:\n]+: (\S+\.md)$", SETTINGS.partition("\nnav:\n")[2])
    there = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert len(listed) == len(set(listed)) and set(listed) == there
    linked = re.findall(r"\(((?:guide/|evidence/|design)[^)#]+)\)", (DOCS / "index.md").read_text("utf-8"))
    assert sorted(linked) == sorted(there - {"index.md"})


def pictures(folder):
    return [path for path in folder.rglob("*") if path.suffix in (".png", ".jpg", ".gif", ".webp", ".svg")]


def test_every_picture_is_small_and_shown_with_words():
    shown = {
        (path.parent / name).resolve()
        for path in (ROOT / "README.md", *DOCS.rglob("*.md"))
        for name in re.findall(r"!\[[^\]]{10,}\]\(([^)]+)\)", path.read_text("utf-8"))
    }
    assert shown == set(pictures(DOCS))
    guide = [path.stat().st_size for path in pictures(DOCS / "guide")]
    assert max(guide) <= 150_000 and sum(guide) <= 1_200_000
    assert sum(path.stat().st_size for path in pictures(DOCS)) <= 5_000_000


def test_the_page_of_the_design_names_files_that_are_there():
    texts = [
        (DOCS / "design.md").read_text("utf-8"),
        *(path.read_text("utf-8") for path in sorted((DOCS / "pictures").glob("*.svg"))),
    ]
    names = set(re.findall(r"(?<![\w/.])((?:\w+/)+\w+\.(?:py|cl))\b", " ".join(texts)))
    assert len(names) > 40
    places = (ROOT / "clsplat", ROOT / "clsplat" / "training", ROOT)
    assert not [name for name in names if not any((place / name).exists() for place in places)]


def test_readme_begins_with_one_line_for_each_of_its_two_jobs_and_has_no_placeholder():
    text = (ROOT / "README.md").read_text("utf-8")
    blocks = re.findall(r"(?ms)^```\w*\n(.*?)^```", text)
    assert [line.split("#")[0].strip() for line in blocks[0].splitlines()] == ["tools/quickstart", "tools/test"]
    assert not re.search(r"\b[A-Z]{3,}\b", "".join(blocks)), "a word to be replaced"


def test_the_search_works_from_a_disk_without_the_network():
    """The plugin `offline` takes a shim of this name in place of one from the network."""
    assert re.search(r"(?m)^  - offline\b", SETTINGS)
    (shim,) = re.findall(r"polyfills: \[(\S*iframe-worker\S*)\]", SETTINGS)
    assert "window.Worker=" in (DOCS / shim).read_text("utf-8")


def test_the_reference_is_of_the_public_names():
    named = re.findall(r"(?m)^::: clsplat\.(\w+)$", page("api.md"))
    assert sorted(named) == sorted(clsplat.__all__)


def test_examples_shown_are_the_files_that_tests_run():
    blocks = re.findall(r"(?ms)^```python\n(.*?)^```", page("python.md") + page("photos.md"))
    shown = [found[1] for block in blocks if (found := SHOWN.fullmatch(block.strip()))]
    assert sorted(shown) == sorted(path.name for path in (DOCS / "examples").glob("*.py"))
    tests = "".join(path.read_text("utf-8") for path in ROOT.glob("tests/**/test_*.py"))
    assert all(re.search(rf'["/]{name}"', tests) for name in shown)


def test_files_md_names_every_key_of_the_metrics(item_device, tmp_path):
    options = clsplat.TrainOptions(iterations=60, downscale=8, densify_from=10, densify_every=20, schedule="constant")
    run = clsplat.train(CITY, options, output=tmp_path / "run", device=item_device)
    said = set(re.findall(r"`(\w+)`", page("files.md").partition("## metrics.jsonl")[2]))
    events = {record["event"] for record in run.metrics}
    assert {"plan", "step", "grow", "eval"} <= events <= said
    assert {key for record in run.metrics for key in record} <= said
    table = page("files.md").partition("| event | when |")[2].partition("\n\n")[0]
    for event in re.findall(r"`(\w+)`", " ".join(re.findall(r"(?m)^\|([^|]+)\|", table))):
        assert re.search(rf'(log\(|"event": |name = )"{event}"', package_text()), event


def loaded_hooks():
    pytest.importorskip("griffe", reason="setup.cfg's extra docs is not installed")
    spec = importlib.util.spec_from_file_location("hooks", DOCS / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    return hooks


def test_the_page_of_commands_has_every_option():
    hooks = loaded_hooks()
    text = hooks.commands()
    assert hooks.COMMANDS in page("commands.md")
    for name, command in main.commands.items():
        part = text.partition(f"### clsplat {name}\n")[2].partition("\n### ")[0]
        flags = [flag for param in command.params for flag in param.opts if flag.startswith("-")]
        assert flags and not [flag for flag in flags if not re.search(rf"`[^`]*{flag}\b", part)]
