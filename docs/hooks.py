"""What mkdocs.yml cannot say: folder, version, commands, no assets of others, our docstrings.

mkdocs calls the functions, and griffe, which reads the docstrings, the class.
"""

import inspect
import logging
import re
from importlib import import_module
from pathlib import Path

import click
import griffe

from clsplat import __version__
from clsplat.cli.main import main

LOG = logging.getLogger("mkdocs.hooks")
FOREIGN = re.compile(r"<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
HEADING = re.compile(r"^(\w+)\n-+\n", re.MULTILINE)
ITEM = re.compile(r"^(\S[^:\n]*?) : ", re.MULTILINE)
COMMANDS = "<!-- commands -->"  # a page has them in its place


def on_config(config):
    """Pages are all of docs/, guide and evidence, and their head names the version."""
    config.docs_dir = str(Path(config.config_file_path).parent)
    config.site_name = f"clsplat {__version__}"
    return config


def on_page_markdown(markdown, page, config, files):
    """The guide comes before the evidence in a search; one page has the commands."""
    if page.file.src_uri.startswith("evidence/"):
        page.meta["search"] = {"boost": 0.001}  # a word in a heading counts a thousandfold
    return markdown.replace(COMMANDS, commands()) if COMMANDS in markdown else markdown


def commands():
    """Every command with every option, under the headings of the help."""
    lines = []
    for heading, names in main.sections.items():
        lines += [f"## {heading}", *(text for name in names for text in described(name))]
    return "\n\n".join(lines)


def described(name):
    """Paragraphs and tables about a command."""
    command = main.commands[name]
    context = click.Context(command, info_name=f"clsplat {name}")
    yield f"### clsplat {name}"
    yield f"    {' '.join([context.command_path, *command.collect_usage_pieces(context)])}"
    yield inspect.cleandoc(command.help)
    tables = {}
    for param in command.get_params(context):
        if record := isinstance(param, click.Option) and param.get_help_record(context):
            tables.setdefault(getattr(param, "section", "Other"), []).append(record)
    for heading in sorted(tables, key="Other".__eq__):
        rows = (f"| `{flags}` | {meaning} |" for flags, meaning in tables[heading])
        yield "\n".join([f"| {heading} | |", "|---|---|", *rows])


def on_page_content(html, page, config, files):
    """No line ends within an option."""
    return FLAG.sub(r'<span class="flag">\g<0></span>', html)


def on_post_page(output, page, config):
    """A page that would load something from the network is a warning, and fails `--strict`."""
    for asset in FOREIGN.findall(output):
        LOG.warning("%s loads %s", page.file.src_uri, asset)
    return output


class OneLineItems(griffe.Extension):
    """Our docstrings have the meaning after `name : `, where numpydoc has the type; griffe takes
    types from the signature."""

    def on_object(self, *, obj, **others):
        """Rewrite the docstring of a module, class, function or attribute."""
        if obj.is_class and obj.docstring is None:  # `__doc__ = noun.__doc__` of clsplat.api
            text = inspect.getdoc(getattr(import_module(obj.module.path), obj.name, None))
            obj.docstring = text and griffe.Docstring(text, parent=obj)
        if obj.docstring is not None:
            obj.docstring.value = numpydoc(obj.docstring.value)


def numpydoc(text):
    """A docstring with the meaning of each item below its name, and below nothing for Returns."""
    head, *sections = HEADING.split(text)
    for name, body in zip(sections[::2], sections[1::2]):
        if name == "Returns":
            body = f" :\n    {' '.join(body.split())}\n\n"
        head += f"{name}\n{'-' * len(name)}\n" + ITEM.sub(r"\1\n    ", body)
    return head
