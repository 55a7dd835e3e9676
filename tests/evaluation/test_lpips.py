"""LPIPS through a tiny network: the mean square of the difference of its inputs, -1 to 1."""

import sys
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.evaluation.metrics import Lpips
from clsplat.evaluation.views import FINAL_METRICS, final_metrics

DATA = Path(__file__).resolve().parents[1] / "data"
NETWORK, OF_ONE_SIZE = DATA / "mean_square.onnx", DATA / "mean_square_8.onnx"


@pytest.fixture
def onnxruntime():
    return pytest.importorskip("onnxruntime", reason="the extra [lpips] is not installed")


@pytest.mark.usefixtures("onnxruntime")
def test_images_are_given_as_lpips_wants_them():
    rng = np.random.default_rng(0)
    image, photo = rng.random((2, 12, 17, 3)).astype(np.float32)
    found = Lpips(NETWORK)(image, photo)
    assert found == pytest.approx(4 * np.mean((image - photo) ** 2), rel=1e-5)
    assert Lpips(NETWORK)(image, image) == 0
    metrics = final_metrics(NETWORK)
    assert list(metrics) == [*FINAL_METRICS, "lpips"] and metrics["lpips"](image, photo) == found
    assert final_metrics() == FINAL_METRICS


@pytest.mark.usefixtures("onnxruntime")
def test_what_is_not_such_a_network(tmp_path):
    with pytest.raises(InputError, match="cannot compare images of 17x12 pixels.*dynamic axes"):
        Lpips(OF_ONE_SIZE)(np.zeros((12, 17, 3)), np.zeros((12, 17, 3)))
    with pytest.raises(InputError, match="no such file"):
        Lpips(tmp_path / "missing.onnx")
    for content in (b"", b"not a network", NETWORK.read_bytes()[:60]):
        (tmp_path / "damaged.onnx").write_bytes(content)
        with pytest.raises(InputError, match="damaged.onnx: not a network") as error:
            Lpips(tmp_path / "damaged.onnx")
        assert "\n" not in str(error.value)


def test_without_onnxruntime_the_cure_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match=r"pip install onnxruntime"):
        Lpips(NETWORK)
