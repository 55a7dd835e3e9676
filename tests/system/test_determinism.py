"""Same seed, same bytes, however the device cuts its work: into groups of another size, for more or
fewer cores, in another number of runs, frames in bands of any size.

Left out, because float sums are then added in another order: the kernel form and the tile.
"""

import pytest

from clsplat.device import Device
from clsplat.rendering.blend import choose_bands
from tests.data.tiny_training import LEVELLED, model_digest, records, trained

SHORT = {"iterations": 50, "densify_until": 45, "densify_every": 10, "max_gaussians": 7000, "test_every": 0}
TAMING = {"schedule": "taming", "iterations": 80, "downscale": 4.0, "exposure": "on"}
MCMC = {"schedule": "mcmc", "iterations": 100, "downscale": 4.0}


def cut_otherwise(used, **sizes):
    """Another Device on the hardware of `used`, with these sizes in place of its own."""
    made = Device(used.handle, form=used.form)
    for name, size in sizes.items():
        assert getattr(made, name) != size
        setattr(made, name, size)
    return made


def cut_in_bands(patch, share):
    """Frames come in bands of at most that share of their pairs, or of one tile; returns how many
    bands each choice had: one for each frame that is not recorded, or that makes room."""
    numbers = []

    def chosen(counts, limit):
        assert limit == 0
        bands = choose_bands(counts, max(int(share * counts.sum()), int(counts.max())))
        numbers.append(len(bands))
        return bands

    patch.setattr("clsplat.rendering.blend.pair_limit", lambda *_: 0)
    for module in ("clsplat.rendering.blend", "clsplat.training.capacity"):
        patch.setattr(f"{module}.choose_bands", chosen)
    return numbers


def digest(folder, scene, used, **changes):
    run = trained(folder, scene, used, **changes)
    assert sum(record["split"] + record["cloned"] for record in records(run, "grow")) > 500
    return model_digest(run)


@pytest.mark.nightly
def test_many_steps(float_device, city, tmp_path, monkeypatch):
    """In smaller parts and in bands, and in larger parts."""
    first = digest(tmp_path / "first", city, float_device, **SHORT)
    small = cut_otherwise(float_device, group_size=32, scan_group=64, compute_units=1)
    with monkeypatch.context() as patch:
        numbers = cut_in_bands(patch, 0.3)
        assert digest(tmp_path / "small", city, small, **SHORT) == first
    assert 2 < min(numbers), set(numbers)
    large = cut_otherwise(float_device, group_size=256, compute_units=13, item_runs=7)
    assert digest(tmp_path / "large", city, large, **SHORT) == first


@pytest.mark.slow
@pytest.mark.parametrize("changes", [LEVELLED, TAMING, MCMC], ids=lambda changes: changes["schedule"])
@pytest.mark.one_in(3)
def test_the_whole_method(item_device, city, tmp_path, levelled, changes):
    """Levels, exposures, adjacent photos, scores, relocation and random steps."""
    first = model_digest(levelled) if changes is LEVELLED else digest(tmp_path / "first", city, item_device, **changes)
    other = cut_otherwise(item_device, group_size=32, scan_group=64, compute_units=5, item_runs=3)
    assert digest(tmp_path / "other", city, other, **changes) == first
