"""Bringing lost cameras back: one thread that asks for them until they answer."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from core.errors import CameraError
from core.names import CameraName
from server.rig.cameras import CameraPair

_log = logging.getLogger("stereorig.rig")
# A camera that is back must work within three seconds, of which finding and setting it takes one or two
_EVERY_S = 0.25


class ReconnectWatch:
    """Connects lost cameras again, with the settings they had, read back.

    Parameters
    ----------
    pair
        The cameras.
    came_back
        Called when one works again.
    """

    def __init__(self, pair: CameraPair, came_back: Callable[[CameraName], None]) -> None:
        self._pair = pair
        self._came_back = came_back
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reconnect", daemon=True)

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def stop(self) -> None:
        """End the watch; an attempt that is under way is finished first."""
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ending.wait(_EVERY_S):
            for cam in self._pair.lost():
                if self._ending.is_set():
                    return
                try:
                    self._pair.reopen(cam)
                except CameraError as error:
                    _log.debug("%s is not back: %s", cam, error)
                except Exception:  # noqa: BLE001  # the watch must outlive whatever a driver does
                    _log.exception("connecting %s again failed", cam)
                else:
                    self._came_back(cam)
