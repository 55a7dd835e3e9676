"""The last evaluation of a training, which has time for more metrics."""

import pytest

from clsplat.errors import InputError
from clsplat.io.scenes import read_scene
from tests.data.tiny_training import CITY, STILL, resumed, trained
from tests.evaluation.test_lpips import NETWORK

SHORT = {**STILL, "iterations": 6, "eval_every": 3}


@pytest.fixture(scope="module")
def city():
    return read_scene(CITY)


def test_lpips_of_the_finished_model_is_recorded(city, item_device, tmp_path):
    pytest.importorskip("onnxruntime", reason="the extra [lpips] is not installed")
    run = trained(tmp_path / "run", city, item_device, **SHORT, lpips=str(NETWORK))
    first, last = [record for record in run.records() if record["event"] == "eval"]
    assert "lpips" not in first
    # this network gives four times the mean square error, of which PSNR is the logarithm
    assert last["lpips"] == pytest.approx(4 * 10 ** (-last["psnr"] / 10), rel=0.1)
    assert last["lpips_cc"] < last["lpips"]
    assert f"{last['lpips_cc']:.4f}" in (run.path / "report.html").read_text("utf-8")


def test_a_network_that_is_missing_is_told_before_the_first_step(city, item_device, tmp_path):
    pytest.importorskip("onnxruntime", reason="the extra [lpips] is not installed")
    missing = str(tmp_path / "missing.onnx")
    with pytest.raises(InputError, match="missing.onnx: no such file.*leave --lpips out"):
        trained(tmp_path / "run", city, item_device, **SHORT, lpips=missing)
    stopped = trained(tmp_path / "stopped", city, item_device, **SHORT, stop_at=4)
    with pytest.raises(InputError, match="missing.onnx: no such file"):
        resumed(stopped, city, item_device, **SHORT, lpips=missing)
    assert resumed(stopped, city, item_device, **SHORT).is_finished  # nothing was lost
