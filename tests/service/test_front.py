"""The front before a scripted web process: what passes, what is refused, and halts in spite of that process."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from stereorig.server.front.front import ConnectionLimits
from tests.support.fronted import Fronted, fronted
from tests.support.patience import Deadline
from tests.support.requirements import ROOT

LIMITS = ConnectionLimits(max_open=40, header_s=5.0)
STOP = "/api/v1/stage:stop"
OK = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok"
PATIENCE_S = 30.0
Handler = Callable[[socket.socket, bytes], None]


class Web:
    """A web process: notes what each connection sends, and does what the test says with each head."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.seen: list[bytes] = []
        self.handle: Handler = lambda connection, _: connection.sendall(OK)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen(100)
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            data = b""
            while more := connection.recv(65536):
                data += more
                while b"\r\n\r\n" in data:
                    head, _, data = data.partition(b"\r\n\r\n")
                    self.seen.append(head)
                    self.handle(connection, data)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.path.unlink()


@pytest.fixture
def web(tmp_path: Path) -> Iterator[Web]:
    made = Web(tmp_path / "web.sock")
    yield made
    with contextlib.suppress(OSError):
        made.close()


@pytest.fixture
def front(web: Web) -> Iterator[Fronted]:
    with fronted(web.path, LIMITS) as made:
        yield made


def head(method: str, path: str, *lines: str) -> bytes:
    return "\r\n".join([f"{method} {path} HTTP/1.1", "Host: 127.0.0.1", *lines, "", ""]).encode()


def asked(front: Fronted, data: bytes) -> tuple[int, dict[str, str], bytes]:
    """Send bytes on a connection of their own; return status, headers and body of the first answer."""
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(data)
        return answer_of(connection)


def answer_of(connection: socket.socket) -> tuple[int, dict[str, str], bytes]:
    data = b""
    with contextlib.suppress(ConnectionError):
        while b"\r\n\r\n" not in data and (more := connection.recv(65536)):
            data += more
    start, _, body = data.partition(b"\r\n\r\n")
    lines = start.decode("latin-1").split("\r\n")
    headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines[1:])}
    missing = int(headers.get("content-length", "0")) - len(body)
    parts = [body]
    with contextlib.suppress(ConnectionError):
        while missing > 0 and (more := connection.recv(1 << 20)):
            parts.append(more)
            missing -= len(more)
    return (int(lines[0].split()[1]) if start else 0), headers, b"".join(parts)


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (head("POST", "/a", "Content-Length: 4", "Transfer-Encoding: chunked") + b"0\r\n\r\n", 400),
        (head("POST", "/a", "Content-Length: 4", "Content-Length: 5") + b"12345", 400),
        (head("POST", "/a", "Content-Length: 4, 5") + b"12345", 400),
        (head("POST", "/a", "Content-Length: +4") + b"1234", 400),
        (head("POST", "/a", "Content-Length: 0x4") + b"1234", 400),
        (head("POST", "/a", "Transfer-Encoding: chunked", "Transfer-Encoding: identity") + b"0\r\n\r\n", 400),
        (head("POST", "/a", "Transfer-Encoding: xchunked") + b"0\r\n\r\n", 400),
        (head("POST", "/a", "Transfer-Encoding : chunked") + b"0\r\n\r\n", 400),
        (head("POST", "/a", "Transfer-Encoding: chunked") + b"-1\r\n\r\n", 400),
        (head("POST", "/a", "Transfer-Encoding: chunked") + b"1\r\nab\r\n0\r\n\r\n", 400),
        (head("GET", "/a", "Host: elsewhere"), 400),
        (head("GET", "/a", *[f"X{n}: a" for n in range(300)]), 400),
        (b"GET /a HTTP/1.1\r\n Host: a\r\n\r\n", 400),
        (b"GET /a HTTP/3.1.1\r\nHost: a\r\n\r\n", 400),
    ],
)
def test_a_request_that_two_readers_may_read_in_two_ways_is_refused(
    front: Fronted, web: Web, data: bytes, status: int
) -> None:
    web.handle = lambda _connection, _body: None  # an answer would come before the body's end is seen
    found, headers, body = asked(front, data)
    assert (found, headers["connection"], json.loads(body)["code"]) == (status, "close", "malformed_request")
    assert not any(b"elsewhere" in seen for seen in web.seen)


