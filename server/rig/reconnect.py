"""Finding cameras, and bringing lost ones back: a thread each, so that none waits for the other's driver."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from stereorig.core.errors import StereorigError
from stereorig.core.names import CameraName
from stereorig.server.rig.cameras import CameraPair

_log = logging.getLogger("stereorig.rig")
# A camera that is back must work within three seconds, of which finding and setting it takes one or two
_EVERY_S = 0.25


class ReconnectWatch:
    """Connects cameras that cannot be used, with the settings they had, read back.

    Parameters
    ----------
    pair
        The cameras.
    came_back
        Called when one works again.
    failed
        Called with the error of an attempt.
    again
        False: each camera is looked for once.
    """

    def __init__(
        self,
        pair: CameraPair,
        came_back: Callable[[CameraName], None],
        failed: Callable[[CameraName, StereorigError], None] = lambda _cam, _error: None,
        *,
        again: bool = True,
    ) -> None:
        self._pair, self._came_back, self._failed, self._again = pair, came_back, failed, again
        self._ending = threading.Event()
        self._first = {cam: threading.Event() for cam in pair.units}
        self._threads = [
            threading.Thread(target=self._run, args=(cam,), name=f"reconnect {cam}", daemon=True) for cam in pair.units
        ]

    def start(self) -> None:
        """Begin to watch."""
        for thread in self._threads:
            thread.start()

    def wait_for_first(self, timeout_s: float) -> None:
        """Wait for the first attempt of each camera."""
        deadline = time.monotonic() + timeout_s
        for first in self._first.values():
            first.wait(max(0.0, deadline - time.monotonic()))

    def stop(self) -> None:
        """End the watch; attempts that are under way are finished first."""
        self._ending.set()
        for thread in self._threads:
            thread.join()

    def _run(self, cam: CameraName) -> None:
        while True:
            self._look(cam)
            self._first[cam].set()
            if not self._again or self._ending.wait(_EVERY_S):
                return

    def _look(self, cam: CameraName) -> None:
        try:
            if self._pair.units[cam].fault is None:
                return
            self._pair.reopen(cam)
        except StereorigError as error:
            _log.debug("%s is not back: %s", cam, error)
            self._failed(cam, error)
        except Exception:  # noqa: BLE001  # the watch must survive any error of a driver
            _log.exception("connecting %s again failed", cam)
        else:
            self._came_back(cam)
