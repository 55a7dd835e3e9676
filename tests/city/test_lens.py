"""`clsplat city` of photos with lens distortion, masks and a depth map, from scene to report."""

import numpy as np
import pytest

from clsplat.cli.main import main
from clsplat.evaluation.run import Run
from clsplat.io.photos.depth import read_depth, with_depths
from clsplat.io.photos.views import read_valid
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from tests.city.test_city import FLAGS
from tests.data.lens_city import MASKED_EVERY, write_lens_city
from tools.synth.city import lay_out
from tools.synth.raycast import cast

SURVEYED = "010.jpg"  # a photo that the second block alone has


@pytest.mark.slow
def test_a_city_of_lenses_masks_and_a_depth_map(tmp_path):
    scene = write_lens_city(tmp_path / "survey", lambda view: view.name == SURVEYED)
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "city",
                str(scene),
                "-o",
                str(tmp_path / "city"),
                "-q",
                *FLAGS,
                "-n",
                "30",
                "-r",
                "2",
                "--depth",
                "depth",
                "--threshold",
                "0.1",
            ]
        )
    assert ended.value.code == 0
    city = CityFolder(tmp_path / "city")
    last = [record for record in RunFolder.open(city.path).records() if record["event"] == "eval"][-1]
    assert last["views"] == 4 and last["psnr"] > 14

    first, second = city.blocks()
    assert first.read()["options"]["depth"] == "" and second.read()["options"]["depth"] == "depth"
    for block in (first, second):
        for view in read_scene(block.path).views:
            assert view.lens is None and view.source.is_symlink()
            assert (view.mask is not None) == (int(view.name[:3]) % MASKED_EVERY == 0)
    known = with_depths(read_scene(second.path), "depth")
    (view,) = (view for view in known.views if view.depth)
    check_depth(view, known.offset)

    views = Run.open(city.path).scene().views  # an evaluation uses the city's files
    assert all(view.lens is None and view.source.parent == city.undistorted for view in views)
    shares = [1.0 if valid is None else valid.mean() for valid in map(read_valid, views)]
    assert all((share < 0.9) == (number % MASKED_EVERY == 0) for number, share in enumerate(shares)), shares


def check_depth(view, offset):
    """Check the depth map of a part of an undistorted photo against the sample's true surfaces."""
    camera = view.camera
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    points, _ = cast(lay_out((2, 2), 0), camera.shifted(-offset), np.stack([x.ravel(), y.ravel()], axis=1))
    true = camera.project(points - offset)[1].reshape(x.shape)
    found = read_depth(view)
    error = np.abs(found / true - 1)[found > 0]
    assert (found > 0).mean() > 0.95 and np.median(error) < 0.01, np.quantile(error, [0.5, 0.9])
