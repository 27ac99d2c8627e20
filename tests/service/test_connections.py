"""Slow, many and half-finished connections, on raw sockets: each has its time, and a stop is served all the same."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import socket
import threading
import time
from collections.abc import Iterator

import httpx
import pytest

from stereorig.server.api.app import create_app
from stereorig.server.front.messages import ConnectionLimits
from stereorig.server.workflows.service import Service
from tests.support.fronted import Fronted, fronted, web_process
from tests.support.patience import Deadline
from tests.support.service_rig import tiny_config, wait_for_rig

API = "/api/v1"
LIMITS = ConnectionLimits(max_open=12, header_s=1.0, body_bytes_per_s=1000.0, body_s=1.0, unread_s=2.0)
END_S = 30.0  # a second would do on a machine that does nothing else


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(tiny_config(), tmp_path_factory.mktemp("connections") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def front(own: Service, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fronted]:
    web = tmp_path_factory.mktemp("web") / "web.sock"
    # a small buffer, so that an unread answer waits in the front, and not in the kernel
    app = create_app(own, close_service=False)
    with web_process(app, web), fronted(web, LIMITS, send_buffer=16 * 1024) as made:
        with httpx.Client(base_url=f"http://127.0.0.1:{made.port}", timeout=60.0, trust_env=False) as client:
            wait_for_rig(client)
        yield made
        own.stop_streams()


@pytest.fixture
def port(front: Fronted) -> int:
    return front.port


def dial(port: int) -> socket.socket:
    made = socket.create_connection(("127.0.0.1", port), timeout=END_S)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 * 1024)
    return made


def request(method: str, path: str, *lines: str) -> bytes:
    return "\r\n".join([f"{method} {path} HTTP/1.1", "Host: 127.0.0.1", *lines, "", ""]).encode()


def ended(connection: socket.socket) -> bool:
    """Whether the other side ends it before our patience does."""
    try:
        while connection.recv(65536):
            pass
    except ConnectionError:
        return True
    except TimeoutError:
        return False
    return True


def test_headers_that_never_end_end_the_connection(front: Fronted, port: int) -> None:
    before = front.refused.count("slow_headers")
    silent, dripping = dial(port), dial(port)
    stop = threading.Event()

    def drip() -> None:
        with contextlib.suppress(OSError):
            dripping.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n")
            while not stop.wait(0.2):
                dripping.sendall(b"X-A: b\r\n")

    thread = threading.Thread(target=drip)
    thread.start()
    try:
        assert ended(silent)
        assert ended(dripping)
    finally:
        stop.set()
        thread.join()
        silent.close()
        dripping.close()
    assert front.refused.count("slow_headers") >= before + 2


def test_a_connection_waits_longer_than_its_client(port: int) -> None:
    # httpx takes up a connection that was idle for up to 5 s; ended in that moment, its request would be lost
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=END_S)) as connection:
        connection.request("GET", "/healthz")
        assert connection.getresponse().read()
        held = connection.sock
        time.sleep(7.0)
        connection.request("GET", "/healthz")
        assert connection.getresponse().status == 200
        assert connection.sock is held


def test_a_second_request_on_a_connection_has_its_time_too(port: int) -> None:
    with dial(port) as connection:
        connection.sendall(request("GET", "/healthz"))
        assert connection.recv(65536).startswith(b"HTTP/1.1 200")
        connection.sendall(b"GET /healthz HT")
        assert ended(connection)


def test_a_body_that_comes_by_the_drop_ends_the_connection(front: Fronted, port: int) -> None:
    before = front.refused.count("slow_body")
    with dial(port) as connection:
        connection.sendall(request("POST", f"{API}/tests", "Content-Type: application/json", "Content-Length: 1000000"))
        stop = threading.Event()

        def drip() -> None:
            with contextlib.suppress(OSError):
                while not stop.wait(0.1):
                    connection.sendall(b" ")

        thread = threading.Thread(target=drip)
        thread.start()
        try:
            assert ended(connection)
        finally:
            stop.set()
            thread.join()
    assert front.refused.count("slow_body") == before + 1


def test_a_body_at_a_fair_pace_may_take_longer_than_that(port: int) -> None:
    body = b'{"name": "slow but steady"}' + b" " * 40_000
    with dial(port) as connection:
        head = ("Content-Type: application/json", f"Content-Length: {len(body)}", "Connection: close")
        connection.sendall(request("POST", f"{API}/tests", *head))
        for start in range(0, len(body), 1000):  # about two seconds and a half
            connection.sendall(body[start : start + 1000])
            time.sleep(0.06)
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    assert answer.startswith(b"HTTP/1.1 201"), answer[:200]


def test_an_unread_answer_ends_the_connection_and_holds_little_memory(own: Service, front: Fronted, port: int) -> None:
    before = front.refused.count("unread")
    with dial(port) as connection:
        connection.sendall(request("GET", f"{API}/cameras/cam1/stream.mjpg?rate_hz=30"))
        deadline = Deadline(END_S)
        while front.refused.count("unread") == before:
            assert deadline.left
            time.sleep(0.1)
    deadline = Deadline(END_S)
    while own.streams.counts()["live_view"]:  # and its slot is free again
        assert deadline.left
        time.sleep(0.05)


def test_idle_connections_give_way_to_new_ones(front: Fronted, port: int) -> None:
    idle = []
    for _ in range(LIMITS.max_open):
        idle.append(dial(port))
        idle[-1].sendall(request("GET", "/healthz"))
        assert idle[-1].recv(65536).startswith(b"HTTP/1.1 200")
    try:
        with dial(port) as newcomer:
            newcomer.sendall(request("GET", "/healthz"))
            assert newcomer.recv(65536).startswith(b"HTTP/1.1 200")
        assert front.refused.count("too_many") >= 1
    finally:
        for connection in idle:
            connection.close()


@pytest.mark.fault(50)
def test_where_all_are_busy_live_views_give_way_and_a_stop_is_served(front: Fronted, port: int) -> None:
    def opened(path: str) -> socket.socket:
        connection = dial(port)
        connection.sendall(request("GET", path))
        assert connection.recv(64).startswith(b"HTTP/1.1 200"), path
        return connection

    view = opened(f"{API}/cameras/cam1/stream.mjpg?rate_hz=1")
    busy = [opened(f"{API}/events") for _ in range(LIMITS.max_open - 1)]
    try:
        with dial(port) as newcomer:
            newcomer.sendall(request("GET", "/healthz"))
            assert newcomer.recv(65536).startswith(b"HTTP/1.1 200")
            assert ended(view)  # a mere reader went first
        busy.append(opened(f"{API}/events"))  # now all work
        with dial(port) as crowded:
            crowded.sendall(request("POST", f"{API}/stage:stop", "Content-Length: 0"))
            assert crowded.recv(64).startswith(b"HTTP/1.1 200")
        assert front.halts == ["stop"]
    finally:
        for connection in [view, *busy]:
            connection.close()


def test_where_all_work_a_newcomer_is_refused_in_words(port: int) -> None:
    busy = []
    try:
        for _ in range(LIMITS.max_open + 1):
            busy.append(dial(port))
            busy[-1].sendall(request("GET", f"{API}/events"))
            if len(busy) <= LIMITS.max_open:
                assert busy[-1].recv(64).startswith(b"HTTP/1.1 200")
        answer = b"".join(iter(lambda: busy[-1].recv(65536), b""))  # and it is closed
        assert answer.startswith(b"HTTP/1.1 503"), answer
        assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "too_many_connections"
    finally:
        for connection in busy:
            connection.close()


@pytest.mark.parametrize(
    "data",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"GET /\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\nGET",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"a" * 200_000,
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: -1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: a\x00b\r\n\r\n",
        b"\r\n\r\n\r\n\x00\x00",
    ],
)
def test_what_is_no_proper_http_is_refused_and_the_connection_ends(port: int, data: bytes) -> None:
    with dial(port) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(data)
        answer = b""
        with contextlib.suppress(ConnectionError):
            answer = b"".join(iter(lambda: connection.recv(65536), b""))
    status = re.match(rb"HTTP/1.1 (\d+)", answer)
    assert status is None or status[1] in (b"400", b"403", b"404"), answer[:300]
    if status is not None:
        assert b"application/problem+json" in answer
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60.0, trust_env=False) as client:
        assert client.get("/healthz").status_code == 200
