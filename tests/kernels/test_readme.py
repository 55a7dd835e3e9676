"""cl/README.md lists every kernel as it is declared; `python -m tests.kernels.test_readme` prints
its table. Lines of kernels are short."""

import importlib

from clsplat.device import Either, Kernel
from tests.layout import ROOT, families, homes


def table():
    """A row a kernel: its arrays and its launches, as the module of its family declares them."""
    lines = ["| family | kernel | arrays | item form | group form |", "|---|---|---|---|---|"]
    for family in families(ROOT):
        (home,) = homes(ROOT, family.stem)
        module = importlib.import_module(home.removesuffix(".py").replace("/", "."))
        for kernel in vars(module).values():
            if isinstance(kernel, Kernel):
                arrays = {
                    name: a
                    for form in kernel.forms
                    if form
                    for name, a in form.arguments.items()
                    if isinstance(a, tuple)
                }
                shown = ", ".join(
                    f"{name} {kind}[{', '.join(map(str, shape))}]" + note(kernel, name)
                    for name, (kind, *shape) in arrays.items()
                )
                item, group = kernel.launches
                forms = shape_of(item), "the same" if item == group else shape_of(group)
                lines.append(f"| {family.stem} | {kernel.function} | {shown} | {' | '.join(forms)} |")
    return "\n".join(lines) + "\n"


def note(kernel, name):
    """In which builds an argument is there, or has another type."""
    if name in kernel.only:
        return f" ({kernel.only[name]})"
    argument = kernel.arguments.get(name)
    return f" ({argument.argument[0]} with {argument.define})" if isinstance(argument, Either) else ""


def shape_of(launch):
    """Over what a form runs."""
    if launch is None:
        return "none"
    units, group = (" × ".join(text.split()) for text in (launch.units, launch.group))
    if launch.kind == "items":
        return f"{units} items" + f", groups of {group}" * (group != "1")
    return f"each of {units}" if launch.kind == "each" else f"{units} groups of {group}"


def test_the_page_lists_every_kernel():
    assert (ROOT / "cl/README.md").read_text("utf-8").endswith("\n" + table())


def test_lines_are_as_short_as_those_that_ruff_measures():
    assert not [
        f"{path.name}: {line}"
        for path in (ROOT / "cl").rglob("*")
        if path.suffix in (".cl", ".h")
        for line in path.read_text("utf-8").splitlines()
        if len(line) > 100
    ]


if __name__ == "__main__":
    print(table(), end="")
