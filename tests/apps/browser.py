"""Headless Chromium for tests of pages, on a server of the test's own."""

import base64
import shutil
import subprocess
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from clsplat.io.photos.images import read_image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
)
PATIENCE = 120  # seconds, for a page in software on a busy machine
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")


@contextmanager
def chromium(folder, address, size=(1280, 800)):
    """Chromium with an address open, until the block ends."""
    browser = subprocess.Popen(
        [CHROMIUM, *FLAGS, f"--user-data-dir={folder / 'profile'}", f"--window-size={size[0]},{size[1]}", address],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        browser.terminate()
        browser.wait(20)


def answer_of(folder, page, script, frame=(640, 480)):
    """What a script returns that runs in a page, which is shown in a frame of that size.

    Parameters
    ----------
    page : HTML.
    script : the body of an async function of `page`, the window of the frame, whose result is text.
    """
    outer = f"""<!doctype html><body style="margin: 0">
<iframe src="page" width={frame[0]} height={frame[1]} style="border: 0"></iframe><script>
onload = async () => {{
  const page = document.querySelector("iframe").contentWindow;
  const until = async (ready) => {{
    while (!ready()) await new Promise((wake) => setTimeout(wake, 50));
  }};
  let answer;
  try {{ answer = await (async () => {{ {script} }})(); }}
  catch (error) {{ answer = "error: " + error.message; }}
  fetch("answer", {{method: "POST", body: answer}});
}};</script>"""
    answers, arrived = [], threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            body = {"/": outer, "/page": page}.get(self.path, "").encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def do_POST(self):
            answers.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self.send_response(204)
            self.end_headers()
            arrived.set()

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with chromium(folder, f"http://127.0.0.1:{server.server_port}/"):
            assert arrived.wait(PATIENCE), "the page gave no answer"
    finally:
        server.shutdown()
        server.server_close()
    assert not answers[0].startswith("error: "), answers[0]
    return answers[0]


def picture_of(data_url):
    """float[H, W, 3], 0 to 1: the picture of a canvas's data URL."""
    return read_image(base64.b64decode(data_url.partition(",")[2])) / np.float32(255)
