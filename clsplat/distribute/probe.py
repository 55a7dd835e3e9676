"""python -m clsplat.distribute.probe: check that this machine has a working OpenCL device.

Without one it prints the reason in one line, and its exit code is 2.
"""

import os
import sys

from clsplat.device import choose_device
from clsplat.errors import DeviceError

if __name__ == "__main__":
    try:
        choose_device(os.environ.get("CLSPLAT_DEVICE", "auto"))
    except DeviceError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
