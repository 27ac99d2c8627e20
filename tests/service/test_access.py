"""Keys, roles, cookies, limits, security headers and the audit log, over HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import os
import shutil
import socket
import ssl
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn

from stereorig.core.errors import FileFormatError, InputError, StorageError
from stereorig.server.api.app import create_app
from stereorig.server.api.protocol.auth import AccessRules, Door, RateLimit
from stereorig.server.cli.main import main
from stereorig.server.cli.operation.serve import check_host, check_tls, tls_is_missing
from stereorig.server.formats import disk
from stereorig.server.http import shutout
from stereorig.server.http.access import KeyFile
from stereorig.server.http.rights import LOOPBACK_NAMES, Callers, HaltRights
from stereorig.server.http.sessions import SessionFile, forget_sessions
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline, busy
from tests.support.requirements import ROOT, missing
from tests.support.service_rig import TINY, tiny_config, wait_for_rig

API = "/api/v1"


@contextlib.contextmanager
def guarded(service: Service, *, required: bool = True) -> Iterator[str]:
    """Serve with keys required, unless told otherwise; yields the URL."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen()  # who comes before the server is up waits in the queue
    app = create_app(service, keys_required=required, close_service=False)
    server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=2))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        service.stop_streams()
        server.should_exit = True
        thread.join(10.0)
        listener.close()


