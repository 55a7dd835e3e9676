"""What mkdocs.yml cannot say: the folder of the pages, no assets of others, our docstrings.

mkdocs calls the functions, and griffe, which reads the docstrings, the class.
"""

import logging
import re
from pathlib import Path

import griffe

LOG = logging.getLogger("mkdocs.hooks")
FOREIGN = re.compile(r"<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
HEADING = re.compile(r"^(\w+)\n-+\n", re.MULTILINE)
ITEM = re.compile(r"^(\S[^:\n]*?) : ", re.MULTILINE)


def on_config(config):
    """Pages are all of docs/: guide and notebook."""
    config.docs_dir = str(Path(config.config_file_path).parent)
    return config


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
