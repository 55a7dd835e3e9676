"""The last evaluation of a training, which has time for more metrics."""

from types import SimpleNamespace

import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.read import read_scene
from clsplat.training.recorder import Evaluator, Recorder
from tests.data.tiny_training import CITY, STILL, resumed, trained
from tests.evaluation.test_metrics import NETWORK

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


# result -> (first line, columns of the last line, its note)
PLAIN = {"views": 5, "psnr": 12.375, "psnr_cc": 25.48, "ssim": 0.5, "ssim_cc": 0.75}
FITTED = "scores of 5 held-out photos, their colours fitted, as exposures are learned"
USUAL = ["750", "12.38", "0.5000", "35,840", "29.0", "s"]


@pytest.mark.parametrize("result, upheavals, head, columns, note", [
    (PLAIN, {}, "scores of 5 held-out photos", USUAL, ""),
    ({**PLAIN, "exposure_weight": 0.25}, {}, FITTED,
     ["750", "25.48", "0.7500", "35,840", "29.0", "s"], ""),
    ({**PLAIN, "views": 1}, {"grow": 711}, "scores of 1 held-out photo",
     USUAL, "gaussians just added"),
    ({**PLAIN, "flip": 0.125, "lpips": 0.25}, {"grow": 749}, "scores of 5 held-out photos",
     USUAL, "FLIP 0.1250, LPIPS 0.2500"),
    ({**PLAIN, "psnr": float("nan")}, {}, "scores of 5 held-out photos",
     ["750", "nan", "0.5000", "35,840", "29.0", "s"], ""),
    ({**PLAIN, "psnr": float("inf")}, {"reset": 749}, "scores of 5 held-out photos",
     ["750", "inf", "0.5000", "35,840", "29.0", "s"], "opacities just lowered")])
def test_an_evaluation_is_a_line_of_columns_with_one_number(result, upheavals, head, columns,
                                                            note):
    """Trial of f3a1525: two PSNR, 13 dB apart, on lines wider than the terminal."""
    told = Evaluator.__new__(Evaluator)
    told._is_begun = False
    told.session = SimpleNamespace(iteration=750, model=SimpleNamespace(count=35_840))
    told.clock = SimpleNamespace(trained=lambda: 29.0)
    told.recorder = Recorder.__new__(Recorder)
    told.recorder.session, told.recorder._upheavals = told.session, upheavals
    lines = [*told._lines(result)]
    assert lines[0] == head and lines[-1].split()[:6] == columns and lines[-1].endswith(note)
    assert max(map(len, lines)) < 80
    told.session.iteration, told.session.model.count = 1_000_000, 20_000_000
    line, = told._lines(result)  # the head is shown once
    assert len(line) < 80
