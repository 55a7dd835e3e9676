"""What the pages, the help and the error messages name exists: commands, options, modules, files.

Each page, help text and string of the code is searched for what stands in `backticks`, in a block
of commands, or looks like an option; every mention is checked against the command line itself and
the checkout.
"""

import ast
import configparser
import importlib.util
import re
import shlex
from functools import cache

import click
import pytest

from clsplat.cli.main import main
from clsplat.options import TrainOptions
from tests.layout import ROOT, sources

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

DOCS = sorted(
    path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "evidence"
)  # made of commands of earlier commits
# what users read: they may have no checkout
USER_PAGES = ("README.md", "CHANGELOG.md", *DOCS)
PAGES = ("CONTRIBUTING.md", *USER_PAGES)
# other programs that may be named; their options are not checked
PROGRAMS = {
    "pip",
    "python",
    "python3",
    "apt-get",
    "apt",
    "brew",
    "conda",
    "git",
    "dask",
    "colmap",
    "ruff",
    "pytest",
    "mkdocs",
    "cd",
    "wsl",
    "sbatch",
    "clinfo",
    "docker",
    "flock",
    "dnf",
    "py",
}
# options of those programs, where a message names them alone
FOREIGN_OPTIONS = {
    "--nthreads": "dask",
    "--resources": "dask",
    "--memory-limit": "dask",
    "--image_path": "colmap",
    "--input_path": "colmap",
    "--output_path": "colmap",
    "--output_type": "colmap",
    "--max_image_size": "colmap",
}
# packages that are installed or removed by hand and that setup.cfg does not name
PACKAGES = {"pocl-binary-distribution", "pip", "wheel"}
FILES = re.compile(
    r"(tools|docs|tests|cl|clsplat|data_samples|\.ci)/[\w./-]+|[A-Z]+\.md"
    r"|setup\.cfg"
)
OPTION = re.compile(r"(?<![\w/-])--[a-z][a-z0-9_-]*")
PLACEHOLDER = "X"


def mentions(page, text):
    """(where, words as in a shell) of every code span and line of commands of a Markdown page."""
    blocks, prose = [], []
    for number, part in enumerate(re.split(r"(?m)^```", text)):
        (blocks if number % 2 else prose).append(part)
    for block in blocks:
        language, _, lines = block.partition("\n")
        if language.strip() in ("", "bash", "sh", "console", "powershell"):
            for line in lines.replace("\\\n", " ").splitlines():
                yield from spoken(page, line)
    for span in re.findall(r"`([^`]+)`", " ".join(prose)):
        yield from spoken(page, " ".join(span.split()))


def spoken(where, text):
    """Each command of a line, split at pipes and the like."""
    try:
        words = shlex.split(text, comments=True)
    except ValueError:
        words = text.split()
    command = []
    for word in [*words, ";"]:
        if word in ("|", "&&", ";", "&"):
            if command:
                yield where, tuple(command)
            command = []
        else:
            command.append(word)


