"""Reports from the records of runs: a page for each run, and comparisons of several.

This is the only package that imports matplotlib.
"""

import os

from clsplat.errors import InputError

# matplotlib cannot be imported if this variable names an unknown backend; nothing here opens a
# window, so the choice does not matter
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
