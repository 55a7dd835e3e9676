"""Signals in each phase of a command, and what goes on afterwards."""

from tests.adversarial.case import either, interrupted, works
from tests.adversarial.cases.changes import during
from tests.adversarial.checks import model, same_model

TRAIN = "clsplat train sy -n 12 --checkpoint-every 4 -q -o out"
LONG = "clsplat train sy -n 2000 --checkpoint-every 20 -q -o out"
CITY = "clsplat city sy -n 8 --grid 2x1 -q -o out"
RENAME = "python -m tests.adversarial.kill.child rename"
# a background job of a shell ignores SIGINT: this one does not
LISTENS = ("python -c \"import os, signal, sys; signal.signal(signal.SIGINT, "
           "signal.default_int_handler); os.execvp(sys.argv[1], sys.argv[1:])\" ")
PHASES = {  # file whose coming begins a phase -> its name
    "begun": "out/options.json", "plan": "out/metrics.jsonl", "saved": "out/checkpoint.npz"}
CITY_PHASES = {"coarse": "out/coarse/options.json", "cutting": "out/coarse/point_cloud.ply",
               "map": "out/partition.json", "block": "out/blocks/000/run/options.json",
               "second": "out/blocks/001/run/metrics.jsonl",
               "merging": "out/blocks/001/run/point_cloud.ply", "lod": "out/lod"}
WRITTEN = {"checkpoint": "checkpoint.npz", "model": "point_cloud.ply", "report": "report.html"}
DASK = """dask scheduler --port 18786 --no-dashboard > scheduler.log 2>&1 & S=$!
CLSPLAT_DEVICE=auto dask worker tcp://127.0.0.1:18786 --nthreads 1 --memory-limit 0 \
  --no-dashboard --death-timeout 20 --resources device=1 > worker.log 2>&1 & W=$!
trap 'kill -9 $S $W 2> /dev/null' EXIT; sleep 5
"""
ON_DASK = ("clsplat city sy -n 8 --grid 2x1 -q -o out --scheduler tcp://127.0.0.1:18786")
SAYS = r"clsplat \w+ .*|the same command (continues|again)"