@pytest.fixture(autouse=True)
def counted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shut nobody out but in the tests of just that: the others share one service, and have ten wrong keys together."""
    if not any(60 in mark.args for mark in request.node.iter_markers("fault")):
        monkeypatch.setattr(shutout, "MOST_WRONG", 10_000)


@pytest.fixture(scope="module")
def keys(service: Service) -> dict[str, str]:
    """A key of each role."""
    file = KeyFile(service.folder.root)
    return {role: file.add(f"{role}-key", role) for role in ("viewer", "operator", "admin")}  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def url(service: Service, keys: dict[str, str]) -> Iterator[str]:
    with guarded(service) as made:
        yield made


@pytest.fixture
def asks(url: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=url, trust_env=False, timeout=30.0) as made:
        yield made


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


def test_without_a_key_nothing_is_told_but_that_the_service_lives(asks: httpx.Client) -> None:
    answer = asks.get(f"{API}/rig")
    assert answer.status_code == 401
    assert answer.json()["code"] == "key_missing"
    assert answer.headers["www-authenticate"] == "Bearer"
    assert asks.post(f"{API}/tests", json={"name": "x"}).status_code == 401
    assert asks.get(f"{API}/events").status_code == 401
    assert asks.get(f"{API}/cameras/cam1/stream.mjpg").status_code == 401
    assert asks.get("/metrics").status_code == 401
    assert asks.get(f"{API}/openapi.json").status_code == 401
    assert asks.get("/healthz").status_code == 200


@pytest.mark.parametrize("header", ["Bearer wrong", "Bearer", "Basic abc", "bearer sr_" + "A" * 43, "x" * 5000])
def test_a_wrong_key_is_refused_even_where_none_is_needed(asks: httpx.Client, header: str) -> None:
    answer = asks.get(f"{API}/rig", headers={"Authorization": header})
    assert answer.status_code == 401
    assert answer.json()["code"] == "key_wrong"


def test_each_role_may_do_its_part(asks: httpx.Client, keys: dict[str, str]) -> None:
    for role in keys:
        assert asks.get(f"{API}/rig", headers=bearer(keys[role])).status_code == 200
        assert asks.get(f"{API}/session", headers=bearer(keys[role])).json() == {"name": f"{role}-key", "role": role}
        # any user who sees that something goes wrong may stop it
        assert asks.post(f"{API}/stage:stop", headers=bearer(keys[role])).status_code == 200
    refused = asks.post(f"{API}/tests", json={"name": "x"}, headers=bearer(keys["viewer"]))
    assert refused.status_code == 403
    assert refused.json()["code"] == "role_too_low"
    assert asks.post(f"{API}/tests", json={"name": "x"}, headers=bearer(keys["operator"])).status_code == 201
    assert asks.delete(f"{API}/tests/t000001-abcdef", headers=bearer(keys["operator"])).status_code == 403
    assert asks.delete(f"{API}/tests/t000001-abcdef", headers=bearer(keys["admin"])).status_code in (404, 405)


def test_the_pages_cookie_stands_for_its_key(asks: httpx.Client, keys: dict[str, str]) -> None:
    assert asks.post(f"{API}/session").status_code == 401
    answer = asks.post(f"{API}/session", headers=bearer(keys["viewer"]))
    assert answer.status_code == 200
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert asks.get(f"{API}/rig").status_code == 200  # the client keeps the cookie
    assert asks.post(f"{API}/tests", json={"name": "x"}).status_code == 403
    # a page of another site cannot use it
    assert asks.post(f"{API}/stage:stop", headers={"Origin": "http://elsewhere.example"}).status_code == 403
    token = asks.cookies["stereorig_session"]
    assert asks.delete(f"{API}/session").status_code == 204
    for ended in (token, "guessed", "a=b; c"):
        asks.cookies.clear()
        assert asks.get(f"{API}/rig", headers={"Cookie": f"stereorig_session={ended}"}).status_code == 401


def test_keys_come_and_go_while_the_service_runs(
    asks: httpx.Client, service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    data = ["--data", str(service.folder.root)]
    assert main(["keys", "add", "script 1", "--role", "operator", *data]) == 1
    assert main(["keys", "add", "script-1", "--role", "operator", *data]) == 0
    key = capsys.readouterr().out.strip().splitlines()[-1]
    assert asks.get(f"{API}/session", headers=bearer(key)).json()["name"] == "script-1"
    assert main(["keys", "add", "script-1", "--role", "viewer", *data]) == 1
    assert main(["keys", "list", *data]) == 0
    shown = capsys.readouterr().out
    assert "script-1  operator" in shown
    assert key not in shown
    assert main(["keys", "remove", "script-1", *data]) == 0
    assert asks.get(f"{API}/session", headers=bearer(key)).status_code == 401
    assert main(["keys", "remove", "script-1", *data]) == 1


def test_keys_lie_hashed_and_only_their_owner_reads_them(service: Service, keys: dict[str, str]) -> None:
    path = service.folder.root / "keys.json"
    text = path.read_text()
    assert not any(key in text for key in keys.values())
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_broken_key_file_lets_nobody_in(tmp_path: Path) -> None:
    file = KeyFile(tmp_path)
    key = file.add("one", "admin")
    (tmp_path / "keys.json").write_text('{"keys": [{"name": "one"}]}')
    with pytest.raises(FileFormatError) as caught:
        file.who(key)
    assert caught.value.code == "keys_unreadable"


def test_other_addresses_than_loopback_need_a_key(tmp_path: Path) -> None:
    for host in ("0.0.0.0", "192.0.2.7", "::", "lab-pc"):
        with pytest.raises(InputError) as caught:
            check_host(host, KeyFile(tmp_path))
        assert caught.value.code == "bind_needs_keys"
    for host in ("127.0.0.1", "localhost", "::1"):
        check_host(host, KeyFile(tmp_path))
    KeyFile(tmp_path).add("one", "viewer")
    check_host("0.0.0.0", KeyFile(tmp_path))


def test_every_answer_has_the_headers_that_browsers_heed_and_a_number(asks: httpx.Client, keys: dict[str, str]) -> None:
    for answer in (
        asks.get("/"),
        asks.get(f"{API}/rig"),
        asks.get(f"{API}/nothing", headers=bearer(keys["viewer"])),
        asks.get("/healthz", headers={"Host": "elsewhere.example"}),
    ):
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["x-frame-options"] == "DENY"
        assert "default-src 'self'" in answer.headers["content-security-policy"]
        assert len(answer.headers["x-request-id"]) == 16
    given = asks.get("/healthz", headers={"X-Request-Id": "test-17.a"})
    assert given.headers["x-request-id"] == "test-17.a"
    assert asks.get("/healthz", headers={"X-Request-Id": "a b\tc"}).headers["x-request-id"] != "a b\tc"


def test_every_change_leaves_a_line_in_the_audit_log(
    asks: httpx.Client, service: Service, keys: dict[str, str]
) -> None:
    log = service.folder.root / "audit.log"
    before = len(log.read_text().splitlines())
    asks.post(f"{API}/stage:stop", headers={**bearer(keys["viewer"]), "X-Request-Id": "stop-1"})
    asks.post(f"{API}/stage/moves", json={"positions_mm": {"1": 99.0}}, headers=bearer(keys["operator"]))
    asks.post(f"{API}/tests", json={"name": "x"})
    asks.get(f"{API}/rig", headers=bearer(keys["viewer"]))
    lines = [json.loads(line) for line in log.read_text().splitlines()[before:]]
    assert [(line["who"], line["path"], line["status"]) for line in lines] == [
        ("viewer-key", f"{API}/stage:stop", 200),
        ("operator-key", f"{API}/stage/moves", 422),
        (None, f"{API}/tests", 401),
    ]
    assert lines[0]["request_id"] == "stop-1"
    assert all(line["address"] == "127.0.0.1" and line["utc"].endswith("Z") for line in lines)
    assert not any(key in log.read_text() for key in keys.values())


def test_a_client_that_asks_without_end_is_slowed_and_a_stop_never(tmp_path: Path) -> None:
    text = TINY.replace("compute_queue = 2", "compute_queue = 2\nrequests_per_s = 2.0")
    from stereorig.server.config.rig_file import parse_config

    made = Service(parse_config(text), tmp_path / "data").start()
    key = KeyFile(made.folder.root).add("one", "operator")
    try:
        with guarded(made) as url, httpx.Client(base_url=url, trust_env=False, timeout=30.0) as client:
            answers = [client.get("/healthz") for _ in range(40)]
            slowed = [answer for answer in answers if answer.status_code == 429]
            assert len(slowed) >= 10
            assert slowed[0].json()["code"] == "too_many_requests"
            assert int(slowed[0].headers["retry-after"]) >= 1
            assert client.post(f"{API}/stage:stop", headers=bearer(key)).status_code == 200
    finally:
        made.close()


def test_the_limit_lets_so_many_through_and_refills(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    limit = RateLimit(per_s=2.0, burst=3.0)
    assert [limit.wait_s("a") for _ in range(3)] == [0.0, 0.0, 0.0]
    assert limit.wait_s("a") == pytest.approx(0.5)
    assert limit.wait_s("b") == 0.0
    now[0] = 0.5
    assert limit.wait_s("a") == 0.0
    assert limit.wait_s("a") == pytest.approx(0.5)


def test_tls_needs_a_certificate_and_its_key(tmp_path: Path) -> None:
    check_tls(None, None)
    (tmp_path / "x.pem").write_text("no certificate")
    for pair in ((tmp_path / "x.pem", None), (None, tmp_path / "x.pem"), (tmp_path / "x.pem", tmp_path / "x.pem")):
        with pytest.raises(InputError) as caught:
            check_tls(*pair)
        assert caught.value.code == "tls_unusable"


def test_keys_on_a_network_without_tls_are_warned_about(tmp_path: Path) -> None:
    for host in ("0.0.0.0", "192.0.2.7", "::", "lab-pc"):
        assert tls_is_missing(host, None)
        assert not tls_is_missing(host, tmp_path / "cert.pem")
    for host in ("127.0.0.1", "localhost", "::1"):
        assert not tls_is_missing(host, None)  # no other machine receives it there
    KeyFile(tmp_path / "data").path.parent.mkdir()
    KeyFile(tmp_path / "data").add("one", "viewer")
    (tmp_path / "rig.toml").write_text(TINY)
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "stereorig.server.cli",
            "serve",
            "--config",
            str(tmp_path / "rig.toml"),
            "--port",
            "0",
            "--host",
            "0.0.0.0",
            "--data",
            str(tmp_path / "data"),
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    try:
        assert process.stdout is not None
        assert "stereorig serves" in process.stdout.readline()
    finally:
        process.terminate()
        _, printed = process.communicate(timeout=60)
    assert "unencrypted" in printed


def test_it_serves_by_https(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        missing("the program openssl (apt-get install openssl)")
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    made = subprocess.run(
        [
            "openssl",
            "req",
            "-x509",
            "-newkey",
            "rsa:2048",
            "-nodes",
            "-keyout",
            str(key),
            "-out",
            str(certificate),
            "-days",
            "2",
            "-subj",
            "/CN=localhost",
            "-addext",
            "subjectAltName=IP:127.0.0.1",
        ],
        capture_output=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    (tmp_path / "rig.toml").write_text(TINY)
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "stereorig.server.cli",
            "serve",
            "--config",
            str(tmp_path / "rig.toml"),
            "--port",
            "0",
            "--data",
            str(tmp_path / "data"),
            "--tls-cert",
            str(certificate),
            "--tls-key",
            str(key),
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    try:
        assert process.stdout is not None
        url = next(word for word in process.stdout.readline().split() if word.startswith("https://"))
        answer = httpx.get(
            f"{url}/healthz", verify=ssl.create_default_context(cafile=certificate), trust_env=False, timeout=30.0
        )
        assert answer.status_code == 200
    finally:
        process.terminate()
        process.communicate(timeout=20)


def test_on_loopback_a_key_is_required_only_by_the_rig_file(tmp_path: Path) -> None:
    config = tiny_config(compute_queue="compute_queue = 2\nrequire_key = true")
    made = Service(config, tmp_path / "data").start()
    try:
        app = create_app(made, close_service=False)
        listener = socket.socket()
        listener.bind(("127.0.0.1", 0))
        listener.listen()  # who comes before the server is up waits in the queue
        server = uvicorn.Server(uvicorn.Config(app, log_level="error"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        try:
            assert httpx.get(f"{url}{API}/rig", trust_env=False, timeout=30.0).status_code == 401
        finally:
            made.stop_streams()
            server.should_exit = True
            thread.join(10.0)
            listener.close()
    finally:
        made.close()


def test_the_rights_need_no_web_framework() -> None:
    heavy = {"fastapi", "starlette", "pydantic", "pydantic_core", "numpy", "uvicorn"}
    code = f"import sys, stereorig.server.http.rights; assert not {heavy!r} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, timeout=60)


PAGE = {"Host": "rig.example:8000"}


@pytest.mark.fault(45)
@pytest.mark.parametrize(
    ("headers", "scheme", "stop"),
    [
        (PAGE, "http", True),
        ({**PAGE, "Origin": "http://rig.example:8000"}, "http", True),
        ({**PAGE, "Origin": "http://rig.example:8001"}, "http", False),
        ({**PAGE, "Origin": "http://rig.example"}, "http", False),
        ({**PAGE, "Origin": "http://127.0.0.1:8000"}, "http", False),
        ({**PAGE, "Origin": "http://rig.example:8000"}, "https", False),
        ({**PAGE, "Origin": "ws://rig.example:8000"}, "http", False),
        ({**PAGE, "Origin": "https://board.example"}, "http", True),
        ({**PAGE, "Origin": "https://board.example:444"}, "http", False),
        ({"Host": "rig.example", "Origin": "http://rig.example"}, "http", True),
        ({"Host": "rig.example", "Origin": "http://rig.example"}, "https", False),
        ({"Host": "rig.example", "Origin": "http://rig.example"}, "", False),
        ({"Host": "rig.example", "Origin": "http://rig.example", "X-Forwarded-Proto": "https"}, "http", False),
        # a proxy that speaks https, and passes on by http
        ({"Host": "rig.example", "Origin": "https://rig.example"}, "http", True),
        ({"Host": "rig.example:443", "Origin": "https://rig.example"}, "http", True),
        ({"Host": "rig.example:8443", "Origin": "https://rig.example:8443"}, "http", True),
        ({**PAGE, "Sec-Fetch-Site": "same-site"}, "http", False),
        ({"Host": "elsewhere.example"}, "http", False),
        ({}, "http", False),
    ],
)
def test_the_stop_of_the_front_comes_from_the_services_own_pages_alone(
    tmp_path: Path, headers: dict[str, str], scheme: str, stop: bool
) -> None:
    rights = HaltRights(
        tmp_path, hosts=frozenset({"rig.example", "127.0.0.1", "https://board.example"}), keys_required=False
    )
    sent = [(name.encode(), value.encode()) for name, value in headers.items()]
    assert rights.permits("stop", sent, scheme) is stop
    assert not rights.permits("home", sent, scheme)


@pytest.mark.fault(59)
def test_the_front_lets_those_stop_who_have_a_key_or_its_session(tmp_path: Path) -> None:
    keys, sessions = KeyFile(tmp_path), SessionFile(tmp_path)
    key = {role: keys.add(role, role) for role in ("viewer", "operator")}  # type: ignore[arg-type]
    stored = keys.stored(key["operator"])
    assert stored is not None
    cookie = sessions.begin(stored, "192.0.2.7")
    rights = HaltRights(tmp_path, hosts=LOOPBACK_NAMES, keys_required=True)

    def may(action: str, **headers: str) -> bool:
        named = {"host": "127.0.0.1", **headers}
        return rights.permits(action, [(n.title().encode(), v.encode("latin-1")) for n, v in named.items()])

    assert [may("stop", authorization=f"Bearer {key[role]}") for role in key] == [True, True]
    assert [may("abort", authorization=f"Bearer {key[role]}") for role in key] == [False, True]
    assert may("abort", cookie=f"a=b; stereorig_session={cookie}")
    for wrong in ({}, {"cookie": "stereorig_session=guessed"}, {"authorization": "Bearer guessed"}, {"cookie": "\xff"}):
        assert not may("stop", **wrong)
    assert not may("stop", authorization="Basic x", cookie=f"stereorig_session={cookie}")
    keys.remove("operator")
    keys.add("operator", "operator")
    assert not may("stop", cookie=f"stereorig_session={cookie}")
    assert not may("stop", authorization=f"Bearer {key['operator']}")
    assert may("stop", authorization=f"Bearer {key['viewer']}")
    forget_sessions(tmp_path)
    broken = {"name": "x", "role": "admin", "sha256": 1, "created_utc": None}
    typed = json.dumps({"keys": [broken], "sessions": [broken]})
    for text in ("[" * 100_000, '{"keys": [{"name": "x"}]}', "\xff", typed):
        (tmp_path / "keys.json").write_text(text, encoding="latin-1")
        (tmp_path / "sessions.json").write_text(text, encoding="latin-1")
        assert not may("stop", authorization=f"Bearer {key['viewer']}")
        assert not may("stop", cookie=f"stereorig_session={cookie}")


def test_sessions_lie_hashed_and_are_bounded(tmp_path: Path) -> None:
    keys, sessions = KeyFile(tmp_path), SessionFile(tmp_path)
    stored = [keys.stored(keys.add(name, "viewer")) for name in ("one", "two")]
    assert stored[0] is not None
    assert stored[1] is not None
    first = sessions.begin(stored[1], "192.0.2.7")
    cookies = [sessions.begin(stored[0], "192.0.2.7") for _ in range(103)]
    path = tmp_path / "sessions.json"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert not any(cookie in path.read_text() for cookie in (first, *cookies))
    assert [sessions.of(cookie) is not None for cookie in (first, *cookies)] == [True, *[False] * 3, *[True] * 100]
    assert SessionFile(tmp_path).end(lambda one: one.name == "two") == 1
    assert sessions.of(first) is None


@pytest.mark.fault(59)
def test_a_session_ends_on_a_full_disk_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys, sessions = KeyFile(tmp_path), SessionFile(tmp_path)
    stored = keys.stored(keys.add("one", "viewer"))
    assert stored is not None
    cookie = sessions.begin(stored, "192.0.2.7")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(disk.Disk, "write", full)
    with pytest.raises(StorageError):
        sessions.end(lambda one: True)
    assert sessions.of(cookie) is None


def presented(token: str) -> dict[str, str]:
    """The cookie as a header, which the client does not forget."""
    return {"Cookie": f"stereorig_session={token}"}


def until_refused(ask: Callable[[], httpx.Response], since: float) -> httpx.Response:
    """Ask until it is refused, which must be within a second, and a second for a busy machine."""
    while (answer := ask()).is_success:
        assert time.monotonic() - since < 2.0 * busy()
        time.sleep(0.05)
    return answer


@pytest.mark.fault(59)
@pytest.mark.parametrize("change", ["removed", "made again", "role changed"])
def test_a_session_ends_with_its_key(service: Service, tmp_path: Path, change: str) -> None:
    file = KeyFile(service.folder.root)
    name = f"leaves-{change.replace(' ', '-')}"
    key = bearer(file.add(name, "admin"))
    with guarded(service) as url, httpx.Client(base_url=url, trust_env=False, timeout=30.0) as client:
        client.post(f"{API}/session", headers=key).raise_for_status()
        token = client.cookies["stereorig_session"]
        client.get(f"{API}/rig").raise_for_status()
        if change == "role changed":
            document = json.loads(file.path.read_text())
            document["keys"][-1]["role"] = "viewer"
            file.path.write_text(json.dumps(document))
        else:
            file.remove(name)
        if change == "made again":
            file.add(name, "admin")
        refused = until_refused(lambda: client.get(f"{API}/rig", headers=presented(token)), time.monotonic())
        assert (refused.status_code, refused.json()["code"]) == (401, "session_ended")
        for method, path in (("GET", "/session"), ("POST", "/session"), ("POST", "/tests"), ("DELETE", "/tests/x")):
            answer = client.request(method, API + path, headers=presented(token), json={"name": "x"})
            assert answer.status_code == 401, path
        assert client.get("/", headers=presented(token)).status_code == 200  # the page, to log in again


@pytest.mark.fault(59)
def test_a_removed_persons_cookie_is_refused_on_loopback_too(service: Service) -> None:
    file = KeyFile(service.folder.root)
    key = bearer(file.add("goes", "admin"))
    with guarded(service, required=False) as url, httpx.Client(base_url=url, trust_env=False, timeout=30.0) as client:
        client.post(f"{API}/session", headers=key).raise_for_status()
        token = client.cookies["stereorig_session"]
        file.remove("goes")
        gone = client.get(f"{API}/rig")
        assert (gone.status_code, gone.json()["code"]) == (401, "session_ended")
        assert "stereorig_session" not in client.cookies  # the browser forgets it too
        assert client.get(f"{API}/rig").status_code == 200
        assert client.delete(f"{API}/session", headers=presented(token)).status_code == 204


def test_a_cookie_begins_no_session(asks: httpx.Client, keys: dict[str, str]) -> None:
    asks.post(f"{API}/session", headers=bearer(keys["viewer"])).raise_for_status()
    refused = asks.post(f"{API}/session")
    assert (refused.status_code, refused.json()["code"]) == (401, "key_missing")
    assert "set-cookie" not in refused.headers


def test_sessions_are_listed_and_ended(service: Service, url: str, keys: dict[str, str]) -> None:
    own, other = KeyFile(service.folder.root).add("own", "viewer"), KeyFile(service.folder.root).add("other", "admin")

    @contextlib.contextmanager
    def begun(key: str) -> Iterator[httpx.Client]:
        with httpx.Client(base_url=url, trust_env=False, timeout=30.0) as made:
            made.post(f"{API}/session", headers=bearer(key)).raise_for_status()
            yield made

    with begun(own) as one, begun(own) as two, begun(other) as admin:
        listed = one.get(f"{API}/sessions").raise_for_status().json()["sessions"]
        assert {entry["name"] for entry in listed} == {"own"}
        assert len(listed) == 2
        assert listed[0]["address"] == "127.0.0.1"
        assert listed[0]["since"] <= listed[0]["last_use"] < listed[0]["until"]
        assert not any(client.cookies["stereorig_session"] in json.dumps(listed) for client in (one, two))
        everybody = admin.get(f"{API}/sessions").raise_for_status().json()["sessions"]
        assert {"own", "other"} <= {entry["name"] for entry in everybody}
        theirs = next(entry["id"] for entry in everybody if entry["name"] == "other")
        assert one.delete(f"{API}/sessions/{theirs}").status_code == 404
        assert one.delete(f"{API}/sessions", params={"name": "other"}).status_code == 403
        assert one.delete(f"{API}/sessions/{listed[1]['id']}").status_code == 204
        assert [client.get(f"{API}/rig").status_code for client in (one, two, admin)] == [200, 401, 200]
        assert admin.delete(f"{API}/sessions", params={"name": "own"}).json() == {"ended": 1}
        assert [client.get(f"{API}/rig").status_code for client in (one, two, admin)] == [401, 401, 200]
        assert admin.delete(f"{API}/sessions").json() == {"ended": 1}
        assert admin.get(f"{API}/rig").status_code == 401


@pytest.mark.fault(59)
def test_open_streams_of_a_removed_person_end_within_a_second(tmp_path: Path) -> None:
    made = Service(tiny_config(), tmp_path / "data").start()  # one of its own: a test before may have ended the streams
    file, paths = KeyFile(tmp_path / "data"), (f"{API}/events", f"{API}/cameras/cam1/stream.mjpg")
    stays = bearer(file.add("stays", "viewer"))
    try:
        with (
            guarded(made) as url,
            httpx.Client(base_url=url, trust_env=False, timeout=30.0) as client,
            httpx.Client(base_url=url, trust_env=False, timeout=30.0, headers=stays) as other,
            contextlib.ExitStack() as whole,
        ):
            wait_for_rig(other)
            kept = whole.enter_context(other.stream("GET", paths[1])).iter_raw()
            for by in ("key", "cookie", "ended session"):
                key = bearer(file.add("watches", "viewer"))
                if by != "key":
                    client.post(f"{API}/session", headers=key).raise_for_status()
                    key = {}
                with contextlib.ExitStack() as stack:
                    answers = [stack.enter_context(client.stream("GET", path, headers=key)) for path in paths]
                    assert [answer.status_code for answer in answers] == [200, 200]
                    if by == "ended session":
                        assert client.delete(f"{API}/sessions").json() == {"ended": 1}
                    else:
                        file.remove("watches")
                    since = time.monotonic()
                    for answer in answers:
                        for _ in answer.iter_raw():
                            assert time.monotonic() - since < 3.0 * busy(), (by, answer.url)
            assert next(kept)
    finally:
        made.close()


@pytest.mark.fault(59)
def test_an_open_websocket_of_a_removed_person_is_closed(tmp_path: Path) -> None:
    file = KeyFile(tmp_path)
    key, sent = file.add("watches", "viewer"), []

    async def values(_scope: Any, _receive: Any, send: Any) -> None:
        await send({"type": "websocket.accept"})
        await asyncio.Event().wait()

    async def take(message: Any) -> None:
        sent.append(message)
        if message["type"] == "websocket.accept":
            file.remove("watches")

    scope = {
        "type": "websocket",
        "path": f"{API}/tests/t000001-abcdef/live/ws",
        "headers": [(b"authorization", f"Bearer {key}".encode())],
        "client": ("192.0.2.7", 1),
    }
    door = Door(values, AccessRules(Callers(tmp_path), required=True))
    asyncio.run(asyncio.wait_for(door(scope, None, take), 3.0))  # type: ignore[arg-type]
    assert sent == [{"type": "websocket.accept"}, {"type": "websocket.close", "code": 1008}]


def shut_out_lines(service: Service) -> list[dict[str, object]]:
    lines = [json.loads(line) for line in (service.folder.root / "audit.log").read_text().splitlines()]
    return [line for line in lines if "event" in line]


@pytest.mark.fault(60)
def test_ten_wrong_keys_shut_an_address_out_and_a_stop_never(
    service: Service, keys: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutout, "SHUT_S", 2.0)
    before, right = len(shut_out_lines(service)), bearer(keys["operator"])
    with guarded(service) as url, httpx.Client(base_url=url, trust_env=False, timeout=30.0) as client:
        wrong = [client.post(f"{API}/tests", headers=bearer(f"guess-{n}"), json={}).status_code for n in range(10)]
        assert wrong == [401] * 10
        lines = len((service.folder.root / "audit.log").read_text().splitlines())
        answers = [client.post(f"{API}/tests", headers=right, json={"name": "x"}) for _ in range(5)]
        assert {(answer.status_code, answer.json()["code"]) for answer in answers} == {(429, "shut_out")}
        assert int(answers[0].headers["retry-after"]) in (1, 2)
        # requests of an address that is shut out leave no lines: only that it was, and later that it is no more
        assert len((service.folder.root / "audit.log").read_text().splitlines()) == lines
        assert client.post(f"{API}/stage:stop", headers=right).status_code == 200
        assert client.post(f"{API}/stage:stop", headers=bearer("guess")).status_code == 401
        assert client.get("/", headers=bearer("guess")).status_code == 200  # a page that can stop is served
        deadline = Deadline(20.0)
        while client.get(f"{API}/rig", headers=right).status_code == 429:
            assert deadline.left
            time.sleep(0.1)
        noted = shut_out_lines(service)[before:]
        assert [(line["event"], line["address"]) for line in noted] == [
            ("shut_out", "127.0.0.1"),
            ("shut_out_ended", "127.0.0.1"),
        ]


@pytest.mark.fault(60)
def test_guessed_cookies_shut_out_and_one_old_cookie_does_not(service: Service, keys: dict[str, str]) -> None:
    right = bearer(keys["viewer"])
    with guarded(service) as url, httpx.Client(base_url=url, trust_env=False, timeout=30.0) as client:
        for _ in range(30):  # a page that was left open over a restart
            assert client.get(f"{API}/rig", headers=presented("of-a-former-start")).status_code == 401
        assert client.get(f"{API}/rig", headers=right).status_code == 200
        for n in range(9):
            assert client.get(f"{API}/rig", headers=presented(f"guess-{n}")).status_code == 401
        assert client.get(f"{API}/rig", headers=right).status_code == 429


@pytest.mark.fault(60)
def test_addresses_are_counted_apart_and_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    noted: list[dict[str, object]] = []
    shut = shutout.ShutOut(lambda **entries: noted.append(entries))
    for n in range(9):
        shut.wrong("192.0.2.1")
        shut.wrong(f"2001:db8::{n}")
    now[0] += 61.0
    shut.wrong("192.0.2.1")
    assert shut.left_s("192.0.2.1") == 0.0  # ten, but not within a minute
    for n in range(10):
        shut.wrong(f"2001:db8::{n:x}")  # one client has a whole network of them
        shut.wrong("::ffff:192.0.2.7")
    assert shut.left_s("2001:db8::ffff") == pytest.approx(60.0)
    assert shut.left_s("2001:db8:0:1::1") == 0.0
    assert shut.left_s("192.0.2.7") == pytest.approx(60.0)
    for n in range(20_000):
        for _ in range(10 if n % 2 else 9):
            shut.wrong(f"10.{n >> 16}.{n >> 8 & 255}.{n & 255}")
    held = vars(shut)
    assert max(len(held[name]) for name in ("_wrong", "_until")) <= 10_000
    now[0] += 61.0
    assert shut.left_s("10.0.78.31") == 0.0
    assert [entry["event"] for entry in noted].count("shut_out") == 10_002
