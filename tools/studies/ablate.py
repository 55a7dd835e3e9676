"""Train scenes with the SIG schedule and without each of its parts; write OUT/ablation.md.

    python -m tools.studies.ablate OUT SCENE[:DOWNSCALE] ... [-- FLAGS]

The parts of Xue et al. (2026) are FARS, levels that follow the scene frequency; DS, rounds of
growth at each level; SCG, spheres; and DR, reprojection, which is off by default and therefore
added. Ours are exposure, the limit of gaussians at each level, and opacity resets at the start of a
level.
"""

import math

import numpy as np

from clsplat.report.curves import spread
from clsplat.report.page import Table
from tools.studies import evidence
from tools.studies.runs import planned, trained

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
    """Train what is missing and write the tables."""
    parser = evidence.parser(__doc__, 7000)
    parser.add_argument("--seeds", type=int, default=3, help="default 3")
    arguments = evidence.parsed(parser, argv)
    groups, failed = trained(
        [planned(arguments, scene, name, seed, flags) for seed in range(arguments.seeds)
         for scene in arguments.scenes for name, flags in ROWS.items()],
        arguments.jobs, arguments.gpus)
    evidence.write(arguments.out / "ablation.md", "Ablation", arguments, groups,
                   [mean_table(groups), *(scene_table(*item) for item in groups.items())])
    evidence.refuse(failed)


def difference(runs, full):
    """The mean PSNR cc of `runs` minus that of `full`, dB, and its standard error from the seeds.

    Each is nan if there are too few runs. The seeds are taken as independent, since runs of one
    seed diverge at the first growth.
    """
    ends = [evidence.measured(group, "psnr_cc") for group in (runs, full)]
    errors = [(spread(values)[1] or np.nan) / math.sqrt(len(values) or 1) for values in ends]
    return evidence.mean(runs, "psnr_cc") - evidence.mean(full, "psnr_cc"), math.hypot(*errors)


def scene_table(scene, variants):
    """One scene, with a row for each variant."""
    rows = []
    for name, runs in variants.items():
        first, *rest = evidence.score_cells(runs)
        to_full = "" if name == FULL else evidence.cell(*difference(runs, variants[FULL]), 2, "+")
        rows.append((name, str(len(runs)), first, to_full, *rest))
    return Table(scene, HEAD, rows, range(1, 9),
                 (f"{evidence.NOTE} For the difference to full it is the standard error.",))


def mean_table(groups):
    """Means over the scenes that have every variant."""
    scenes, rows = evidence.complete(groups), []
    for name in ROWS:
        if not scenes:
            break
        runs = sum(len(variants[name]) for variants in scenes)
        first, *rest = (
            evidence.cell(np.mean([evidence.mean(variants[name], key) for variants in scenes]),
                          None, digits) for _, key, digits in evidence.SCORES)
        values, errors = np.transpose([difference(variants[name], variants[FULL])
                                       for variants in scenes])
        to_full = "" if name == FULL else evidence.cell(
            values.mean(), math.hypot(*errors) / len(scenes), 2, "+")
        rows.append((name, str(runs), first, to_full, *rest))
    left_out = len(groups) - len(scenes)
    return Table(f"Means over {len(scenes)} scene{'s' if len(scenes) != 1 else ''}", HEAD, rows,
                 range(1, 9), (
        "± is the standard error from the seeds: for other seeds on these scenes, not for other "
        "scenes.",
        *([f"{left_out} left out: a variant does not have a run there."] if left_out else [])))


if __name__ == "__main__":
    evidence.outermost(main)
