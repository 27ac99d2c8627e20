"""How long a stop takes from the request to the wire beside one request, upload or line of any size and content.

The service runs in processes of its own, on simulated cameras and an ESP301 simulated in this one. Bodies are generated from a
seed: JSON deep, wide, long and broken, unknown names, regular expressions' worst texts, images and models of wrong sizes, lines
and half requests. While each is on its way, one stop is sent on a connection of its own and timed to the controller.

    python -m tests.bench.reliability.stop_beside [--requests 3000] [--seed 34] [--page] [--deaths 50] [--stops 300]

``--page`` measures stops under load and deaths as well, and writes the section of docs/explanation/reliability.md.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import os
import platform
import random
import socket
import tempfile
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path

from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from tests.bench.reliability import stage_stop
from tests.bench.reliability.processes import API, DEATHS, serving, time_deaths

PAGE = Path(__file__).resolve().parents[3] / "docs" / "explanation" / "reliability.md"
BEGIN, END = "<!-- stops: begin -->", "<!-- stops: end -->"
Body = tuple[str, str, str, bytes]  # method, path, content type, content
_JSON, _CSV = "application/json", "text/csv"


def _multipart(name: str, content: bytes) -> tuple[str, bytes]:
    head = f'--b\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n\r\n'.encode()
    return "multipart/form-data; boundary=b", head + content + b"\r\n--b--\r\n"


def json_bodies(dice: random.Random) -> list[Callable[[int], bytes]]:
    """Return makers of JSON of about so many bytes."""
    names = dice.choice(["x", "name", "specimen ", "ſ", "a" * 100])
    return [
        lambda n: json.dumps({f"{names}{i}": i for i in range(n // 12)}).encode(),
        lambda n: b"[" * (n // 2) + b"]" * (n // 2),
        lambda n: b'{"a":' * (n // 6) + b"1" + b"}" * (n // 6),
        lambda n: b'{"name": "' + b" " * n + b'"}',
        lambda n: b'{"name": "' + b"\\u0041" * (n // 6) + b'"}',
        lambda n: b"[" + b",".join([b"1e308"] * (n // 6)) + b"]",
        lambda n: b'{"name": ' + b"9" * n + b"}",
        lambda n: b'{"region": {"polygon": [' + b",".join([b"[1,2]"] * (n // 6)) + b"]}}",
        lambda n: b'{"name": "' + b"\xff" * n + b'"}',
        lambda n: b'{"name": "x",' * (n // 13) + b'"a": 1}',
        lambda n: b"{" + b'"name": "x", ' * (n // 13) + b'"name": "y"}',
    ]


def texts(dice: random.Random) -> list[Callable[[int], bytes]]:
    """Return makers of tables of about so many bytes."""
    mark = dice.choice(["[", "(", "/", '"', ";", "=", "9"])
    return [
        lambda n: f"time_s,a{mark}{' ' * n}b)c\n1,2\n".encode(),
        lambda n: f"time_s,{mark * n}\n1,2\n".encode(),
        lambda n: b"time_s,force\n" + b"1,2\n" * (n // 4),
        lambda n: b"time_s," + b",".join([b"a"] * (n // 2)) + b"\n",
        lambda n: b"<" * n,
        lambda n: b"%YAML:1.0\n---\n" + b"- " * (n // 2),
        lambda n: b"<a>" * (n // 3),
        lambda n: bytes(dice.getrandbits(8) for _ in range(min(n, 20_000))),
        lambda n: b"\x89PNG\r\n\x1a\n" + zlib.compress(b"\0" * n),
        lambda n: b"II*\0\x08\0\0\0\xff\xff" + b"\xff" * n,
    ]


def bodies(test_id: str, seed: int, count: int) -> list[Body]:
    """Return so many requests, each from a dice of its own."""
    made: list[Body] = []
    for number in range(count):
        dice = random.Random(1000 * seed + number)
        size = int(10 ** dice.uniform(1.0, 6.2 if number % 20 else 7.2))
        if number % 3 == 0:
            kind, content = _multipart(
                dice.choice(["c.csv", "c.yml", "c.xml", "a.png", "a.tif", "m.vtu", "m.xdmf", "c.caldat"]),
                dice.choice(texts(dice))(size),
            )
            path = dice.choice(
                [
                    f"/tests/{test_id}/channels:import",
                    f"/tests/{test_id}/steps:import",
                    f"/tests/{test_id}/models",
                    "/calibrations:import",
                    "/tests:open",
                    "/noise:import",
                ]
            )
            made.append(("POST", API + path, kind, content))
            continue
        method, path = dice.choice(
            [
                ("PUT", f"/tests/{test_id}/metadata"),
                ("POST", "/tests"),
                ("POST", f"/tests/{test_id}/analyses"),
                ("PUT", f"/tests/{test_id}/workspace"),
                ("POST", "/calibrations"),
                ("POST", "/stage/moves"),
                ("POST", "/recipes"),
                ("PATCH", f"/tests/{test_id}"),
                ("POST", "/tests/none/analyses"),
            ]
        )
        made.append((method, API + path, _JSON, dice.choice(json_bodies(dice))(size)))
    return made


def _send(port: int, body: Body, begun: threading.Event) -> int:
    method, path, kind, content = body
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120.0)
    try:
        connection.putrequest(method, path)
        connection.putheader("Content-Type", kind)
        connection.putheader("Content-Length", str(len(content)))
        connection.endheaders()
        with contextlib.suppress(OSError):
            connection.send(content)
        begun.set()
        return connection.getresponse().status
    except (OSError, http.client.HTTPException):
        return 0
    finally:
        begun.set()
        connection.close()


def time_stop(port: int, received: list[object]) -> float:
    """Stop once on a connection of its own; return the time until the controller has read it, s."""
    known = len(received)
    with socket.create_connection(("127.0.0.1", port), timeout=60.0) as connection:
        began = time.monotonic()
        connection.sendall(
            f"POST {API}/stage:stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".encode()
        )
        while connection.recv(65536):
            pass
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline:
        for entry in received[known:]:
            if entry.text == "ST":  # type: ignore[attr-defined]
                return float(entry.at_s) - began  # type: ignore[attr-defined]
        time.sleep(0.001)
    raise RuntimeError("a stop never reached the wire")


def measure(folder: Path, requests: int, seed: int) -> tuple[list[tuple[float, str]], dict[int, int]]:
    """Return the time of each stop, s, with the request beside it, and how many answers of each status there were."""
    controller = make_controller("esp301", (1, 2), time_scale=1.0)
    statuses: dict[int, int] = {}
    with ControllerServer(controller) as server, serving(folder, server.url) as (_, client):
        test_id = client.post(f"{API}/tests", json={"name": "beside"}).raise_for_status().json()["id"]
        port = client.base_url.port or 80
        times = []
        for number, body in enumerate(bodies(test_id, seed, requests)):
            begun, status = threading.Event(), []

            def send(body: Body = body, begun: threading.Event = begun, status: list[int] = status) -> None:
                status.append(_send(port, body, begun))

            thread = threading.Thread(target=send)
            thread.start()
            begun.wait(60.0)
            time.sleep(random.Random(number).uniform(0.0, 0.01))
            times.append(
                (time_stop(port, controller.received), f"{body[0]} {body[1]} {len(body[3])} B {body[3][:40]!r}")
            )
            thread.join()
            statuses[status[0]] = statuses.get(status[0], 0) + 1
        assert client.get(f"{API}/healthz", timeout=60.0).is_success
    return sorted(times), statuses


def table(times_ms: list[float], name: str) -> str:
    """Return a row of the page's table."""
    ms = sorted(times_ms)
    return f"| {name} | {len(ms)} | {ms[len(ms) // 2]:.1f} | {ms[int(0.99 * len(ms))]:.1f} | {ms[-1]:.1f} |"