def test_what_is_sent_in_odd_ways_is_written_in_one_way(front: Fronted, web: Web) -> None:
    odd = b"GET /a?b=%3A HTTP/1.1\nHost: 127.0.0.1\nX-Folded: a\n  b\n\n"
    assert asked(front, odd)[0] == 200
    lines = web.seen[0].split(b"\r\n")
    assert lines[0] == b"GET /a?b=%3A HTTP/1.1"
    assert b"x-folded: a b" in lines
    assert b"\n" not in b"".join(lines)


def test_chunks_are_written_without_their_extensions_and_trailers(front: Fronted, web: Web) -> None:
    bodies: list[bytes] = []
    ended = threading.Event()

    def handle(connection: socket.socket, body: bytes) -> None:
        while not body.endswith(b"0\r\n\r\n"):
            more = connection.recv(65536)
            if not more:  # the front left: there is no body to wait for
                return
            body += more
        bodies.append(body)
        connection.sendall(OK)
        ended.set()

    web.handle = handle
    sent = b"3;name=value\r\nabc\r\n0\r\nHost: elsewhere\r\nX: y\r\n\r\n"
    assert asked(front, head("POST", "/a", "Transfer-Encoding: chunked") + sent)[0] == 200
    assert ended.wait(PATIENCE_S)
    assert bodies == [b"3\r\nabc\r\n0\r\n\r\n"]


def test_requests_in_a_row_are_answered_in_order_on_one_connection(front: Fronted, web: Web) -> None:
    web.handle = lambda connection, _: connection.sendall(OK)
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(b"".join(head("GET", f"/{n}") for n in range(500)))
        data = b""
        while data.count(b"\r\n\r\nok") < 500 and (more := connection.recv(65536)):
            data += more
    assert [seen.split()[1] for seen in web.seen] == [b"/%d" % n for n in range(500)]


def test_the_client_is_known_by_its_address_and_no_client_may_speak_for_the_front(front: Fronted, web: Web) -> None:
    asked(front, head("GET", "/a", "Stereorig-Halted: 1;2", "Connection: keep-alive, X", "Upgrade: h2c"))
    asked(front, head("GET", "/a", "X-Forwarded-For: 192.0.2.7, 127.0.0.1", "X-Forwarded-Proto: https"))
    first, second = (seen.lower().split(b"\r\n") for seen in web.seen)
    assert not [line for line in first if line.startswith((b"stereorig-", b"connection", b"upgrade"))]
    assert {b"x-forwarded-for: 127.0.0.1", b"x-forwarded-proto: http"} <= set(first)
    # loopback is a trusted proxy
    assert {b"x-forwarded-for: 192.0.2.7", b"x-forwarded-proto: https"} <= set(second)


def test_a_client_of_http_1_0_gets_an_answer_without_chunks_and_its_end(front: Fronted, web: Web) -> None:
    chunked = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n2\r\nok\r\n0\r\n\r\n"
    web.handle = lambda connection, _: connection.sendall(chunked)
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(b"GET /a HTTP/1.0\r\n\r\n")
        data = b"".join(iter(lambda: connection.recv(65536), b""))
    assert data.endswith(b"\r\n\r\nok")
    assert b"chunked" not in data.lower()
    assert b"host: \r\n" in web.seen[0] + b"\r\n"


def test_a_client_that_waits_for_100_continue_gets_it_from_the_web_process(front: Fronted, web: Web) -> None:
    web.handle = lambda connection, body: connection.sendall(OK if body else b"HTTP/1.1 100 Continue\r\n\r\n")
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(head("POST", "/a", "Content-Length: 4", "Expect: 100-continue"))
        assert connection.recv(100).startswith(b"HTTP/1.1 100")
        web.handle = lambda _connection, _body: None
        connection.sendall(b"body")
        time.sleep(0.1)
    assert len(web.seen) == 1


def test_an_answer_to_head_has_a_length_and_no_body(front: Fronted, web: Web) -> None:
    web.handle = lambda connection, _: connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 7\r\n\r\n")
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        for _ in range(2):
            connection.sendall(head("HEAD", "/a"))
            answer = connection.recv(65536)
            assert b"7" in answer
            assert answer.endswith(b"\r\n\r\n")


