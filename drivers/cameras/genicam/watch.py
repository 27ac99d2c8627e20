"""A watch over a GigE Vision camera that sends nothing because nothing is asked of it.

Aravis notices the loss of a camera after 8 s. A camera that waits for triggers is silent anyway, so its silence shows
nothing; but a connected one answers questions about its control.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from stereorig.drivers.cameras.genicam.gvcp import ControlState, control_state

_PAUSE_S = 0.05
# A question may be lost, so it is asked twice with this wait, but no more: questions would queue up before a camera
# that writes its flash. Of one that is known to answer late, more patience is due
_ANSWER_S, _LATE_ANSWER_S = 0.33, 0.45
_LEAST_S = 0.1
# An answer after more than this is late
_LATE_S = 0.2
# Frames in the meantime are signs of life too
_PATIENCE_S = 0.5


class Watch:
    """Asks a camera ten times a second, in a thread of its own.

    Parameters
    ----------
    address
        IP address of the camera.
    last_sign_s
        When the last frame came, by the monotonic clock: frames are signs of life too.
    in_control
        Function that returns True if the camera is still under control, as far as is known without asking it.
    on_lost
        Called once with the reason, from the watch's thread.
    """

    def __init__(
        self,
        address: str,
        last_sign_s: Callable[[], float],
        in_control: Callable[[], bool],
        on_lost: Callable[[str], None],
    ) -> None:
        self._address = address
        self._in_control = in_control
        self._last_sign_s = last_sign_s
        self._on_lost = on_lost
        self._answers = True
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"watch over {address}", daemon=True)

    def start(self) -> None:
        """Begin. If a camera does not answer such questions at all, Aravis' own detection must do (6 to 8 s)."""
        self._answers = control_state(self._address) is not ControlState.SILENT
        self._thread.start()

    def end(self) -> None:
        """Let the thread end; does not wait for it."""
        self._ended.set()

    def _run(self) -> None:
        answered_s = time.monotonic()
        pause_s, patience_s = _PAUSE_S, _ANSWER_S
        unanswered_s: float | None = None  # when the first question without an answer was asked
        while not self._ended.wait(pause_s):
            asked_s = time.monotonic()
            # an address that refuses a question is heard at once: the next one waits for the rest of the patience alone
            unanswered_s = asked_s if unanswered_s is None else unanswered_s
            timeout_s = min(patience_s, max(_LEAST_S, patience_s - 0.5 * (asked_s - unanswered_s)))
            state = control_state(self._address, timeout_s=timeout_s) if self._answers else None
            now = time.monotonic()
            if state is ControlState.HELD:
                answered_s, unanswered_s = now, None
                late_s = now - asked_s
                pause_s = _PAUSE_S
                if late_s > _LATE_S:
                    pause_s, patience_s = late_s, _LATE_ANSWER_S  # it has other questions to answer too
            silent_s = now - max(answered_s, self._last_sign_s())
            why = None
            if state is ControlState.FREE:
                why = "has forgotten that it was connected: it was switched off and on"
            elif state is ControlState.SILENT and silent_s > _PATIENCE_S:
                why = "does not answer any more"
            elif not self._in_control():
                why = "is not under our control any more"
            if why is not None:
                if not self._ended.is_set():
                    self._on_lost(why)
                return
