"""Environment variables, locales, time zones, missing tools and folders."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import evaluated, same_model
from tests.adversarial.damage import written

RUN = "clsplat train sy -n 12 --checkpoint-every 4 -q -o out"
SAME = {  # name -> variables that must change nothing
    "hash-seed": {"PYTHONHASHSEED": "12345"}, "time-zone": {"TZ": "Pacific/Kiritimati"},
    "time-zone-nonsense": {"TZ": "/dev/zero:::"}, "turkish": {"LC_ALL": "tr_TR.UTF-8"},
    "comma-locale": {"LC_NUMERIC": "de_DE.UTF-8", "LANG": "de_DE.UTF-8"},
    "locale-nonsense": {"LC_ALL": "xx_YY.nope", "LANG": "nonsense"},
    "ascii": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "io-ascii": {"PYTHONIOENCODING": "ascii"}, "io-utf16": {"PYTHONIOENCODING": "utf-16"},
    "columns-0": {"COLUMNS": "0"}, "columns-1": {"COLUMNS": "1", "LINES": "1"},
    "columns-word": {"COLUMNS": "wide"}, "columns-negative": {"COLUMNS": "-5"},
    "term-none": {"TERM": ""}, "home-none": {"HOME": ""}, "home-proc": {"HOME": "/proc"},
    "home-null": {"HOME": "/dev/null"}, "xdg-nonsense": {"XDG_CACHE_HOME": "/dev/null/x",
                                                         "XDG_CONFIG_HOME": "/dev/null/x"},
    "mpl-backend": {"MPLBACKEND": "nonsense"}, "mpl-backend-gui": {"MPLBACKEND": "QtAgg"},
    "mpl-config-null": {"MPLCONFIGDIR": "/dev/null"}, "threads-0": {"OMP_NUM_THREADS": "0"},
    "threads-1": {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    "python-optimised": {"PYTHONOPTIMIZE": "2"}, "warnings-shown": {"PYTHONWARNINGS": "always"},
    "warnings-errors": {"PYTHONWARNINGS": "error::UserWarning"}, "tqdm": {"TQDM_DISABLE": "1"},
    "tqdm-nonsense": {"TQDM_MININTERVAL": "nope"}, "dont-buffer": {"PYTHONUNBUFFERED": "1"},
    "no-user-site": {"PYTHONNOUSERSITE": "1"}, "malloc-debug": {"PYTHONMALLOC": "debug"},
    "no-git": {"GIT_DIR": "/dev/null"},
    "colour": {"FORCE_COLOR": "1", "NO_COLOR": "1"}, "proxy": {"http_proxy": "nope://"},
    "oiio-threads": {"OPENIMAGEIO_THREADS": "-4"}, "dask-config": {"DASK_CONFIG": "/dev/null"},
}

CASES = [
    *(works(f"{name}", RUN, same_model(), environment=variables, quick=name == "comma-locale")
      for name, variables in SAME.items()),
    works("empty-environment", 'env -i PATH="$PATH" PYTHONPATH="$PYTHONPATH" ' + RUN, same_model()),
    works("tmpdir-missing", RUN, same_model(), environment={"TMPDIR": "/no/such/folder"}),
    either("tmpdir-null", RUN, environment={"TMPDIR": "/dev/null"}),
    either("tmpdir-read-only", f"unprivileged {RUN}", setup="mkdir -m 555 t",
           environment={"TMPDIR": "t"}),
    works("matplotlibrc-usetex", RUN, same_model(),
          setup=written("matplotlibrc", "text.usetex: True\n")),
    works("matplotlibrc-nonsense", RUN, same_model(),
          setup=written("matplotlibrc", "savefig.dpi: -7\nfont.family: nope\nlines.width: x\n")),
    works("matplotlibrc-huge-font", RUN, same_model(),
          setup=written("matplotlibrc", "font.size: 1e6\nfigure.dpi: 9999\n")),
    refused("device-of-blocks", RUN, "nope", environment={"CLSPLAT_DEVICE": "nope"}),
    either("icd-folder-missing", RUN, environment={"OCL_ICD_VENDORS": "/no/such/folder"}),
    works("modules-in-folder", RUN, same_model(),
          setup="for m in random json types enum click numpy; do echo 'raise SystemExit(9)' > "
                "$m.py; done; mkdir clsplat"),
    works("devices-without-home", "clsplat devices", environment={"HOME": ""}, needs=()),
    either("pocl-cache-null", f"{RUN} --device Portable", environment={"POCL_CACHE_DIR":
                                                                       "/dev/null"}),
    either("pocl-cache-read-only", f"unprivileged {RUN} --device Portable", setup="mkdir -m 555 c",
           environment={"POCL_CACHE_DIR": "c"}),
    works("eval-ascii", "clsplat eval run --no-images", evaluated, needs=("sy", "run"),
          environment=SAME["ascii"]),
    works("help-narrow", "clsplat train --help", needs=(), environment={"COLUMNS": "1"}),
    works("city-home-proc", "clsplat city sy -n 8 --grid 2x1 -q --workers 2 -o out",
          same_model("out", "city"), environment={"HOME": "/proc"}),
]