def write_page(rows: list[str]) -> None:
    """Write the figures between the section's marks."""
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    about = (
        f"{os.cpu_count()} processors ({platform.processor() or platform.machine()}), Python {platform.python_version()}, "
        f"load {os.getloadavg()[0]:.1f} at the end."
    )
    head = "| stop | times | p50 ms | p99 ms | max ms |\n| --- | ---: | ---: | ---: | ---: |"
    text = "\n".join([about, "", head, *rows])
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=34)
    parser.add_argument("--page", action="store_true", help="write docs/explanation/reliability.md")
    parser.add_argument("--deaths", type=int, default=50, help="of each kind")
    parser.add_argument("--stops", type=int, default=300, help="under load")
    args = parser.parse_args()
    stage_stop.set_priority(-15)  # the controller in here is the instrument: its clock must not wait
    with tempfile.TemporaryDirectory() as folder:
        times, statuses = measure(Path(folder), args.requests, args.seed)
    rows = [table([1e3 * taken for taken, _ in times], "beside one request of any size and content")]
    print(rows[0])
    print("slowest beside", *[f"{1e3 * taken:.0f} ms: {name}" for taken, name in times[-5:]], sep="\n  ")
    print("answers by status", statuses, flush=True)
    if not args.page:
        return
    with tempfile.TemporaryDirectory() as folder:
        rows.append(table(list(stage_stop.measure(Path(folder), stops=args.stops).latencies_ms), "under load"))
    for driver in ("esp301", "smc100"):
        for victim, number in DEATHS:
            rows.append(
                table(time_deaths(driver, victim, number, args.deaths), f"{driver}: {victim} dies by {number.name}")
            )
            print(rows[-1], flush=True)
    write_page(rows)


if __name__ == "__main__":
    main()
