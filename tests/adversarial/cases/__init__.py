"""The hostile cases by class: each module lists CASES, and its name is their class."""

import importlib
import pkgutil

CLASSES = {name: importlib.import_module(f"{__name__}.{name}").CASES
           for _, name, _ in sorted(pkgutil.iter_modules(__path__), key=lambda entry: entry[1])}
