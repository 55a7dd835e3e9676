"""Options from a TOML file."""

import os
from pathlib import Path
from typing import Any

from clsplat.config.option import SHOWN
from clsplat.errors import InputError

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef]


def table(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read {option: value} from a TOML file, unchecked; InputError for what is no such file."""
    try:  # utf-8-sig: with the mark of Windows editors
        pairs = tomllib.loads(Path(path).read_text("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:  # also from integers of 4301 digits
        raise InputError(f"{path}: not valid TOML: {str(error)[:SHOWN]}") from None
    values = {key.replace("-", "_"): value for key, value in pairs.items()}
    if len(values) < len(pairs):
        raise InputError(f"{path}: an option is set twice, with - and with _; remove one line")
    return values
