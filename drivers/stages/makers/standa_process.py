"""The process that holds one Standa controller through the maker's library, and stops its axis when its caller ends.

The library alone can write to the controller, so a process that it dies with leaves the axis moving. This process
outlives its caller: ``python -m stereorig.drivers.stages.makers.standa_process CALLS STOPS URL``, with the descriptors
of two sockets. A line on the first is one call, answered by a line; a word on the second is a stop, from any process.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import threading
from enum import Enum
from typing import Any

STOPS = {b"sstp": "command_sstp", b"stop": "command_stop"}


def plain(value: Any) -> Any:
    """Return a reply of the library as JSON takes it: a structure by its fields, flags as numbers."""
    if isinstance(value, Enum):
        return value.value
    if hasattr(value, "__dict__"):
        return {name.lstrip("_"): plain(field) for name, field in vars(value).items()}
    return value


def answer(axis: Any, name: str, arguments: list[Any]) -> Any:
    """Make one call; ``set_X`` takes the fields of ``get_X`` that change."""
    if name.startswith("set_"):
        fields = getattr(axis, f"get_{name.removeprefix('set_')}")()
        for key, value in arguments[0].items():
            setattr(fields, key, value)
        arguments = [fields]
    return plain(getattr(axis, name)(*arguments))


def serve(axis: Any, calls: socket.socket) -> None:
    """Answer calls until the caller ends, however it does; then stop the axis and end."""
    try:
        with calls.makefile("rw", encoding="ascii") as lines:
            for line in lines:
                lines.write(json.dumps(reply(axis, *json.loads(line))) + "\n")
                lines.flush()
    finally:
        try:
            axis.command_sstp()
            axis.close_device()
        finally:
            os._exit(0)


def reply(axis: Any, name: str, arguments: list[Any]) -> dict[str, Any]:
    """Make one call, and return its value or failure under a name."""
    try:
        return {"value": answer(axis, name, arguments)}
    except ConnectionError as error:
        return {"gone": str(error)[:200]}
    except Exception as error:  # noqa: BLE001 - the library's own kinds
        return {"refused": f"{type(error).__name__}: {str(error)[:200]}"}


def stop(axis: Any, name: str) -> None:
    """Stop the axis; if that fails, the next call reports the reason."""
    with contextlib.suppress(Exception):
        getattr(axis, name)()


def main() -> None:
    """Open the controller, say so, and serve."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)  # for the caller to handle; this process ends with the caller
    calls, stops = (socket.socket(fileno=int(text)) for text in sys.argv[1:3])
    try:
        from libximc.highlevel import Axis

        axis = Axis(sys.argv[3])
        axis.open_device()
    except (ImportError, RuntimeError) as error:
        calls.sendall(json.dumps({"missing": str(error)[:200]}).encode() + b"\n")
        return
    except ConnectionError as error:
        calls.sendall(json.dumps({"gone": str(error)[:200].splitlines()[0]}).encode() + b"\n")
        return
    calls.sendall(b'{"value": null}\n')
    threading.Thread(target=serve, args=(axis, calls), daemon=True).start()
    with contextlib.suppress(OSError):  # the caller was killed with something unread
        while data := stops.recv(4096):
            for word in data.split():
                if word in STOPS:
                    stop(axis, STOPS[word])
    stop(axis, "command_sstp")
    threading.Event().wait()  # the end comes by the other socket


if __name__ == "__main__":
    main()
