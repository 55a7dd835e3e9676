"""Options from a TOML file."""

import os
from typing import Any

from clsplat.config.option import SHOWN
from clsplat.errors import InputError

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef]

MOST_BYTES = 1 << 20  # in a file


def table(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read {option: value} from a TOML file, unchecked; InputError for what is no such file."""
    try:
        if os.path.exists(path) and not os.path.isfile(path):
            raise InputError(f"{path}: cannot be read (it is not a file); give a TOML file of "
                             "options")
        with open(path, "rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise InputError(f"{path}: is larger than {MOST_BYTES >> 20} MiB; give a TOML file "
                             "of options, such as iterations = 7000")
        pairs = tomllib.loads(data.decode("utf-8-sig"))  # with the mark of Windows editors
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:  # also from integers of 4301 digits
        raise InputError(f"{path}: not valid TOML: {str(error)[:SHOWN]}") from None
    values: dict[str, Any] = {}
    for key, value in pairs.items():
        name = key.replace("-", "_")
        if name in values:
            raise InputError(f"{path}: option '{name}' is set twice; remove one of the two lines")
        values[name] = value
    return values
