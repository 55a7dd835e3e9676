"""The memory of a large map does not grow with it."""

import subprocess
import sys

import pytest

LIMIT_MIB = 768  # 600 are taken; the two rasters alone are 288
PROGRAM = """
import sys
from pathlib import Path
from clsplat.cli.progress import Progress
from clsplat.device import choose_device
from clsplat.apps.map import write_map
from clsplat.apps.map_grid import map_grid
from tests.data import ground_model as made
from tests.apps.test_map import run_of

scene, folder = made.scene(None), Path(sys.argv[1])
grid = map_grid(scene, 2.99 * made.SIDE / int(sys.argv[2]) * 2 / 3)
assert min(grid.columns, grid.rows) > 0.98 * int(sys.argv[2])
write_map(run_of(folder, scene), scene, grid, choose_device("auto"), folder)
# getrusage would count the peak of the process that started this one as well
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(float(status["VmHWM"].split()[0]) / 1024)
"""


@pytest.mark.nightly
def test_a_map_of_6000_by_6000_pixels(tmp_path):
    for side in (200, 6000):  # the first compiles the kernels, which some compilers need more for
        folder = tmp_path / str(side)
        folder.mkdir()
        done = subprocess.run([sys.executable, "-c", PROGRAM, str(folder), str(side)],
                              capture_output=True, text=True, timeout=1800, check=False)
        assert done.returncode == 0, done.stderr
    assert float(done.stdout) < LIMIT_MIB
    assert (folder / "orthophoto.tif").stat().st_size < 200e6
