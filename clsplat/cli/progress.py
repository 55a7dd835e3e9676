"""The progress line of a training."""

import sys

from tqdm import tqdm

LINE = "{n_fmt}/{total_fmt} {bar:20} {rate_fmt}{postfix}, {remaining} left"
LOG_LINE = "{n_fmt}/{total_fmt} {rate_fmt}{postfix}, {remaining} left"


class _LogLines(tqdm):
    """A bar for files and pipes: a line now and then instead of one that is redrawn."""

    @staticmethod
    def status_printer(file):
        def write(text):
            if text.strip():
                print(text.strip(), file=file, flush=True)
        return write


class Progress:
    """Shows iteration, it/s, loss, level, gaussians, memory and time left; a context manager.

    stop_at: the iteration at which this run stops before its end, or 0. The clock starts at the
    first call, so that loading and the first compilation do not count as speed.
    """

    def __init__(self, stop_at=0, file=None):
        self._stop_at = stop_at
        self._file = sys.stderr if file is None else file
        self._bar = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._bar is not None:
            self._bar.close()

    def __call__(self, iteration, total, loss, gaussians, memory_bytes, level):
        if self._bar is None:
            self._bar = self._start(iteration)
        self._bar.total = min(self._stop_at or total, total)
        self._bar.set_postfix_str(
            f"loss {loss:.4f}, level {level:g}, {gaussians:,} gaussians, "
            f"{memory_bytes / 2**20:,.0f} MiB", refresh=False)
        self._bar.update(iteration - self._bar.n)

    def message(self, text):
        """Print a line above the bar."""
        say = tqdm.write if self._file.isatty() else print
        say(text, file=self._file)

    def _start(self, iteration):
        settings = {"total": None, "initial": iteration, "unit": "it", "file": self._file}
        if self._file.isatty():
            return tqdm(bar_format=LINE, dynamic_ncols=True, **settings)
        return _LogLines(bar_format=LOG_LINE, mininterval=10, maxinterval=1e9, **settings)