def strings(text):
    """(line, string, whether it is a docstring) of each string of a module; {values} are X."""
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    documented = {
        id(node.body[0].value)
        for node in nodes
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    inside = {id(piece) for node in nodes if isinstance(node, ast.JoinedStr) for piece in node.values}
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            yield (
                node.lineno,
                "".join(piece.value if isinstance(piece, ast.Constant) else PLACEHOLDER for piece in node.values),
                False,
            )
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inside:
            yield node.lineno, node.value, id(node) in documented


def help_texts():
    """(command, text) of every text that `--help` shows."""
    yield "clsplat", main.help
    for name, command in main.commands.items():
        yield f"clsplat {name}", command.help or ""
        for param in command.params:
            yield f"clsplat {name} {param.name}", getattr(param, "help", None) or ""


@cache
def options_of(name):
    """{flag: click.Option} of a command, or of all where `name` is None."""
    commands = [main.commands[name]] if name else [main, *main.commands.values()]
    found = {"--help": None, "-h": None, "--version": None}
    for command in commands:
        for param in command.params:
            if isinstance(param, click.Option):
                found |= dict.fromkeys((*param.opts, *param.secondary_opts), param)
    return found


@cache
def tools_text():
    """All code that parses options of its own."""
    return "".join(path.read_text("utf-8") for _, path in sources(ROOT, "tools", "tests"))


@cache
def package_text():
    return "".join(path.read_text("utf-8") for _, path in sources(ROOT, "clsplat", "tools", "cl"))


def untrue(words, users):
    """Why a mention is not so, or ""; users: those who read it may have no checkout."""
    words = list(words)
    while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
        words.pop(0)
    if not words:
        return ""
    program = words[0].removeprefix("./")
    if program == "clsplat":
        return untrue_command(words[1:])
    if program in ("python", "python3") and "-m" in words[:-1]:
        return untrue_module(words[words.index("-m") + 1 :], users)
    if program == "pip":
        return untrue_packages(words)
    if program in PROGRAMS:
        return ""
    if program.startswith("--"):
        return next(filter(None, (untrue_option(word, users) for word in words)), "")
    return untrue_file(program)


def untrue_command(words):
    if not words or not re.fullmatch(r"[a-z][a-z-]*", words[0]):
        return untrue_flags(None, words)
    if (two := " ".join(words[:2])) in main.commands:
        return untrue_flags(two, words[2:])
    if words[0] not in main.commands:
        return f"there is no command `clsplat {words[0]}`"
    return untrue_flags(words[0], words[1:])


def untrue_flags(name, words):
    known = options_of(name)
    for index, word in enumerate(words):
        if not re.match(r"--?[a-zA-Z]", word):
            continue
        flag, _, value = word.partition("=")
        flag = flag.rstrip(",.;")
        if flag not in known:
            return f"`clsplat {name or ''}` has no option {flag}"
        choices = getattr(getattr(known[flag], "type", None), "choices", ())
        value = value or (words[index + 1] if index + 1 < len(words) else "")
        if choices and re.fullmatch(r"[a-z]+", value) and value not in choices:
            return f"`clsplat {name}` {flag}: {value} is none of {', '.join(choices)}"
    return ""


def untrue_module(words, users):
    module = words[0]
    if module.split(".")[0] not in ("clsplat", "tools", "tests"):
        return ""  # pip, venv, dask
    if users and not module.startswith(("clsplat", "tools.synth")):  # pages say: in a checkout
        return f"`python -m {module}`: an installed clsplat has no such module"
    if importlib.util.find_spec(module) is None:
        return f"there is no module {module}"
    return next(
        (
            f"{module} has no option {word}"
            for word in words[1:]
            if OPTION.fullmatch(word) and untrue_option(word, False)
        ),
        "",
    )


def untrue_option(word, users):
    flag = word.partition("=")[0].rstrip(",.;:")
    if not OPTION.fullmatch(flag) or flag in options_of(None) or flag in FOREIGN_OPTIONS:
        return ""
    if not users and (f'"{flag}"' in tools_text() or re.search(rf"\b{flag[2:].replace('-', '_')}=", tools_text())):
        return ""
    return f"no command has the option {flag}"


def untrue_packages(words):
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    extras = dict(config["options.extras_require"])
    named = {
        re.match(r"[\w-]+", line)[0].lower()
        for line in "\n".join([config["options"]["install_requires"], *extras.values()]).splitlines()
        if line.strip()
    }
    for word in words[2:]:
        name, _, extra = word.rstrip("]").partition("[")
        if word.startswith("-"):
            continue
        if extra and not set(extra.split(",")) <= set(extras):
            return f"setup.cfg has no extra [{extra}]"
        if name == "clsplat":
            return f"`{' '.join(words)}`: clsplat is not on PyPI"
        if name not in (".", "CLSPLAT") and name.lower() not in named | PACKAGES:
            return f"`{' '.join(words)}`: setup.cfg does not know {name}"
    return ""


def untrue_file(word):
    if FILES.fullmatch(word) and not (ROOT / word.rstrip("/")).exists():
        return f"there is no file {word}"
    return ""


def lies(where, text, users):
    """Lines about the mentions of a page or a text of prose that are not so."""
    for place, words in mentions(where, text):
        said = untrue(words, users)
        if said:
            yield f"{place}: {said}"


@pytest.mark.parametrize("page", PAGES)
def test_pages(page):
    text = (ROOT / page).read_text("utf-8")
    found = list(lies(page, text, users=page in USER_PAGES))
    links = re.findall(r"\]\(([^)#\s]+)", text)
    found += [
        f"{page}: there is no file {link}"
        for link in links
        if not re.match(r"https?:", link) and not ((ROOT / page).parent / link).exists()
    ]
    found += [
        f"{page}: nothing reads the variable {name}"
        for name in set(re.findall(r"CLSPLAT_[A-Z_]+", text))
        if name not in package_text() + tools_text() + shell_text()
    ]
    assert not found, "\n".join(found)


def shell_text():
    return "".join(
        (ROOT / name).read_text("utf-8")
        for name in ("tools/install", "tools/test", "tools/quickstart", ".ci/steps", ".ci/run", ".ci/nightly")
    )


def test_help():
    found = [line for where, text in help_texts() for line in lies(where, text, users=True)]
    found += [
        f"{where}: {said}"
        for where, text in help_texts()
        for said in (untrue_option(flag, True) for flag in OPTION.findall(text))
        if said
    ]
    assert not found, "\n".join(found)


def test_messages():
    """And every other string of the package; docstrings may name what only a checkout has."""
    found = []
    for path, file in sources(ROOT, "clsplat"):
        for line, text, documents in strings(file.read_text("utf-8")):
            place = f"{path}:{line}"
            found += lies(place, text, users=not documents)
            # a word alone is one for git; what has var(--...) is a style sheet
            for flag in OPTION.findall(text) if " " in text and "var(--" not in text else ():
                said = untrue_option(flag, users=not documents)
                found += [f"{place}: {said}"] if said else []
            if text.startswith("clsplat "):
                said = untrue(text.split(), users=True)
                found += [f"{place}: {said}"] if said else []
    assert not found, "\n".join(found)


def test_files_of_a_run():
    """The guide's table of a run names files that the code writes."""
    text = (ROOT / "docs/guide/files.md").read_text("utf-8")
    section = text.partition("\n## The run folder\n")[2].partition("\n## ")[0]
    names = re.findall(r"(?m)^\| `([^`]+)` \|", section)
    assert len(names) > 4
    missing = [name for name in names if f'"{name.rstrip("/")}"' not in package_text()]
    assert not missing


def test_settings():
    """The keys of every TOML block are options of a training."""
    for page in PAGES:
        for block in re.findall(r"(?ms)^```toml\n(.*?)^```", (ROOT / page).read_text("utf-8")):
            for key in tomllib.loads(block):
                assert key.replace("-", "_") in TrainOptions.__dataclass_fields__, (page, key)


@pytest.mark.parametrize(
    "text, said",
    [
        ("make one with `clsplat nothing`", "no command `clsplat nothing`"),
        ("`clsplat train --nothing`", "no option --nothing"),
        ("`clsplat train S --schedule fast`", "fast is none of"),
        ("`--nothing`", "no command has the option"),
        ("`python -m tools.pack SCENE`", "an installed clsplat has no such module"),
        ("`python -m clsplat.nothing`", "no module"),
        ("`tools/nothing`", "no file tools/nothing"),
        ("`pip install 'clsplat[cpu]'`", "not on PyPI"),
        ("`pip install '.[nothing]'`", "no extra"),
        ("`pip install nothing`", "does not know nothing"),
        ("```\ncd x && clsplat trian S\n```", "no command `clsplat trian`"),
    ],
)
def test_what_is_untrue_is_noticed(text, said):
    (line,) = lies("page", text, users=True)
    assert said in line


@pytest.mark.parametrize(
    "text",
    [
        "`clsplat train SCENE -n 10 --schedule sig -o out/run`",
        "`--no-antialiased`",
        "`tools/test`",
        "`CLSPLAT_DEVICE=0 dask worker tcp://x --nthreads 1`",
        "`pip install '.[cpu]'`",
        "`clsplat bench SCENE --profile`",
        "`x < 3`",
        "`--levels 4,2,1`",
    ],
)
def test_what_is_true_passes(text):
    assert not list(lies("page", text, users=True))