def test_a_websocket_passes_both_ways_and_ends_with_either_side(front: Fronted, web: Web) -> None:
    def handle(connection: socket.socket, early: bytes) -> None:
        connection.sendall(b"HTTP/1.1 101 x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\nhello")
        data = early
        while data.count(b"x") < 1_000_000:
            data += connection.recv(65536)
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)

    web.handle = handle
    upgrade = head("GET", "/live", "Connection: keep-alive, Upgrade", "Upgrade: WebSocket")
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(upgrade + b"x" * 10)
        received = b""
        while b"hello" not in received:
            received += connection.recv(65536)
        connection.sendall(b"x" * 999_990)
        received += b"".join(iter(lambda: connection.recv(65536), b""))
    assert received.endswith(b"hello" + b"x" * 1_000_000)
    assert received.startswith(b"HTTP/1.1 101")


def test_a_large_body_and_a_large_answer_pass_unchanged_and_are_not_gathered(front: Fronted, web: Web) -> None:
    size = 30_000_000
    sent = os.urandom(1000) * (size // 1000)
    stalled = threading.Event()

    def handle(connection: socket.socket, body: bytes) -> None:
        stalled.wait(PATIENCE_S)
        parts, missing = [body], size - len(body)
        while missing:
            parts.append(connection.recv(1 << 20))
            missing -= len(parts[-1])
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % size + b"".join(parts))

    web.handle = handle
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(head("POST", "/a", f"Content-Length: {size}"))
        connection.settimeout(0.5)
        taken = 0
        with contextlib.suppress(TimeoutError):
            while taken < size:
                taken += connection.send(sent[taken : taken + 65536])
        assert taken < 12_000_000  # buffers of the kernel, which loopback lets grow to some MB, and little of the front
        connection.settimeout(PATIENCE_S)
        stalled.set()
        connection.sendall(sent[taken:])
        assert answer_of(connection)[2] == sent


def test_an_unread_body_is_dropped_and_the_connection_stays_open(front: Fronted, web: Web) -> None:
    web.handle = lambda connection, _: connection.sendall(b"HTTP/1.1 404 x\r\nContent-Length: 0\r\n\r\n")
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(head("POST", "/a", "Content-Length: 3000000"))
        assert answer_of(connection)[0] == 404
        connection.sendall(b"x" * 3_000_000)
        web.handle = lambda held, _: held.sendall(OK)
        connection.sendall(head("GET", "/b"))
        assert answer_of(connection)[2] == b"ok"


def test_the_answer_of_a_web_process_that_refuses_the_rest_of_a_body_reaches_the_client(
    front: Fronted, web: Web
) -> None:
    def handle(connection: socket.socket, _body: bytes) -> None:
        connection.recv(1000)
        connection.sendall(b"HTTP/1.1 413 x\r\nContent-Length: 2\r\nConnection: close\r\n\r\nno")
        connection.close()  # most of the body is unread

    web.handle = handle
    body = b"10000\r\n" + b" " * 65536 + b"\r\n"
    for _ in range(30):
        with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
            with contextlib.suppress(ConnectionError):  # the front, too, closes before all is sent
                connection.sendall(head("POST", "/a", "Transfer-Encoding: chunked") + 20 * body)
            with contextlib.suppress(ConnectionResetError):
                assert answer_of(connection)[0] == 413


# -- the web process away


def test_while_the_web_process_is_away_requests_are_refused_and_served_when_it_is_back(
    front: Fronted, web: Web, tmp_path: Path
) -> None:
    web.close()
    status, headers, body = asked(front, head("GET", "/a"))
    assert (status, headers["retry-after"], json.loads(body)["code"]) == (503, "2", "web_process_away")
    assert asked(front, head("POST", STOP))[0] == 200  # a halt is made all the same
    assert front.halts == ["stop"]
    again = Web(tmp_path / "web.sock")
    assert asked(front, head("GET", "/a"))[0] == 200
    again.close()


