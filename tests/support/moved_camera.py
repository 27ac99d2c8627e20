"""A GigE Vision camera that takes a new address by FORCEIP, and the command that gives it one, as a program.

    unshare --net bash -c 'ip link set lo up; exec python -m tests.support.moved_camera'

Prints a line of JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import socket
import threading

from stereorig.core.errors import CameraError, InputError
from stereorig.drivers.cameras.aravis import discover
from stereorig.server.cli.operation import devices
from tests.support.timed_camera import PORT, TimedCamera, _bound

MAC = "02:03:0a:0b:0c:0d"
AWAY, HERE = "169.254.7.7", "127.0.0.9"


class MovedCamera(TimedCamera):
    """A camera whose present address lies in a network to which this machine has no way."""

    def __init__(self, own: str, serial: str) -> None:
        super().__init__(own, serial)
        self._mem[0x24:0x28] = socket.inet_aton(AWAY)
        self._mem[0xA:0x10] = bytes.fromhex(MAC.replace(":", ""))
        self.forced: list[str] = []  # address, mask, gateway

    def _answer(
        self, command: int, flags: int, number: int, body: bytes, peer: object, came_ns: int
    ) -> tuple[int | None, bytes]:
        if command != 0x0004:
            return super()._answer(command, flags, number, body, peer, came_ns)
        # GigE Vision 2.0, 16.3: the places within the packet's data
        if len(body) != 56 or body[2:8] != bytes(self._mem[0xA:0x10]):
            return None, b""
        self.forced = [socket.inet_ntoa(body[at : at + 4]) for at in (20, 36, 52)]
        self._mem[0x24:0x28] = body[20:24]
        self._socket = _bound(self.forced[0], PORT)
        threading.Thread(target=self._serve, args=(self._socket,), daemon=True).start()
        return 0, b""

    def kept(self) -> list[str]:
        """Return what it would have after it is switched on again; empty if it would not keep an address."""
        names = ("GevPersistentIPAddress", "GevPersistentSubnetMask", "GevPersistentDefaultGateway")
        if not self.get("GevCurrentIPConfigurationPersistentIP"):
            return []
        return [socket.inet_ntoa(self.get(name).to_bytes(4, "big")) for name in names]


def command(*words: str) -> str:
    """Return what the command prints, or its error's code."""
    parser = argparse.ArgumentParser()
    devices.add_arguments(parser)
    args = parser.parse_args(["--set-address", *words])
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            devices.run(args)
    except (CameraError, InputError) as error:
        return str(error.code)
    return printed.getvalue().strip()


if __name__ == "__main__":
    camera = MovedCamera("127.0.0.5", "AWAY")
    camera.start()
    found = {"before": [one.problem for one in discover()]}
    found["taken"] = command(MAC, "127.0.0.5/8")
    found["wrong"] = [command("AWAY", "127.0.0.9"), command("AWAY", "somewhere"), command("NOBODY", f"{HERE}/8")]
    found["unmoved"] = camera.forced
    found["said"] = command(MAC, f"{HERE}/8")
    found |= {
        "forced": camera.forced,
        "kept": camera.kept(),
        "after": [(one.address, one.problem) for one in discover()],
    }
    print(json.dumps(found), flush=True)
    os._exit(0)  # Aravis' threads do not wait for each other
