"""Trains scenes with the SIG schedule and with each part left out; writes OUT/ablation.md.

    python -m tools.studies.ablate OUT SCENE[:DOWNSCALE] ... [-- FLAGS]

Parts, after Xue et al. (2026): FARS, levels that follow the frequency; DS, rounds of growth a
level; SCG, spheres; DR, reprojection, which is off by default and therefore added. Ours are
exposure, the ceiling of gaussians a level, and that opacities are lowered where a level begins.
"""

import math

import numpy as np

from clsplat.report.curves import spread
from clsplat.report.page import Table
from tools.studies import evidence
from tools.studies.runs import trained, wanted

FULL = "full"
GROWS_AS_CONSTANT = ["--rounds", "0", "--densify-every", "200"]
ROWS = {
    FULL: [],
    "w/o FARS": ["--levels", "1", *GROWS_AS_CONSTANT],
    "w/o DS": GROWS_AS_CONSTANT,
    "w/o SCG": ["--no-sphere"],
    "and DR": ["--reproject", "auto"],
    "w/o exposure": ["--exposure", "off"],
    "w/o ceiling": ["--pixels-per-gaussian", "0"],
    "w/o level resets": ["--no-level-reset"],
}
HEAD = ("", "runs", evidence.TITLES[0], "to full, dB", *evidence.TITLES[1:])


def main(argv):
    made = evidence.parser(__doc__, 7000)
    made.add_argument("--seeds", type=int, default=3, help="default 3")
    given = evidence.parsed(made, argv)
    groups, failed = trained(
        [wanted(given, scene, name, seed, flags) for seed in range(given.seeds)
         for scene in given.scenes for name, flags in ROWS.items()], given.jobs, given.gpus)
    evidence.write(given.out / "ablation.md", "Ablation", given, groups,
          [mean_table(groups), *(scene_table(*found) for found in groups.items())])
    evidence.refuse(failed)


def difference(runs, full):
    """(mean PSNR cc of `runs` minus that of `full`, dB, standard error from their seeds); nan for
    what too few runs say nothing of.

    The seeds are taken as independent: runs of one seed part at the first growth.
    """
    ends = [evidence.measured(group, "psnr_cc") for group in (runs, full)]
    errors = [(spread(values)[1] or np.nan) / math.sqrt(len(values) or 1) for values in ends]
    return evidence.mean(runs, "psnr_cc") - evidence.mean(full, "psnr_cc"), math.hypot(*errors)


def scene_table(scene, found):
    """One scene: a row a variant."""
    rows = []
    for name, runs in found.items():
        first, *rest = evidence.score_cells(runs)
        to_full = "" if name == FULL else evidence.cell(*difference(runs, found[FULL]), 2, "+")
        rows.append((name, str(len(runs)), first, to_full, *rest))
    return Table(scene, HEAD, rows, range(1, 9),
                 (f"{evidence.NOTE} That of the difference to full is its standard error.",))


def mean_table(groups):
    """Means over the scenes that have every variant."""
    scenes, rows = evidence.complete(groups), []
    for name in ROWS:
        if not scenes:
            break
        runs = sum(len(found[name]) for found in scenes)
        first, *rest = (
            evidence.cell(np.mean([evidence.mean(found[name], key) for found in scenes]), None,
                          digits) for _, key, digits in evidence.SCORES)
        values, errors = np.transpose([difference(found[name], found[FULL]) for found in scenes])
        to_full = "" if name == FULL else evidence.cell(
            values.mean(), math.hypot(*errors) / len(scenes), 2, "+")
        rows.append((name, str(runs), first, to_full, *rest))
    left_out = len(groups) - len(scenes)
    return Table(f"Means over {len(scenes)} scene{'s' if len(scenes) != 1 else ''}", HEAD, rows,
                 range(1, 9), (
        "± is the standard error from the seeds: what to expect of other seeds on these scenes, "
        "not of other scenes.",
        *([f"{left_out} left out: a variant has no run there."] if left_out else [])))


if __name__ == "__main__":
    evidence.outermost(main)