@pytest.mark.parametrize(("sent", "status"), [(b"", 503), (b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\nhalf", 200)])
def test_a_web_process_that_dies_in_a_request_leaves_no_client_waiting(
    front: Fronted, web: Web, sent: bytes, status: int
) -> None:
    def handle(connection: socket.socket, _body: bytes) -> None:
        connection.sendall(sent)
        connection.shutdown(socket.SHUT_RDWR)

    web.handle = handle
    found, headers, body = asked(front, head("GET", "/a"))
    assert found == status
    # what was begun is cut, so that no client takes a part for the whole
    assert status == 503 or len(body) < int(headers["content-length"])


@pytest.mark.parametrize("more", [b"more", b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nbad"])
def test_what_the_web_process_sends_unasked_answers_no_later_request(front: Fronted, web: Web, more: bytes) -> None:
    web.handle = lambda connection, _: connection.sendall(OK + more)
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        for _ in range(20):
            connection.sendall(head("GET", "/a"))
            assert answer_of(connection)[2] == b"ok"


def test_a_client_that_leaves_is_missed_by_the_web_process_at_once(front: Fronted, web: Web) -> None:
    left = threading.Event()

    def handle(connection: socket.socket, _body: bytes) -> None:
        connection.recv(1)
        left.set()

    web.handle = handle
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(head("GET", "/a"))
        while not web.seen:
            time.sleep(0.01)
    assert left.wait(PATIENCE_S)


# -- halts


@pytest.mark.fault(53)
@pytest.mark.parametrize(
    ("path", "halt"), [(STOP, "stop"), ("/api/v1/stage:abort?now=1", "abort"), ("/api/v1/stage%3Astop", "stop")]
)
def test_a_halt_is_made_before_its_body_comes_and_answered_while_the_web_process_is_stuck(
    front: Fronted, web: Web, path: str, halt: str
) -> None:
    web.handle = lambda _connection, _body: None
    began = time.monotonic()
    status, headers, body = asked(front, head("POST", path, "Content-Length: 100000"))
    assert time.monotonic() - began < 10.0  # 0.15 s, on a machine that does nothing else
    assert front.halts == [halt]
    assert (status, json.loads(body)) == (200, {"stopped": True, "elapsed_ms": 1.5, "cancelled_job": None})
    assert (headers["x-content-type-options"], headers["cache-control"]) == ("nosniff", "no-store")
    assert b"stereorig-halted: 1;1.5" in web.seen[0].split(b"\r\n")


def test_the_usual_reply_to_a_halt_is_that_of_the_web_process(front: Fronted) -> None:
    assert asked(front, head("POST", STOP))[2] == b"ok"
    assert front.halts == ["stop"]


def test_a_halt_that_asks_for_a_websocket_is_a_halt(front: Fronted, web: Web) -> None:
    web.handle = lambda connection, _: connection.sendall(b"HTTP/1.1 101 x\r\nUpgrade: websocket\r\n\r\n")
    assert asked(front, head("POST", STOP, "Connection: Upgrade", "Upgrade: websocket"))[0] == 200
    assert asked(front, head("POST", STOP))[0] == 200  # the front is not held up
    assert front.halts == ["stop", "stop"]


def test_a_halt_is_made_though_its_client_leaves_at_once(front: Fronted, web: Web) -> None:
    with socket.create_connection(("127.0.0.1", front.port), timeout=PATIENCE_S) as connection:
        connection.sendall(head("POST", STOP))
    deadline = Deadline(PATIENCE_S)
    while not (front.halts and web.seen):
        assert deadline.left
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("method", "path"), [("GET", STOP), ("POST", "/api/v1/stage:stopped"), ("POST", "/x/api/v1/stage:stop")]
)
def test_no_other_request_halts(front: Fronted, web: Web, method: str, path: str) -> None:
    assert asked(front, head(method, path))[0] == 200
    assert front.halts == []
    assert b"stereorig-halted" not in web.seen[0]


def test_a_halt_that_is_not_permitted_goes_to_the_web_process_which_refuses_it(front: Fronted, web: Web) -> None:
    front.permits = False
    web.handle = lambda connection, _: connection.sendall(b"HTTP/1.1 403 x\r\nContent-Length: 0\r\n\r\n")
    assert asked(front, head("POST", STOP))[0] == 403
    assert front.halts == []


def test_a_halt_that_fails_is_a_problem_with_its_code(front: Fronted, web: Web) -> None:
    front.fails = True
    status, headers, body = asked(front, head("POST", STOP))
    assert (status, headers["content-type"]) == (503, "application/problem+json")
    assert json.loads(body)["code"] == "stop_failed"
    assert not web.seen


@pytest.mark.fault(53)
@pytest.mark.parametrize(
    "flood",
    [
        head("POST", "/a", "Transfer-Encoding: chunked") + b"1\r\na\r\n" * 200_000,
        head("GET", "/a") * 3_000,
        b"GET /a HTTP/1.1\r\nHost: a\r\n" + b"a:\n" * 300_000,
        head("POST", "/a", "Content-Length: 100000000") + b"x" * 5_000_000,
        head("GET", "/a", "X: " + "a " * 5_000) * 500,
        b"GET /a HTTP/1.1\r\nHost: a\r\n" + b"a:\n" * 5_300 + b"\n",
        head("POST", "/a", "Transfer-Encoding: chunked") + b"0\r\n" + b"a:\n" * 5_000 + b"\n",
    ],
    ids=["chunks", "requests", "headers", "body", "blanks", "all headers", "trailers"],
)
def test_no_request_holds_the_front_so_long_that_a_halt_is_late(front: Fronted, web: Web, flood: bytes) -> None:
    def answer(connection: socket.socket, _body: bytes) -> None:
        if web.seen[-1].startswith(b"GET"):
            connection.sendall(OK)

    web.handle = answer
    turns: list[float] = []

    def turn(began: float) -> None:
        # processor time of the front's thread in one turn of its loop: a busy machine does not lengthen it
        turns.append(time.thread_time() - began)
        front.loop.call_later(0.0005, turn, time.thread_time())

    def send() -> None:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", front.port), timeout=1.0) as one:
            one.sendall(flood)
            while one.recv(65536):
                pass

    gc.collect()
    gc.freeze()  # the front's own heap is small; a round over that of the tests is no part of its turn
    front.loop.call_soon_threadsafe(turn, time.thread_time())
    longest = []
    try:
        for _ in range(5):
            del turns[:]
            flooding = threading.Thread(target=send)
            flooding.start()
            while flooding.is_alive() or not turns:
                assert asked(front, head("POST", STOP))[0] == 200
            longest.append(max(turns[1:], default=0.0))
            if longest[-1] < 0.04:
                break  # 10 ms, on a machine that does nothing else
    finally:
        gc.unfreeze()
    assert set(front.halts) == {"stop"}
    assert min(longest) < 0.04, "what the flood itself costs is the same each time; an interrupt's cost is not"


# -- room


def test_a_process_without_free_descriptors_serves_halts_and_leaves_the_log_alone(web: Web) -> None:
    # in a process of its own, whose limit is set before it begins; more clients than it has descriptors
    source = f"""
import asyncio, socket, sys
from pathlib import Path
sys.path.insert(0, {str(ROOT)!r})
from stereorig.server.front.front import *
async def halt(action): return HaltMade(1, 1.0)
async def main():
    listener = socket.create_server(("127.0.0.1", 0))
    front = Front(upstream=Path({str(web.path)!r}), limits=ConnectionLimits(), halt=halt,
                  may_halt=lambda *_: True, refused=lambda why: None)
    await front.start(listener)
    front._clients.max_open = 1000  # so that it runs out of descriptors indeed
    print(listener.getsockname()[1], flush=True)
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.readline)
    await front.close(1.0)
asyncio.run(main())
"""
    command = ["bash", "-c", f'ulimit -n 64; exec "{sys.executable}" -c "$0"', source]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        made = Fronted(int(process.stdout.readline()))
        clients = []
        began = time.monotonic()
        try:
            for _ in range(150):
                clients.append(socket.create_connection(("127.0.0.1", made.port), timeout=PATIENCE_S))
                clients[-1].sendall(b"GET /a HT")
            for _ in range(5):
                assert asked(made, head("POST", STOP))[0] == 200
            used = float(Path(f"/proc/{process.pid}/stat").read_text().split()[13]) / os.sysconf("SC_CLK_TCK")
        finally:
            for client in clients:
                client.close()
        assert asked(made, head("GET", "/a"))[0] == 200
        made.loop.close()
        took = time.monotonic() - began
        _, errors = process.communicate("\n", timeout=PATIENCE_S)
    assert process.returncode == 0
    assert len(errors.splitlines()) <= 2 + took, errors
    assert used < 5.0  # of processor time: it did not spin


def test_the_front_loads_nothing_heavy() -> None:
    command = "import sys; import stereorig.server.front.front; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", command], cwd=ROOT, capture_output=True, text=True, check=True)
    heavy = {"fastapi", "starlette", "uvicorn", "numpy", "pydantic", "matplotlib", "anyio", "httpx"}
    assert not heavy & {name.partition(".")[0] for name in loaded.stdout.split()}
    assert re.search(r"\bh11\b", loaded.stdout)
