"""Steps that were measured on a device, as a file: forecasts for it on another machine."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.records import object_of, write_object

LEAST_STEPS = 3  # for the three numbers that `cost.fitted` finds


@dataclass(frozen=True)
class MeasuredSteps:
    """Steps of a device.

    Attributes
    ----------
    device : its name.
    memory_bytes : of it.
    steps : [(pixels of the image, gaussians, seconds), ...].
    """

    device: str
    memory_bytes: int
    steps: list[tuple[float, float, float]]

    @classmethod
    def read(cls, path: Path) -> MeasuredSteps:
        """Read a file of `write`; InputError for anything else."""
        try:
            record = object_of(path.read_bytes())
            steps = [tuple(float(number) for number in step) for step in record["steps"]]
            found = cls(str(record["device"]), int(record["memory_bytes"]),
                        [(image, count, seconds) for image, count, seconds in steps])
            if not (len(steps) >= LEAST_STEPS and found.memory_bytes > 0 and all(
                    math.isfinite(number) and number > 0 for step in steps for number in step)):
                raise ValueError(f"expects {LEAST_STEPS} steps or more, and numbers above 0")
        except FileNotFoundError:
            raise InputError(f"{path}: no such file; `clsplat plan --steps-to` writes it on the "
                             "machine that has the device") from None
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: not a file of measured steps ({reason(error)}); write it "
                             "with `clsplat plan --steps-to`") from None
        return found

    def write(self, path: Path) -> None:
        """Write a file that `read` reads; InputError if that is not possible."""
        write_object(path, asdict(self))