CASES = [
    *(interrupted(f"int-{name}", during(LISTENS + LONG, "kill -INT $P", sign), says=SAYS)
      for name, sign in PHASES.items()),
    *(works(f"{signal.lower()}-{name}-then-again",
            "(" + during(TRAIN, f"kill -{signal} $P", sign) + f") 2> log; {TRAIN} --resume || "
            f"{TRAIN} --overwrite", same_model(), writes=("out", "log"))
      for signal in ("TERM", "KILL", "HUP", "QUIT", "ABRT", "SEGV")
      for name, sign in PHASES.items() if (signal, name) != ("QUIT", "begun")),
    *(works(f"kill-while-writing-{name}", "(" + during(TRAIN, "kill -KILL $P", f"out/{file}.part")
            + f") 2> log; {TRAIN} --resume || {TRAIN} --overwrite", same_model(),
            writes=("out", "log")) for name, file in WRITTEN.items()),
    *(works(f"kill-before-rename-{number}", f"({RENAME} {number} "
            f"{TRAIN.removeprefix('clsplat ')}) 2> log; {TRAIN} --resume || {TRAIN} --overwrite",
            same_model(), writes=("out", "log")) for number in range(2, 8)),
    *(works(f"merge-kill-before-rename-{number}", f"({RENAME} {number} "
            "merge city) > log 2>&1; clsplat merge city", same_model("city", "city"),
            needs=("sy", "city"), writes=("city", "log")) for number in range(1, 4)),
    works("dask-scheduler-killed", DASK + "(" + during(
        ON_DASK, "kill -9 $S; sleep 20; kill -TERM $P",  # else it waits for it, as it says
        "out/blocks/000/run/metrics.jsonl") + ") > log 2>&1; [ $? != 1 ] && "
        f"! grep Traceback log && grep 'waiting for it' log; {CITY}", same_model("out", "city"),
        writes=("out", "log", "scheduler.log", "worker.log")),
    works("dask-worker-killed", DASK + "(" + during(
        ON_DASK, "kill -9 $W; sleep 20; kill -TERM $P", "out/blocks/000/run/metrics.jsonl")
        + f") > log 2>&1; {CITY}", same_model("out", "city"),
        writes=("out", "log", "scheduler.log", "worker.log")),
    *(either(f"{signal.lower()}-ignored", during(TRAIN, f"kill -{signal} $P", PHASES["plan"]))
      for signal in ("CHLD", "WINCH", "URG", "CONT")),
    works("int-ignored-by-shell", during(TRAIN, "kill -INT $P", PHASES["begun"]), same_model()),
    interrupted("int-twice", during(LISTENS + LONG, "kill -INT $P; sleep 0.05; kill -INT $P",
                                    PHASES["saved"])),
    interrupted("int-thirty-times", during(
        LISTENS + LONG, "for i in {1..30}; do kill -INT $P 2> /dev/null; sleep 0.01; done",
        PHASES["saved"])),
    interrupted("int-early", during(LISTENS + TRAIN, "sleep 0.3; kill -INT $P", "sy")),
    interrupted("int-importing", during(LISTENS + TRAIN, "sleep 0.6; kill -INT $P", "sy")),
    *(interrupted(f"city-int-{name}", during(LISTENS + CITY, "kill -INT $P", sign), says=SAYS)
      for name, sign in CITY_PHASES.items()),
    *(works(f"city-kill-{name}", "(" + during(CITY, "kill -KILL $P", sign) + f") 2> log; {CITY}",
            same_model("out", "city"), writes=("out", "log"))
      for name, sign in CITY_PHASES.items()),
    works("city-workers-kill", "(" + during(f"{CITY} --workers 2", "kill -KILL $P",
                                            CITY_PHASES["block"]) + f") 2> log; sleep 3; {CITY}",
          same_model("out", "city"), writes=("out", "log")),
    interrupted("city-workers-int", during(f"{LISTENS}{CITY} --workers 2", "kill -INT $P",
                                           CITY_PHASES["block"]), says=SAYS),
    *(works(f"{name}-kill-then-again", "(" + during(line, "kill -KILL $P", sign) +
            f") 2> log; {line}", *checks, needs=needs, writes=(*writes, "log"))
      for name, line, sign, checks, needs, writes in (
        ("eval", "clsplat eval run", "run/renders/test", (), ("sy", "run"),
         ("run/renders", "run/metrics.jsonl")),
        ("merge", "clsplat merge city", "city/lod/level_2.ply.part", (same_model("city", "city"),),
         ("sy", "city"), ("city",)),
        ("render", "clsplat render run -o out", "out", (), ("sy", "run"), ("out",)),
        ("compare", "clsplat compare run -o out", "out", (), ("run",), ("out",)),
        ("export", "clsplat export run -o out.ply --overwrite", "out.ply.part", (model("out.ply"),),
         ("sy", "run"), ("out.ply", "out.ply.part")),
        ("block", "clsplat block parted/blocks/000 -q", "parted/blocks/000/run/metrics.jsonl",
         (same_model("parted/blocks/000/run", "city/blocks/000/run"),), ("sy", "parted"),
         ("parted",)),
        ("partition", "clsplat partition parted --grid 2x1", "parted/.lock", (), ("sy", "parted"),
         ("parted",)))),
    *(interrupted(f"{name}-int", during(LISTENS + line, "kill -INT $P", sign), needs=needs,
                  writes=writes)
      for name, line, sign, needs, writes in (
        ("eval", "clsplat eval run", "run", ("sy", "run"), ("run",)),
        ("render", "clsplat render run -o out", "out", ("sy", "run"), ("out",)),
        ("synth", "clsplat synth -o out --views 200", "out.part/images", (), ("out",)),
        ("plan", "sleep 0.5; clsplat plan sy -n 2000", "sy", ("sy",), ()),
        ("block", "clsplat block parted/blocks/000 -q", "parted/blocks/000/run/metrics.jsonl",
         ("sy", "parted"), ("parted",))) if name != "plan"),
    interrupted("campaign-int", during(
        f"{LISTENS}clsplat train sy -n 2000 -q --schedules sig,constant -o out", "kill -INT $P",
        "out/sig.0/metrics.jsonl"), says=SAYS),
    works("campaign-kill", "(" + during(
        "clsplat train sy -n 12 --checkpoint-every 4 -q --schedules sig,constant -o out",
        "kill -KILL $P", "out/constant.0/metrics.jsonl") + ") 2> log; clsplat train sy -n 12 "
        "--checkpoint-every 4 -q --schedules sig,constant -o out", same_model("out/sig.0"),
        writes=("out", "log")),
]
