"""Scores for people: the one number to read, a word for it, and the table of all."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from clsplat.report.curves import Record
from clsplat.report.page import Table

# of the scores: key, title, format
COLUMNS = (("iteration", "step", ",.0f"), ("train_seconds", "training, s", ",.1f"),
           ("psnr_cc", "PSNR cc, dB", ".2f"), ("psnr", "PSNR, dB", ".2f"),
           ("ssim_cc", "SSIM cc", ".4f"), ("ssim", "SSIM", ".4f"))
PERCEPTUAL = (("flip_cc", "FLIP cc", ".4f"), ("flip", "FLIP", ".4f"),
              ("lpips_cc", "LPIPS cc", ".4f"), ("lpips", "LPIPS", ".4f"))  # where a run has them
GAUSSIANS = ("gaussians", "gaussians", ",.0f")
# from so many dB
QUALITIES = ((28.0, "very good"), (25.0, "good"), (22.0, "fair"), (0.0, "poor"))
EXPLAINED = ("As a rule of thumb for photos of real places, a PSNR from 28 dB is very good, from "
             "25 dB good, from 22 dB fair.")


# what lowers the scores of the next evaluation: event -> its words, and the steps until the model
# has recovered (training/budget.py has the measurement)
UPHEAVALS = {"reset": ("opacities just lowered", 100), "level": ("photos just became larger", 40),
             "grow": ("gaussians just added", 40)}
FALL = 0.05  # dB, which is not chance


def main_key(record: Mapping[str, Any]) -> str:
    """The key of the PSNR to read in a record of an evaluation: after the colour fit where
    exposures were learned, as a photo that was not trained on has none, else plain."""
    return "psnr" if record.get("exposure_weight") is None else "psnr_cc"


def main_psnr(record: Mapping[str, Any]) -> float | None:
    """The PSNR to read in a record of an evaluation, dB; None: not known."""
    value: float | None = record.get(main_key(record))
    return record.get("psnr_cc") if value is None else value


def is_upheaval(record: Mapping[str, Any]) -> bool:
    """Whether what a record is about lowers the scores for a while; pruning alone does not."""
    added = (record.get("cloned") or 0) + (record.get("split") or 0)
    return record.get("event") in UPHEAVALS and (record.get("event") != "grow" or added > 0)


def disturbed(upheavals: Mapping[str, int], iteration: int) -> str:
    """Why the scores of an evaluation are lower than before; "" if nothing has happened.

    Parameters
    ----------
    upheavals : event -> step of the latest one.
    iteration : of the evaluation.
    """
    recent = [(at, text) for event, (text, steps) in UPHEAVALS.items()
              if (at := upheavals.get(event)) is not None and iteration - at <= steps]
    return max(recent, key=lambda item: item[0])[1] if recent else ""


def falls(records: Sequence[Record]) -> list[str]:
    """A sentence for each fall of the scores that an upheaval explains."""
    upheavals: dict[str, int] = {}
    sentences, before = [], -math.inf
    for record in records:
        at = record.get("iteration") or 0
        if is_upheaval(record):
            upheavals[record["event"]] = at
        psnr = main_psnr(record) if record.get("event") == "eval" else None
        if psnr is None:
            continue
        why = disturbed(upheavals, at)
        if psnr < before - FALL and why:
            sentences.append(f"The scores fall at step {at:,}: {why}, from which the model "
                             "recovers.")
        before = psnr
    return sentences


def quality(psnr: float | None) -> str:
    """A word for a PSNR, by QUALITIES; "" if it is no number."""
    if psnr is None or math.isnan(psnr):
        return ""
    return next((word for least, word in QUALITIES if psnr >= least), QUALITIES[-1][1])


def with_quality(psnr: float | None) -> str:
    """A PSNR and its word, such as "26.41 dB (good)"."""
    word = quality(psnr)
    return f"{psnr:.2f} dB ({word})" if word else "unknown"


def score_table(records: Sequence[Record]) -> Table | None:
    """A row for each evaluation; None without any."""
    evaluations = [record for record in records if record.get("event") == "eval"]
    columns = [*COLUMNS, *(column for column in PERCEPTUAL if any(
        record.get(column[0]) is not None for record in evaluations)), GAUSSIANS]
    rows = [tuple(number(record, key, form) for key, _, form in columns)
            for record in evaluations]
    note = ("Means over the held-out views; cc: after a quadratic fit of each render's colours to "
            f"its photo. {EXPLAINED}")
    if len(columns) > len(COLUMNS) + 1:
        note += (" FLIP and LPIPS, lower is better, are close to what people see; they are "
                 "computed for the finished model only.")
    return Table("", tuple(title for _, title, _ in columns), rows, range(len(columns)),
                 (note, *falls(records))) if rows else None


def number(record: Mapping[str, Any], key: str, form: str) -> str:
    """A number of a record as text; "-" if it has none."""
    return "-" if record.get(key) is None else format(record[key], form)
