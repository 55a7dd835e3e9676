"""python -m clsplat.distribute.probe: exit code 2, and one line that says why, without a device."""

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
