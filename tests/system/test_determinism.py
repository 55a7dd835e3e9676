"""Same seed, same bytes, however the device cuts its work: into groups of another size, for more or
fewer cores, in another number of runs.

Left out, because float sums are then added in another order: the kernel form and the tile; the
group of a tree of sums (`Device.scan_group`, in reduce.cl and exposure.cl) with exposures, Taming's
scores or levels by frequency; `group_size` in the group form with depth regularisation, where a
group adds up a row of pixels, or levels by frequency, where an item adds up its own gaussians. A
device's own sizes do not change, so the same run on it has the same bytes.
"""

import pytest

from clsplat.device import Device, device
from tests.tiny_training import LEVELLED, model_digest, records, trained

LONG = {"iterations": 500, "densify_until": 400, "densify_every": 40, "max_gaussians": 7000,
        "test_every": 0}


def cut_otherwise(used, **sizes):
    """Another Device on the hardware of `used`, with these sizes in place of its own."""
    made = Device(used.handle, form=used.form)
    for name, size in sizes.items():
        assert getattr(made, name) != size
        setattr(made, name, size)
    return made


def digest(folder, scene, used, **changes):
    run = trained(folder, scene, used, **changes)
    assert sum(record["split"] + record["cloned"] for record in records(run, "grow")) > 500
    return model_digest(run)


@pytest.mark.slow
def test_500_steps(float_device, city, tmp_path, monkeypatch):
    """The same again, and with other sizes."""
    first = digest(tmp_path / "first", city, float_device, **LONG)
    assert digest(tmp_path / "again", city, float_device, **LONG) == first
    small = cut_otherwise(float_device, group_size=32, scan_group=64, compute_units=1)
    assert digest(tmp_path / "small", city, small, **LONG) == first
    large = cut_otherwise(float_device, group_size=256, compute_units=13)
    monkeypatch.setattr(device, "RUNS_A_CORE", 7)
    assert digest(tmp_path / "large", city, large, **LONG) == first


@pytest.mark.slow
def test_the_whole_method(item_device, city, levelled, tmp_path, monkeypatch):
    """Levels, exposures and adjacent photos: see above for the sizes that may not change."""
    monkeypatch.setattr(device, "RUNS_A_CORE", 3)
    other = cut_otherwise(item_device, group_size=32, compute_units=5)
    assert digest(tmp_path / "run", city, other, **LEVELLED) == model_digest(levelled)
