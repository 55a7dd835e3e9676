"""What the records of runs say: a page for each run, and comparisons of several.

The only package that imports matplotlib.
"""

import os

from clsplat.errors import InputError

# matplotlib refuses to be imported where this names no backend that it knows; nothing here opens a
# window, so that the choice is of no use
_backend = os.environ.pop("MPLBACKEND", None)
try:
    import matplotlib  # noqa: F401  (here first, for all modules of the package)
except (OSError, ValueError) as error:
    raise InputError(f"matplotlib cannot be imported ({error}); repair or remove its settings, the "
                     "file matplotlibrc, and let it write to the folder that MPLCONFIGDIR names"
                     ) from None
finally:
    if _backend is not None:
        os.environ["MPLBACKEND"] = _backend
