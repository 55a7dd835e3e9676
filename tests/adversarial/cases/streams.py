"""Standard input, output and error that are closed, full, or go away."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import model, same_model

RUN = "clsplat train sy -n 12 --checkpoint-every 4 -o out"
LOUD = {"PYTHONUNBUFFERED": "1"}

CASES = [
    works("stdin-closed", f"{RUN} <&-", same_model(), quick=True),
    works("stdout-closed", f"{RUN} >&-", same_model()),
    works("stderr-closed", f"{RUN} 2>&-", same_model(), quick=True),
    works("all-closed", f"{RUN} <&- >&- 2>&-", same_model()),
    refused("stdout-full", f"{RUN} > /dev/full", "the output: No space", same_model()),
    works("stderr-full", f"{RUN} 2> /dev/full", same_model()),
    works("both-full", f"{RUN} > /dev/full 2>&1; [ $? = 2 ]", same_model(), environment=LOUD),
    works("stderr-goes-away", f"({RUN} -q; echo $? > code) 2>&1 | true; "
          "while [ ! -f code ]; do sleep 0.2; done; exit $(cat code)", same_model(),
          writes=("out", "code")),
    works("progress-goes-away", f"({RUN}; echo $? > code) 2>&1 | head -c 5; "
          "while [ ! -f code ]; do sleep 0.2; done; [ $(cat code) = 141 ]", same_model(),
          writes=("out", "code")),
    works("stderr-on-file-of-limit", f"(ulimit -f 2000; {RUN} 2> log)", model(),
          writes=("out", "log")),
    works("log-into-run", f"mkdir out; {RUN} > out/log 2>&1", same_model(), writes=("out",)),
    works("nohup", f"nohup {RUN} > log 2>&1", same_model(), writes=("out", "log")),
    works("setsid", f"setsid -w {RUN} < /dev/null", same_model()),
    works("terminal-of-one-column", f"script -qec 'stty cols 1 rows 1; {RUN}' /dev/null",
          same_model()),
    works("terminal-of-zero-columns", f"script -qec 'stty cols 0 rows 0; {RUN}' /dev/null",
          same_model()),
    works("descriptor-many-open", f"for i in {{10..200}}; do eval \"exec $i</dev/null\"; done; "
          f"{RUN}", same_model()),
    *(either(f"{name}-full", f"clsplat {words} > /dev/full", needs=("sy", "run"))
      for name, words in (("eval", "eval run --no-images"), ("help", "--help"),
                          ("version", "--version"), ("devices", "devices"),
                          ("train-help", "train --help"), ("completion", "completion bash"),
                          ("plan", "plan sy -n 4"), ("compare", "compare run -o out"),
                          ("export", "export run -o out.ply"), ("bench", "bench"))
      if name != "export"),
    either("export-stdout-full", "clsplat export run -o out.ply > /dev/full",
           needs=("sy", "run"), writes=("out.ply",)),
    *(works(f"{name}-reader-leaves", f"(clsplat {words}; echo $? > code) | head -c 1; "
            "[ $(cat code) != 1 ]", needs=("sy", "run"), writes=("code", "run"))
      for name, words in (("eval", "eval run --no-images"), ("devices", "devices"),
                          ("plan", "plan sy -n 4"), ("help", "train --help"))),
    works("synth-all-closed", "clsplat synth -o out --blocks 1x1 --views 4 --size 64x48 "
          "<&- >&- 2>&-", needs=()),
    works("city-all-closed", "clsplat city sy -n 8 --grid 2x1 -o out <&- >&- 2>&-",
          same_model("out", "city")),
    works("city-workers-stdin-closed", "clsplat city sy -n 8 --grid 2x1 --workers 2 -q -o out <&-",
          same_model("out", "city")),
    works("merge-closed", "clsplat merge city <&- >&- 2>&-", model("city"), needs=("sy", "city"),
          writes=("city",)),
    refused("refused-stdout-closed", "clsplat train nope -o out >&-", "nope", needs=()),
    refused("output-is-dev-stdout", "clsplat train sy -n 4 -q -o /dev/stdout | cat"),
    either("export-to-dev-null", "clsplat export run -o /dev/null.ply", needs=("sy", "run")),
]
