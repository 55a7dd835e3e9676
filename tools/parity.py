"""Trains scenes with several seeds and prints colour-corrected PSNR, beside another trainer's.

Usage: python -m tools.parity OUT SCENE [SCENE ...] [-- FLAGS OF clsplat train]

By default 7000 steps, evaluated at 500, 1000, 2000, 4000 and 7000, seeds 0, 1 and 2; runs land in
OUT/SCENE.SEED. gsplat 1.5.3, with whose figures ours are compared, never resets opacities (its
condition `step % reset_every == 0 & step > 0` is always false): `-- --reset-every 0` does the same.
"""

import statistics
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

from clsplat.io.run import RunFolder

SEEDS = (0, 1, 2)
STEPS, STOPS = 7000, (500, 1000, 2000, 4000)


def main(argv):
    words, flags = argv, []
    if "--" in argv:
        words, flags = argv[:argv.index("--")], argv[argv.index("--") + 1:]
    out, *scenes = words
    for scene in scenes:
        found = defaultdict(list)
        for seed in SEEDS:
            run = Path(out) / f"{Path(scene).stem}.{seed}"
            stops = [word for stop in STOPS for word in ("--eval-at", str(stop))]
            subprocess.run([sys.executable, "-m", "clsplat", "train", scene, "-n", str(STEPS),
                            *stops, "--seed", str(seed), "--checkpoint-every", "0", "-o", str(run),
                            "--overwrite", "-q", *flags], check=True)
            for record in RunFolder.open(run).records():
                if record["event"] == "eval":
                    found[record["iteration"]].append(record)
        for iteration, records in sorted(found.items()):
            print(line(Path(scene).stem, iteration, records), flush=True)


def line(scene, iteration, records):
    """One row: the mean of the corrected PSNR, each seed's, and the means of the rest."""
    mean = {key: statistics.mean(r[key] for r in records)
            for key in ("psnr_cc", "psnr", "ssim", "gaussians", "train_seconds")}
    seeds = " ".join(f"{r['psnr_cc']:.2f}" for r in records)
    return (f"{scene:20} {iteration:5}  cc {mean['psnr_cc']:.2f} dB ({seeds})  plain "
            f"{mean['psnr']:.2f} dB  SSIM {mean['ssim']:.4f}  {mean['gaussians']:,.0f} gaussians  "
            f"{mean['train_seconds']:.1f} s")


if __name__ == "__main__":
    main(sys.argv[1:])
