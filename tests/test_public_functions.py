"""Every public function of the package has types and a docstring, its own or an inherited one."""

import ast

import pytest

from tests.layout import ROOT, parsed, sources


def public_functions(tree, inside=()):
    """(name, node) of the functions and methods without a leading underscore, and of __init__."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node, (*inside, node.name))
        elif isinstance(node, ast.FunctionDef) and (node.name == "__init__" or not node.name.startswith("_")):
            yield ".".join((*inside, node.name)), node, bool(inside)


def documented(classes, name):
    """The methods of a class that it or one of its base classes documents."""
    if name not in classes:
        return set()
    own = {each.name for each in classes[name].body if isinstance(each, ast.FunctionDef) and ast.get_docstring(each)}
    return own.union(*(documented(classes, ast.unparse(base)) for base in classes[name].bases))


def lacking(name, node, is_method, classes):
    """What a public function lacks: words for a message."""
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    static = any(ast.unparse(word) == "staticmethod" for word in node.decorator_list)
    for argument in arguments[is_method and not static :]:
        if argument.annotation is None:
            yield f"{name}: its argument '{argument.arg}' has no type"
    if node.returns is None and node.name != "__init__":
        yield f"{name}: what it returns has no type"
    if (
        not ast.get_docstring(node)
        and node.name != "__init__"
        and (not is_method or node.name not in documented(classes, name.split(".")[-2]))
    ):
        yield f"{name}: has no docstring"


def all_lacking(root):
    """A line for each thing that a public function of clsplat/ lacks."""
    trees = {name: parsed(path) for name, path in sources(root, "clsplat")}
    classes = {node.name: node for tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef)}
    for path_name, tree in trees.items():
        for name, node, is_method in public_functions(tree):
            for text in lacking(name, node, is_method, classes):
                yield f"{path_name}:{node.lineno}: {text}"


def test_public_functions_have_types_and_docstrings():
    found = list(all_lacking(ROOT))
    assert not found, "\n" + "\n".join(found)


@pytest.mark.parametrize(
    "source, complaint",
    [
        ("def read(path) -> int:\n    'Read.'", "its argument 'path' has no type"),
        ("def read(path: str):\n    'Read.'", "what it returns has no type"),
        ("def read(path: str) -> int:\n    return 1", "has no docstring"),
        ("class Scene:\n    def read(self, path) -> int:\n        'Read.'", "Scene.read: its argument"),
        ("class Scene:\n    def __init__(self, path): ...", "Scene.__init__: its argument 'path'"),
    ],
)
def test_what_lacks_is_noticed(tmp_path, source, complaint):
    (tmp_path / "clsplat").mkdir()
    (tmp_path / "clsplat/scene.py").write_text(source)
    assert any(complaint in line for line in all_lacking(tmp_path))
