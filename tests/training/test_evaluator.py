"""The lines that an evaluation shows."""

from types import SimpleNamespace

import pytest

from clsplat.training.recorder import Evaluator

# result -> (first line, columns of the last line, its note)
PLAIN = {"views": 5, "psnr": 12.375, "psnr_cc": 25.48, "ssim": 0.5, "ssim_cc": 0.75}
FITTED = "scores of 5 held-out photos, their colours fitted, as exposures are learned"
USUAL = ["750", "12.38", "0.5000", "35,840", "29.0", "s"]


@pytest.mark.parametrize(
    "result, upheavals, head, columns, note",
    [
        (PLAIN, {}, "scores of 5 held-out photos", USUAL, ""),
        ({**PLAIN, "exposure_weight": 0.25}, {}, FITTED, ["750", "25.48", "0.7500", "35,840", "29.0", "s"], ""),
        ({**PLAIN, "views": 1}, {"grow": 711}, "scores of 1 held-out photo", USUAL, "gaussians just added"),
        (
            {**PLAIN, "psnr": float("nan")},
            {},
            "scores of 5 held-out photos",
            ["750", "nan", "0.5000", "35,840", "29.0", "s"],
            "",
        ),
        (
            {**PLAIN, "psnr": float("inf")},
            {"reset": 749},
            "scores of 5 held-out photos",
            ["750", "inf", "0.5000", "35,840", "29.0", "s"],
            "opacities just lowered",
        ),
    ],
)
def test_an_evaluation_is_a_line_of_columns_with_one_number(result, upheavals, head, columns, note):
    """Trial of f3a1525: two PSNR, 13 dB apart, on lines wider than the terminal."""
    told = Evaluator.__new__(Evaluator)
    told._is_begun = False
    told.session = SimpleNamespace(iteration=750, model=SimpleNamespace(count=35_840))
    told.clock = SimpleNamespace(trained=lambda: 29.0)
    told.recorder = SimpleNamespace(upheavals=upheavals)
    lines = [*told._lines(result)]
    assert lines[0] == head and lines[-1].split()[:6] == columns and lines[-1].endswith(note)
    assert max(map(len, lines)) < 80
    told.session.iteration, told.session.model.count = 1_000_000, 20_000_000
    (line,) = told._lines(result)  # the head is shown once
    assert len(line) < 80


@pytest.mark.parametrize(
    "width, views, elapsed, due", [(320, 4, 5.0, True), (1152, 200, 5.0, False), (1152, 200, 3600.0, True)]
)
def test_the_first_waits_until_its_time_is_a_small_share(monkeypatch, width, views, elapsed, due):
    """Of a made survey of 1600 photos the first evaluation took 45 of 120 seconds."""
    monkeypatch.setattr("os.cpu_count", lambda: 16)
    view = SimpleNamespace(camera=SimpleNamespace(width=width, height=width * 3 // 4))
    session = SimpleNamespace(
        test_views=views * [view], iteration=1000, options=SimpleNamespace(eval_every="auto", iterations=8000)
    )
    evaluator = Evaluator(session, SimpleNamespace(elapsed=lambda: elapsed), None)
    assert evaluator.is_due() == due
