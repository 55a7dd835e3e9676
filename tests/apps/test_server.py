"""Who may see a live page: this machine, with the token; and what a request may ask for."""

import http.client
import json
import socket
import threading

import numpy as np
import pytest

from clsplat.apps import server as server_module
from clsplat.apps.server import FrameRequest, FrameRequests, ViewServer, camera_of
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.photos.images import read_image

CAMERA = {
    "width": 8,
    "height": 6,
    "focal": [5, 5],
    "centre": [4, 3],
    "position": [1, 2, 3],
    "rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
}


@pytest.fixture
def requests():
    return FrameRequests()


@pytest.fixture
def server(requests):
    with ViewServer("<h1>page</h1>", requests, lambda: {"loss": np.float32(0.5)}) as opened:
        yield opened


def answer(server, path, method="GET", body=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.request(method, path, body, headers)
    response = connection.getresponse()
    return response.status, response.read(), response


def test_the_address_has_the_page_and_the_status(server):
    assert server._server.server_address[0] == "127.0.0.1", "it is bound to this machine"
    assert server.address == f"http://127.0.0.1:{server.port}/{server.token}/"
    status, body, response = answer(server, f"/{server.token}/")
    assert (status, body) == (200, b"<h1>page</h1>")
    assert "default-src 'none'" in response.getheader("Content-Security-Policy")
    assert json.loads(answer(server, f"/{server.token}/status")[1]) == {"loss": 0.5}
    assert answer(server, f"/{server.token}/else")[0] == 404


@pytest.mark.one_in(2)
@pytest.mark.parametrize("path", ["/", "/status", "/frame", "//", "/{}x/", "/{}".format("a" * 32)])
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_without_the_token_all_is_refused(server, requests, path, method):
    path = path.format(server.token)
    assert answer(server, path, method, json.dumps(CAMERA))[0] == 403
    assert requests.empty()


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", ""])
def test_under_another_name_all_is_refused(server, requests, host):
    for method, name in (("GET", ""), ("POST", "frame")):
        status, _, _ = answer(
            server, f"/{server.token}/{name}", method, json.dumps(CAMERA), Host=host.format(port=server.port)
        )
        assert status == 403
    assert requests.empty()
    assert answer(server, f"/{server.token}/", Host=f"localhost:{server.port}")[0] == 200


def test_a_port_that_is_taken_is_named(server, requests):
    with pytest.raises(InputError, match=f"--port {server.port}: cannot be opened"):
        ViewServer("", requests, dict, server.port)


def answering(requests, act):
    threading.Thread(target=lambda: act(requests.next(5)), daemon=True).start()


def test_a_frame_is_the_image_that_was_drawn(server, requests):
    image = np.zeros((6, 8, 3), np.float32)
    image[:, :, 1] = np.linspace(0, 1, 8)
    seen = []

    def draw(request):
        seen.append(request.camera)
        request.answer.set_result(image)

    answering(requests, draw)
    status, body, response = answer(server, f"/{server.token}/frame", "POST", json.dumps(CAMERA))
    assert (status, response.getheader("Content-Type")) == (200, "image/jpeg")
    assert np.abs(read_image(body) / 255.0 - image).max() < 0.05
    assert np.allclose(seen[0].position, [1, 2, 3]) and (seen[0].width, seen[0].height) == (8, 6)


def test_a_problem_and_a_depth_are_told(server, requests):
    answering(requests, lambda request: request.attempt(lambda: 1 / 0))
    status, body, _ = answer(server, f"/{server.token}/frame", "POST", json.dumps(CAMERA))
    assert status == 500 and b"ZeroDivisionError" in body

    def measure(request):
        assert request.wants_depth
        request.answer.set_result(2.5)

    answering(requests, measure)
    assert answer(server, f"/{server.token}/depth", "POST", json.dumps(CAMERA))[1] == (b'{"depth": 2.5}')


def test_nobody_draws_a_frame_that_nobody_waits_for(server, requests, monkeypatch):
    monkeypatch.setattr(server_module, "PATIENCE", 0.05)
    assert answer(server, f"/{server.token}/frame", "POST", json.dumps(CAMERA))[0] == 503
    assert not requests.empty() and requests.next() is None


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 0},
        {"width": 5000},
        {"width": 4096, "height": 4096},
        {"width": 8.5},
        {"width": True},
        {"focal": [5]},
        {"focal": [5, -5]},
        {"focal": [1e-300, 5]},
        {"focal": [5, 0]},
        {"rotation": [[1, 0, 0], [0, 0, 1], [0, 1, 0]]},
        {"rotation": [[-1, 0, 0], [0, -1, 0], [0, 0, -1]]},
        {"focal": [5, "x"]},
        {"position": None},
        {"position": [float("nan"), 0, 0]},
        {"rotation": [[1, 0, 0]]},
        {"rotation": np.zeros((3, 3)).tolist()},
        {"centre": [[4, 3]]},
        {"rotation": {}},
    ],
)
def test_what_is_no_camera_is_refused(changes):
    with pytest.raises((ValueError, InputError)):
        camera_of(json.dumps({**CAMERA, **changes}).encode())


def test_nobody_waits_after_the_end(requests):
    request = FrameRequest(Camera(8, 6, (5, 5), (4, 3), np.eye(3), np.zeros(3)))
    with ViewServer("", requests, dict):
        requests.put(request)
    assert isinstance(request.answer.exception(0), InputError)


def connected(server):
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=30)
    connection.settimeout(30)
    return connection


def is_closed(connection, seconds):
    connection.settimeout(seconds)
    try:
        return connection.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("begin", [b"", b"GET / HTTP/1.1\r\n", b"POST / HTTP/1.1\r\nX: "])
def test_an_unfinished_request_is_closed(server, monkeypatch, begin):
    assert server_module.IDLE_SECONDS == server_module._Handler.timeout == 15
    monkeypatch.setattr(server_module._Handler, "timeout", 0.1)
    with connected(server) as connection:
        connection.send(begin)
        assert is_closed(connection, 30)
