"""The command line: each command has a file, which parses, calls and prints.

This is the only package that imports click. Commands import what they run inside their function, so
that `clsplat --help` does not wait for numpy, pycolmap or an OpenCL driver.
"""

import time

STARTED = time.perf_counter()  # when the command began, before all imports but Python's own
