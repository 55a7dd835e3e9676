"""A page of a trained run shows the colours of our renderer."""

import pytest

from clsplat.evaluation.run import Run
from tests.apps.browser import needs_chromium
from tests.apps.fidelity import fidelity
from tests.data.tiny_training import CITY
from tests.estimate.test_plan import clsplat_

ENOUGH = 52.0  # dB; measured 55.7 to 56.1, and 48.1 to 49.0 where each layer is rounded to 8 bits


@pytest.mark.slow
@needs_chromium
def test_a_page_has_the_colours_of_the_render(tmp_path, item_device):
    result = clsplat_("train", CITY, "-n", "400", "-r", "2", "-q", "-o", tmp_path / "run")
    assert result.exit_code == 0, result.output
    found = fidelity(Run.open(tmp_path / "run"), item_device, tmp_path, most=2)
    assert len(found) == 2
    for each in found:
        assert each.psnr >= ENOUGH and abs(each.mean) < 0.2, each
