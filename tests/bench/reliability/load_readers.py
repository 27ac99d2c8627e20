"""The readers of the load run, in a process of their own: polling clients, and slow readers of streams.

Told by lines of JSON on standard input what there is to read; ends when that ends, and then prints what it saw.
"""

from __future__ import annotations

import asyncio
import json
import random
import sys
import time
from dataclasses import dataclass, field
from typing import Any

API = "/api/v1"
SLOW_BYTES_PER_S = 20_000


@dataclass
class Seen:
    """What the readers saw: seconds since the epoch, kind of path, latency in ms; answers that were no 200."""

    gets: list[tuple[float, str, float]] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    streamed: dict[str, int] = field(default_factory=dict)
    closed: list[str] = field(default_factory=list)


@dataclass
class Target:
    """What there is to read."""

    host: str
    port: int
    test: str = ""
    step: int = 0

    def paths(self) -> dict[str, str]:
        """Kind -> path."""
        plain = {"healthz": f"{API}/healthz", "jobs": f"{API}/jobs?limit=10", "rig": f"{API}/rig"}
        if self.test:
            plain |= {"test": f"{API}/tests/{self.test}", "step": f"{API}/tests/{self.test}/steps/{self.step}"}
        return plain


def head(target: Target, path: str) -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: {target.host}:{target.port}\r\n\r\n".encode()


async def answer(reader: asyncio.StreamReader) -> tuple[int, int]:
    """Read one answer; return its status and size."""
    lines = (await reader.readuntil(b"\r\n\r\n")).split(b"\r\n")
    sizes = [int(line.split(b":")[1]) for line in lines if line.lower().startswith(b"content-length:")]
    await reader.readexactly(sizes[0])
    return int(lines[0].split()[1]), sizes[0]


async def poll(target: Target, seen: Seen, every_s: float) -> None:
    """Read one of the plain documents again and again, over one connection."""
    dice = random.Random()
    connection: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
    while True:
        await asyncio.sleep(dice.uniform(0.5, 1.5) * every_s)
        kind, path = dice.choice(list(target.paths().items()))
        try:
            if connection is None:
                connection = await asyncio.open_connection(target.host, target.port)
            asked = time.monotonic()
            connection[1].write(head(target, path))
            status, _ = await answer(connection[0])
            took_s = time.monotonic() - asked
        except (OSError, asyncio.IncompleteReadError) as error:
            seen.wrong.append(f"{path}: {type(error).__name__}")
            connection = None
            continue
        if status == 200:
            seen.gets.append((time.time(), kind, took_s * 1e3))
        else:
            seen.wrong.append(f"{path}: {status}")


async def sip(target: Target, seen: Seen, path: str) -> None:
    """Read a stream much more slowly than it comes."""
    reader, writer = await asyncio.open_connection(target.host, target.port, limit=4096)
    writer.write(head(target, path))
    while data := await reader.read(1024):
        seen.streamed[path] = seen.streamed.get(path, 0) + len(data)
        await asyncio.sleep(len(data) / SLOW_BYTES_PER_S)
    seen.closed.append(path)


async def read_on(target: Target, readers: int, every_s: float) -> Seen:
    seen = Seen()
    tasks = [asyncio.create_task(poll(target, seen, every_s)) for _ in range(readers)]
    slow = (f"{API}/cameras/cam1/stream.mjpg?rate_hz=10", f"{API}/events?")
    tasks += [asyncio.create_task(sip(target, seen, path)) for path in slow]
    inlet = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(inlet), sys.stdin)
    while line := await inlet.readline():
        target_of: dict[str, Any] = json.loads(line)
        target.test, target.step = target_of["test"], target_of["step"]
    for task in tasks:
        if task.done() and task.exception() is not None:
            seen.wrong.append(repr(task.exception()))
        task.cancel()
    return seen


def main() -> None:
    host, port, readers, every_s = sys.argv[1:]
    seen = asyncio.run(read_on(Target(host, int(port)), int(readers), float(every_s)))
    print(json.dumps(vars(seen)))


if __name__ == "__main__":
    main()
