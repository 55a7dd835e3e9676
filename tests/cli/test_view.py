"""`clsplat view` and `clsplat train --view`, as a person starts them."""

import json
import re
import signal
import subprocess
import sys
import threading
from urllib.error import URLError
from urllib.request import urlopen

import pytest

from tests.data.tiny_training import CITY
from tests.signals import listen, needs_signals


class Started:
    """The command, whose first line says where the page is; it is ended with the block."""

    def __init__(self, *arguments):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "clsplat", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=listen,
        )

    def __enter__(self):
        watchdog = threading.Timer(300, self.process.kill)
        watchdog.daemon = True
        watchdog.start()
        self.address = re.search(r"http://127\.0\.0\.1:\d+/\S+/", self.process.stdout.readline())[0]
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()


def read(address):
    with urlopen(address, timeout=120) as response:
        return response.read().decode()


@needs_signals
@pytest.mark.slow
def test_train_and_view(tmp_path):
    run, options = tmp_path / "run", ("-n", 100, "-r", 8, "-q")
    with Started("train", CITY, "-o", run, *options, "--view") as training:
        page = read(training.address)
        assert "<title>city" in page and "{{" not in page
        status = json.loads(read(training.address + "status"))
        assert status["phase"] and "losses" in status
        assert training.process.wait(300) == 0
        with pytest.raises(URLError):  # the page ends with its training
            read(training.address)
    with Started("view", run) as view:
        assert "<title>city: run" in read(view.address)
        assert json.loads(read(view.address + "status"))["gaussians"] > 1000
        view.process.send_signal(signal.SIGINT)
        out, err = view.process.communicate(timeout=300)
        assert (view.process.returncode, out, err) == (0, "closed\n", "")
