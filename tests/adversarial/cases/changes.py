"""Folders and files that are removed, replaced or changed, and clocks that jump, during a run."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import model, same_model

LONG = "clsplat train sy -n 600 --checkpoint-every 20 -q -o out"
BEGUN = "out/checkpoint.npz"


def during(line, what, sign=BEGUN):
    """`what` is done as soon as the file `sign` is there; ends with the exit code of `line`."""
    return (f"{line} & P=$!; until [ -e {sign} ] || ! kill -0 $P 2> /dev/null; do sleep 0.02; "
            f"done; {what}; wait $P")


def shifted(days):
    """A module that moves Python's wall clock each time it is asked."""
    return ("mkdir clock; cat > clock/sitecustomize.py <<'E'\n"
            "import time, itertools\n_now, _count = time.time, itertools.count()\n"
            f"time.time = lambda: _now() + 86400 * ({days}) * next(_count)\nE")


CASES = [
    either("output-removed", during(LONG, "rm -rf out")),
    either("output-removed-and-made", during(LONG, "rm -rf out; mkdir out")),
    either("output-becomes-file", during(LONG, "mv out gone; touch out"), writes=("out", "gone")),
    either("output-moved", during(LONG, "mv out elsewhere"), writes=("out", "elsewhere")),
    either("output-becomes-link", during(LONG, "mv out real; ln -s real out"),
           writes=("out", "real")),
    either("metrics-removed", during(LONG, "rm out/metrics.jsonl")),
    either("options-removed", during(LONG, "rm out/options.json")),
    either("checkpoint-removed", during(LONG, "rm out/checkpoint.npz")),
    works("lock-removed", during(LONG, "rm -f out/.lock"), model()),
    either("scene-removed", during(LONG, "rm -rf sy"), writes=("out", "sy")),
    either("photos-replaced", during(LONG, "for f in sy/images/00[1-9].jpg; do "
                                           "cp sy/images/000.jpg $f; done"), writes=("out", "sy")),
    works("current-folder-removed", "mkdir d; cd d; D=$OLDPWD; clsplat train $D/sy -n 600 "
          "--checkpoint-every 20 -q -o $D/out & P=$!; cd $D; sleep 1; rmdir d; wait $P", model()),
    refused("current-folder-gone-before", "mkdir d; cd d; rmdir ../d; clsplat train "
            "sy -n 4 -o out"),
    works("clock-forward", 'PYTHONPATH="clock:$PYTHONPATH" clsplat train sy -n 12 '
          "--checkpoint-every 4 -q -o out", same_model(), setup=shifted(365)),
    works("clock-backward", 'PYTHONPATH="clock:$PYTHONPATH" clsplat train sy -n 12 '
          "--checkpoint-every 4 -q -o out", same_model(), setup=shifted(-2)),
    works("clock-backward-city", 'PYTHONPATH="clock:$PYTHONPATH" clsplat city sy -n 8 --grid 2x1 '
          "-q -o out", same_model("out", "city"), setup=shifted(-2)),
    either("clock-budget", 'PYTHONPATH="clock:$PYTHONPATH" clsplat train sy --time-budget 30s -q '
           "-o out", setup=shifted(-2)),
    works("files-of-the-future", "clsplat train sy -o half --resume -q", same_model("half"),
          needs=("sy", "half"), writes=("half",), setup="touch -d 2200-01-01 half/*"),
    works("stopped-for-a-while", during(LONG, "kill -STOP $P; sleep 2; kill -CONT $P"), model()),
    either("model-becomes-folder", during(LONG, "mkdir out/point_cloud.ply")),
    either("block-removed", during("clsplat city sy -n 200 --grid 2x1 -q --checkpoint-every 5 "
                                   "-o out", "rm -rf out/blocks/000",
                                   "out/blocks/000/run/checkpoint.npz")),
    either("block-removed-by-itself", during(
        "clsplat block parted/blocks/000 -q", "rm -rf parted/blocks/000",
        "parted/blocks/000/run/options.json"), needs=("sy", "parted"), writes=("parted",)),
    either("coarse-removed", during("clsplat city sy -n 200 --grid 2x1 -q --checkpoint-every 5 "
                                    "-o out", "rm -rf out/coarse",
                                    "out/blocks/000/run/checkpoint.npz")),
    either("partition-removed", during("clsplat city sy -n 200 --grid 2x1 -q --checkpoint-every 5 "
                                       "-o out", "rm -f out/partition.json",
                                       "out/blocks/000/run/checkpoint.npz")),
    either("eval-run-removed", during("clsplat eval run", "rm -rf run", "run/renders/test"),
           needs=("sy", "run"), writes=("run",)),
    either("eval-scene-removed", during("clsplat eval run", "rm -rf sy", "run/renders/test"),
           needs=("sy", "run"), writes=("run", "sy")),
    either("render-output-removed", during("clsplat render run -o out", "rm -rf out", "out"),
           needs=("sy", "run")),
    either("synth-output-removed", during("clsplat synth -o out --views 20", "rm -rf out",
                                          "out/images"), needs=()),
    either("merge-blocks-removed", during("clsplat merge city", "rm -rf city/blocks",
                                          "city/.lock"), needs=("sy", "city"), writes=("city",)),
]
