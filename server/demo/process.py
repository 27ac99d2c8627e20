"""The service as a process of its own, on a free loopback port, for as long as the demo runs."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx

from stereorig.core.errors import StateError

_START_S = 120.0  # the first start compiles
_STOP_S = 15.0


def free_port() -> int:
    """Return a free loopback port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def running_service(config: Path, data: Path, log: Path) -> Iterator[str]:
    """Run ``stereorig serve`` until the block ends, also by an error; yields its base URL.

    Raises
    ------
    StateError
        ``service_not_started``, with the last line of its log.
    """
    port = free_port()
    command = [
        sys.executable,
        "-m",
        "stereorig.server.cli",
        "serve",
        "--config",
        str(config),
        "--data",
        str(data),
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
    ]
    root = Path(__file__).resolve().parents[2]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))}
    with log.open("ab") as log_file:
        # a session of its own: Ctrl-C reaches this process only, which then stops the service in order
        process = subprocess.Popen(
            command,
            stdout=log_file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
        )
    try:
        url = f"http://127.0.0.1:{port}"
        _await_health(process, url, log)
        yield url
    finally:
        _stop(process)


def _await_health(process: subprocess.Popen[bytes], url: str, log: Path) -> None:
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        with contextlib.suppress(httpx.TransportError):
            if httpx.get(f"{url}/api/v1/healthz", timeout=5.0, trust_env=False).is_success:
                return
        time.sleep(0.1)
    lines = log.read_text(errors="replace").strip().splitlines()
    outcome = (
        f"ended with status {process.returncode}"
        if process.poll() is not None
        else f"did not answer in {_START_S:.0f} s"
    )
    raise StateError(
        f"The service {outcome}: {lines[-1] if lines else 'its log is empty'}",
        code="service_not_started",
        remedy=f"Read {log}.",
    )


def _stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is not None:
        return
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # its worker ends when its pipe breaks
        process.wait()
