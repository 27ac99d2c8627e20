"""Messages between the rig process and the web process: Python objects, their large arrays by shared memory.

Both processes belong to one program and one user, and trust each other: objects travel as pickles. An array of 64 KiB
or more goes into memory without a name (memfd), whose descriptor travels with the message: it is copied once, and the
memory is freed with the last array that uses it.
"""

from __future__ import annotations

import contextlib
import itertools
import mmap
import os
import pickle
import select
import socket
import struct
from dataclasses import dataclass
from typing import Any

_HEAD = struct.Struct("<QI")  # bytes of the pickle, number of buffers in shared memory
_SIZE = struct.Struct("<Q")
_SHARED_FROM = 64 * 1024  # bytes
_ALIGNED = 64  # bytes

#: message of a caller that waits no longer for its answer
GIVEN_UP = "given up"


@dataclass(frozen=True)
class OpenedDevices:
    """Facts about opened devices that the web process keeps."""

    axes: tuple[int, ...]
    has_world: bool


def _places(sizes: list[int]) -> list[int]:
    """Return the first byte of each buffer in shared memory, and at last the length of all."""
    return list(itertools.accumulate((-(-size // _ALIGNED) * _ALIGNED for size in sizes), initial=0))


class Channel:
    """One end of a connection; one thread at a time sends, and one receives.

    Parameters
    ----------
    connection
        A connected Unix socket; it belongs to the channel from now on.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._poll = select.poll()
        self._poll.register(connection, select.POLLIN)

    def send(self, message: Any) -> None:
        """Send an object.

        Raises
        ------
        OSError
            The other process is gone.
        """
        buffers: list[memoryview] = []

        def shared(buffer: pickle.PickleBuffer) -> bool:
            raw = buffer.raw()
            if raw.nbytes < _SHARED_FROM:
                return True  # in the pickle itself
            buffers.append(raw)
            return False

        body = pickle.dumps(message, protocol=5, buffer_callback=shared)
        sizes = [buffer.nbytes for buffer in buffers]
        head = _HEAD.pack(len(body), len(sizes)) + b"".join(map(_SIZE.pack, sizes))
        if not buffers:
            self._socket.sendall(head + body)
            return
        places = _places(sizes)
        memory = os.memfd_create("stereorig frames")
        try:
            os.posix_fallocate(memory, 0, places[-1])  # where memory is short, an error here and no signal at the copy
            for buffer, first in zip(buffers, places, strict=False):
                done = 0
                while done < buffer.nbytes:
                    done += os.pwrite(memory, buffer[done:], first + done)
            sent = socket.send_fds(self._socket, [head], [memory])
        finally:
            os.close(memory)
        self._socket.sendall(head[sent:] + body)

    def receive(self) -> Any:
        """Return the next object.

        Raises
        ------
        EOFError
            The other process has closed its end.
        OSError
            The other process is gone.
        """
        head, descriptors, _, _ = socket.recv_fds(self._socket, _HEAD.size, 1)
        try:
            if not head:
                raise EOFError
            length, count = _HEAD.unpack(head + self._exactly(_HEAD.size - len(head)))
            sizes = [size for (size,) in _SIZE.iter_unpack(self._exactly(count * _SIZE.size))]
            body = self._exactly(length)
            parts: list[memoryview] = []
            if count:
                places = _places(sizes)
                memory = memoryview(mmap.mmap(descriptors[0], places[-1]))
                parts = [memory[first : first + size] for first, size in zip(places, sizes, strict=False)]
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        return pickle.loads(body, buffers=parts)

    def _exactly(self, count: int) -> bytearray:
        data = bytearray(count)
        left = memoryview(data)
        while left:
            got = self._socket.recv_into(left)
            if got == 0:
                raise EOFError
            left = left[got:]
        return data

    def waiting(self, timeout_s: float = 0.0) -> bool:
        """Return True if a message, or the connection's end, can be received within the time."""
        return bool(self._poll.poll(1e3 * timeout_s))

    def close(self) -> None:
        """Close the connection; a thread that receives gets its end."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
