"""Parts of a training that other packages register as entry points (training/part.py)."""

from dataclasses import dataclass

from clsplat.config.option import option
from clsplat.config.plug_in import Group

REGISTERED = Group("clsplat.parts", "part", "clsplat.Part")  # NAME = MODULE:SUBCLASS_OF_PART


def _check_names(names: tuple[str, ...]) -> None:
    if unknown := [name for name in names if name not in REGISTERED.others]:
        known = ", ".join(REGISTERED.others) or "nothing"
        raise ValueError(f"names of parts that packages of this environment register ({known}), "
                         f"not {unknown[0]!r}")


@dataclass(frozen=True)
class PartOptions:
    """Parts of other packages; their own options are in their files."""

    add_parts: tuple[str, ...] = option((), "Run", "parts of other packages that the training has "
                                    "besides, such as a term of the loss", words={"none": ()},
                                    check=_check_names, flag=False)
