"""Memory, files, processes, CPU seconds and file sizes that are limited."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import same_model

RUN = "clsplat train sy -n 12 --checkpoint-every 4 -q -o out"
AGAIN = "clsplat train sy -o out --resume -q"


def limited(limit, line):
    return f"(ulimit {limit}; {line})"


def owner_reads(folder, result):
    """What was written, root aside, its owner can read."""
    closed = [path for path in (folder / "out").rglob("*") if not path.stat().st_mode & 0o400]
    return f"cannot be read: {closed}" if closed else None


CASES = [
    # with less memory the compilers of OpenCL runtimes end the process, with fewer files the shell
    *(either(f"memory-{size}", limited(f"-v {size}", RUN)) for size in (1900000, 2600000)),
    *(either(f"files-{count}", limited(f"-n {count}", RUN)) for count in (16, 32, 64)),
    # through a pipe, for the line that says so is no file then
    *(either(f"file-size-{size}", f"set -o pipefail; {limited(f'-f {size}', RUN)} 2>&1 | cat")
      for size in (0, 1, 16, 64, 200, 380, 900)),
    works("file-size-then-resume", f"{limited('-f 380', RUN)} > log 2>&1; {AGAIN}", same_model(),
          writes=("out", "log")),
    either("stack-small", limited("-s 256", RUN)),
    either("stack-unlimited", limited("-s unlimited", RUN)),
    either("no-locked-memory", limited("-l 0", RUN)),
    works("no-core", limited("-c 0", RUN), same_model()),
    works("many-descriptors", limited("-n 100000", RUN), same_model()),
    works("umask-077", f"(umask 077; {RUN})", same_model()),
    works("umask-777", f"(umask 777; {RUN})", same_model(), owner_reads),
    *(either(f"eval-memory-{size}", limited(f"-v {size}", "clsplat eval run"),
             needs=("sy", "run"), writes=("run/renders", "run/metrics.jsonl"))
      for size in (1200000, 1500000)),  # with less, libraries abort before Python can say why
    *(either(f"eval-file-size-{size}",
             f"set -o pipefail; {limited(f'-f {size}', 'clsplat eval run')} 2>&1 | cat",
             needs=("sy", "run"), writes=("run/renders", "run/metrics.jsonl")) for size in (0, 8)),
    either("synth-file-size", limited("-f 3", "clsplat synth -o out --views 4 --size 96x64"),
           needs=()),
    either("synth-memory", limited("-v 900000", "clsplat synth -o out --views 2 "
                                   "--size 8000x6000"), needs=()),
    either("export-file-size", limited("-f 100", "clsplat export run -o out.ply"),
           needs=("sy", "run"), writes=("out.ply",)),
    either("merge-file-size", limited("-f 100", "clsplat merge city"), needs=("sy", "city"),
           writes=("city/metrics.jsonl",)),
    either("city-file-size", limited("-f 200", "clsplat city sy -n 8 --grid 2x1 -q -o out")),
    works("city-after-file-size", limited("-f 200", "clsplat city sy -n 8 --grid 2x1 -q -o out")
          + " > log 2>&1; clsplat city sy -n 8 --grid 2x1 -q -o out",
          same_model("out", "city"), writes=("out", "log")),
    either("compare-memory", limited("-v 500000", "clsplat compare run -o out"), needs=("run",)),
    refused("view-of-gigapixels", RUN, setup="python -c \"import struct; open("
            "'sy/sparse/0/cameras.bin', 'wb').write(struct.pack('<QIiQQ4d', 1, 1, 1, 2**31, 2**31,"
            " 9e1, 9e1, 48, 32))\""),
    works("hundreds-of-files", RUN, same_model(),
          setup="cd sy/images; for i in $(seq 3000); do : > extra_$i.txt; done"),
    works("hundreds-in-run", "clsplat eval run --no-images", needs=("sy", "run"),
          setup="mkdir -p run/renders; cd run/renders; for i in $(seq 3000); do : > x$i; done",
          writes=("run/metrics.jsonl",)),
]
