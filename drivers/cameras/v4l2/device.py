"""One open video device: its requests, its errors in the project's words, and its users.

`Device.close` may come from any thread while another one waits in a request or for a frame. The last user gives the
descriptor back, so that no number is ever used after the kernel gave it to another file.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.v4l2 import structures as v

# The device is not there any more, or its bus reports so
_GONE = {errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN, errno.EIO}


class V4l2Device:
    """A video device.

    Parameters
    ----------
    path
        ``/dev/video0`` or a link to such a node.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.fd = self.wake = -1
        self.capability = v.Capability()
        self._lock = threading.Lock()
        self._users = 0
        self._closing = False

    def open(self) -> Self:
        """Open it and read its identity.

        Raises
        ------
        CameraError
            ``camera_lost`` when it is not there, ``camera_busy``, ``no_permission``, ``not_a_camera``.
        """
        try:
            if not stat.S_ISCHR(Path(self.path).stat().st_mode):
                raise not_a_camera(self.path, "it is no device node")
            self.fd = os.open(self.path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise self._unopened(error) from error
        try:
            self.ioctl(v.VIDIOC_QUERYCAP, self.capability)
        except OSError as error:
            os.close(self.fd)
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                raise not_a_camera(self.path, "it does not speak V4L2") from error
            raise self.fault(error, "be asked what it is") from error
        self.wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        return self

    @property
    def capabilities(self) -> int:
        """Abilities of this node, as ``V4L2_CAP_`` bits."""
        known = self.capability
        return known.device_caps if known.capabilities & v.CAP_DEVICE_CAPS else known.capabilities

    @property
    def closing(self) -> bool:
        """True once `close` was called."""
        return self._closing

    @contextmanager
    def use(self) -> Iterator[None]:
        """Keep the descriptor alive inside the block; code ``camera_lost`` once `close` was called."""
        with self._lock:
            if self._closing:
                raise closed(self.path)
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                last = self.closing and self._users == 0
            if last:
                self._release()

    def ioctl(self, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """Make one request, again when a signal came in between; raises OSError as the kernel answers."""
        while True:
            try:
                fcntl.ioctl(self.fd, request, argument, True)
            except InterruptedError:
                continue
            return

    def close(self) -> None:
        """End all waits and release the device; safe to call twice and from any thread."""
        with self._lock:
            first, self._closing = not self._closing, True
            idle = self._users == 0
            if first:
                os.eventfd_write(self.wake, 1)
        if first and idle:
            self._release()

    def _release(self) -> None:
        # the kernel stops the stream and frees its buffers with the last descriptor and the last mapping
        with suppress(OSError):
            os.close(self.fd)
        os.close(self.wake)

    def _unopened(self, error: OSError) -> CameraError:
        if error.errno in (errno.EACCES, errno.EPERM):
            return CameraError(
                f"{self.path} may not be opened by this user ({error.strerror}).",
                code="no_permission",
                remedy="Add the user to the group that owns the node (usually: usermod -aG video USER), log in again.",
                device=self.path,
            )
        if error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP):
            return CameraError(
                f"There is no {self.path}.",
                code="camera_lost",
                remedy="Plug the camera in; `stereorig devices` lists the devices and their stable names.",
                device=self.path,
            )
        return self.fault(error, "be opened")

    def fault(self, error: OSError, action: str) -> CameraError:
        """Return the error, in the project's words, for the ``action`` that the device refused."""
        text = f"{self.path} cannot {action} ({error.strerror}, {errno.errorcode.get(error.errno or 0, error.errno)})"
        if error.errno in _GONE:
            return CameraError(
                f"{text}: it is gone or broken.",
                code="camera_lost",
                remedy="Check its cable and power, then reconnect.",
                device=self.path,
            )
        if error.errno == errno.EBUSY:
            who = holders(self.path)
            return CameraError(
                f"{text}: another program uses it{' (' + ', '.join(who) + ')' if who else ''}.",
                code="camera_busy",
                remedy="Close the other program, then reconnect.",
                device=self.path,
                holders=who,
            )
        if error.errno == errno.ENOSPC:
            return CameraError(
                f"{text}: its USB bus has no room for this picture size and rate.",
                code="bus_full",
                remedy="Plug the cameras into different USB controllers, or take a smaller region or rate.",
                device=self.path,
            )
        return CameraError(f"{text}.", remedy="Check the camera's settings, then reconnect.", device=self.path)


def not_a_camera(path: str, why: str) -> CameraError:
    """Return the error for a path that is no capture device."""
    return CameraError(
        f"{path} is no V4L2 camera: {why}.",
        code="not_a_camera",
        remedy="Name a device that `stereorig devices` lists.",
        device=path,
    )


def closed(path: str) -> CameraError:
    """Return the error for a camera that is not open."""
    return CameraError(
        f"{path} is not open.", code="camera_lost", remedy="Connect the camera first.", camera=path, device=path
    )


def holders(path: str) -> list[str]:
    """Name the other processes that have the device open, as far as this user may see them."""
    try:
        node = Path(path).stat().st_rdev
    except OSError:
        return []
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        if int(process.name) == os.getpid():
            continue
        with suppress(OSError):
            for entry in (process / "fd").iterdir():
                with suppress(OSError):
                    there = entry.stat()
                    if stat.S_ISCHR(there.st_mode) and there.st_rdev == node:
                        name = (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
                        found.append(f"{name}, process {process.name}")
                        break
    return found
