"""Run folders that no training wrote: options and metrics of made-up, plausible runs."""

import dataclasses

import numpy as np

from clsplat.io.runs.run import MODEL, RunFolder
from clsplat.options import resolve

# seconds a step, PSNR at the end, gaussians at the end; levels: (step it begins, factor)
METHODS = {
    "sig": (0.016, 28.6, 1_300_000, ((0, 5.0), (900, 4.0), (1900, 3.0), (3000, 2.0), (5000, 1.0))),
    "constant": (0.031, 28.2, 2_100_000, ((0, 1.0),)),
    "dash": (0.019, 28.0, 1_000_000, ((0, 4.0), (1500, 2.0), (6000, 1.0))),
    "taming": (0.024, 27.6, 600_000, ((0, 1.0),)),
}
STEPS = 10_000


def made_run(folder, schedule="sig", seed=0, finished=True, facts=(), **options):
    """The RunFolder of a made-up training; facts: (key, value) pairs of options.json."""
    run = RunFolder.create(folder)
    chosen = resolve({}, {"schedule": schedule, "seed": seed, "iterations": STEPS, **options})
    run.write_options(
        {
            "scene": "/data/city",
            **dataclasses.asdict(chosen),
            "fingerprint": "ab" * 32,
            "opencl_device": "NVIDIA H100 80GB HBM3",
            "kernel_form": "group",
            "extent": 41.5,
            "offset": [0.0, 0.0, 0.0],
            **dict(facts),
        }
    )
    for record in made_records(schedule, seed, STEPS if finished else STEPS // 2):
        run.log(record)
    if finished:
        (run.path / MODEL).write_text("ply")
        run.write_report("page")  # comes last
    return run


def made_records(schedule, seed=0, until=STEPS):
    """What a training logs: a plan, steps, level changes and evaluations."""
    step_seconds, psnr, gaussians, levels = METHODS[schedule]
    random = np.random.default_rng([seed, *schedule.encode()])
    psnr += random.normal(0, 0.12)
    level, seconds, since = levels[0][1], 0.0, 0
    later = dict(levels[1:])

    def record(event, **values):
        count = round(40_000 + (gaussians - 40_000) * (1 - np.exp(-4 * share)))
        return {
            "event": event,
            "iteration": step,
            "train_seconds": round(seconds, 3),
            "wall_seconds": round(seconds * 1.2, 3),
            "level": level,
            "gaussians": count,
            "pixel_pairs": round(4e9 * seconds),
            **values,
        }

    step, share = 0, 0.0
    if schedule == "sig":
        yield record(
            "plan",
            reasons={
                "levels": "5 4 3 2 1: the photos are 1600 pixels wide, each level earns its share.",
                "exposure": "on: the median brightness of overlapping photos differs by 8 %.",
                "reproject": "off: no textureless regions among the adjacent views.",
            },
        )
    for step in range(100, until + 1, 100):
        share = step / STEPS
        seconds += 100 * step_seconds * (0.35 + 0.65 * share) / level**0.5 * random.uniform(0.97, 1.03)
        loss = 0.04 + 0.25 * np.exp(-5 * share) + random.normal(0, 0.004)
        sigma = (20 + 90 * share) * (1 - np.exp(-(step - since) / 400)) + random.uniform(0, 1)
        yield record(
            "step",
            loss=loss,
            l1=loss * 0.6,
            ssim=1 - loss,
            memory_bytes=1 << 30,
            skipped_rows=0,
            frequency=None
            if schedule != "sig"
            else {
                f"{variant}_{axis}": sigma * scale * stretch
                for variant, scale in (("paper", 0.1), ("release", 1), ("robust", 3))
                for axis, stretch in (("mean", 1), ("max", 4), ("min", 0.4))
            },
        )
        if step in later:
            level = later[step]
            yield record(
                "level",
                reason="converged" if level > 1 else "deadline",
                slope=3.1e-4,
                threshold=4.4e-3,
                since=step - since,
            )
            since = step
        if step % 1000 == 0:
            score = psnr - 7 * np.exp(-3.5 * share) - 0.4 * (level - 1) + random.normal(0, 0.03)
            yield record(
                "eval",
                views=12,
                psnr=score - 0.8,
                psnr_cc=score,
                ssim=0.9 - 0.3 * np.exp(-3 * share),
                ssim_cc=0.91 - 0.3 * np.exp(-3 * share),
            )
