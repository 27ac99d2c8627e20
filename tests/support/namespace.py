"""A network namespace of its own: hosts that tests may do anything to, and HTTP into it from outside."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx

from tests.support.requirements import ROOT

_CLONE_NEWNET = 0x40000000


def namespaces_missing() -> str | None:
    """What has to be there for namespaces, or None when all is."""
    if shutil.which("ip") is None:
        return "the program ip (apt-get install iproute2)"
    if os.geteuid() != 0:
        return "root, for network namespaces"
    return None


def run_apart(*command: str, timeout_s: float | None = None) -> subprocess.CompletedProcess[str]:
    """Run a program of this checkout in namespaces of its own; ``command`` begins with the options of unshare."""
    return subprocess.run(
        ["unshare", *command],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
    )


class Namespace:
    """A namespace with a loopback of several addresses.

    Parameters
    ----------
    name
        Unique on the machine; put the process number into it.
    addresses
        Of the loopback, beside 127.0.0.1.
    """

    def __init__(self, name: str, addresses: tuple[str, ...] = ()) -> None:
        self.name = name
        _ip("netns", "add", name)
        _ip("-n", name, "link", "set", "lo", "up")
        for address in addresses:
            _ip("-n", name, "addr", "add", f"{address}/8", "dev", "lo")

    def command(self, *words: str) -> list[str]:
        """Words that run a program inside."""
        return ["ip", "netns", "exec", self.name, *words]

    def remove(self) -> None:
        """End it; what still runs inside keeps it alive unseen."""
        subprocess.run(["ip", "netns", "del", self.name], check=False)


class NamespaceTransport(httpx.BaseTransport):
    """Sends requests from inside a namespace: one thread enters it, and everything else stays outside."""

    def __init__(self, name: str) -> None:
        self._inner = httpx.HTTPTransport()
        self._thread = ThreadPoolExecutor(1, initializer=_enter, initargs=(name,))

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send, and read the whole answer."""

        def send() -> httpx.Response:
            response = self._inner.handle_request(request)
            response.read()
            return response

        return self._thread.submit(send).result()

    def close(self) -> None:
        """End the thread."""
        self._thread.submit(self._inner.close).result()
        self._thread.shutdown()


def _enter(name: str) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    descriptor = os.open(Path("/run/netns") / name, os.O_RDONLY)
    try:
        if libc.setns(descriptor, _CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), f"cannot enter the namespace {name}")
    finally:
        os.close(descriptor)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)
