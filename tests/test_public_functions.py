"""Every public function of the package has types and a docstring."""

import ast

import pytest

from tests.test_layout import ROOT, sources


def public_functions(tree, inside=()):
    """(name, node) of the functions and methods without a leading underscore, and of __init__."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node, (*inside, node.name))
        elif isinstance(node, ast.FunctionDef) and (
                node.name == "__init__" or not node.name.startswith("_")):
            yield ".".join((*inside, node.name)), node, bool(inside)


def lacking(name, node, is_method):
    """What a public function lacks: words for a message."""
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    static = any(ast.unparse(word) == "staticmethod" for word in node.decorator_list)
    for argument in arguments[is_method and not static:]:
        if argument.annotation is None:
            yield f"{name}: its argument '{argument.arg}' has no type"
    if node.returns is None and node.name != "__init__":
        yield f"{name}: what it returns has no type"
    if not ast.get_docstring(node) and node.name != "__init__":
        yield f"{name}: has no docstring"


def all_lacking(root):
    """A line for each thing that a public function of clsplat/ lacks."""
    for path_name, path in sources(root, "clsplat"):
        for name, node, is_method in public_functions(ast.parse(path.read_text("utf-8"))):
            for text in lacking(name, node, is_method):
                yield f"{path_name}:{node.lineno}: {text}"


def test_public_functions_have_types_and_docstrings():
    found = list(all_lacking(ROOT))
    assert not found, "\n" + "\n".join(found)


@pytest.mark.parametrize("source, complaint", [
    ("def read(path) -> int:\n    'Read.'", "its argument 'path' has no type"),
    ("def read(path: str):\n    'Read.'", "what it returns has no type"),
    ("def read(path: str) -> int:\n    return 1", "has no docstring"),
    ("class Scene:\n    def read(self, path) -> int:\n        'Read.'", "Scene.read: its argument"),
    ("class Scene:\n    def __init__(self, path): ...", "Scene.__init__: its argument 'path'"),
])
def test_what_lacks_is_noticed(tmp_path, source, complaint):
    (tmp_path / "clsplat").mkdir()
    (tmp_path / "clsplat/scene.py").write_text(source)
    assert any(complaint in line for line in all_lacking(tmp_path))


@pytest.mark.parametrize("source", [
    "def _read(path): ...", "class _Scene:\n    def read(self, path): ...",
    "class Scene:\n    def __init__(self): ...\n    def read(self) -> int:\n        'Read.'"])
def test_what_is_private_or_whole_passes(tmp_path, source):
    (tmp_path / "clsplat").mkdir()
    (tmp_path / "clsplat/scene.py").write_text(source)
    assert list(all_lacking(tmp_path)) == []
