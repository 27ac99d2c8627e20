"""Keys, roles, cookies, limits, security headers and the audit log, over HTTP."""

from __future__ import annotations

import contextlib
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
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import uvicorn

from core.errors import FileFormatError, InputError
from server.api.app import create_app
from server.api.protocol.auth import RateLimit
from server.cli.main import main
from server.cli.operation.serve import check_host, check_tls, tls_is_missing
from server.http.access import KeyFile
from server.workflows.service import Service
from tests.support.requirements import ROOT, missing
from tests.support.service_rig import TINY, tiny_config

API = "/api/v1"


@contextlib.contextmanager
def guarded(service: Service, **options: object) -> Iterator[str]:
    """Serve with keys required; yields the URL."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen()  # who comes before the server is up waits in the queue
    app = create_app(service, keys_required=True, close_service=False, **options)  # type: ignore[arg-type]
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
    from server.config.rig_file import parse_config

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
            "server.cli",
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
            "server.cli",
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


def test_on_loopback_nobody_is_asked_unless_the_rig_file_says_so(tmp_path: Path) -> None:
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
