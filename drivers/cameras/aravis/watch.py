"""A watch over a GigE Vision camera that sends nothing because nothing is asked of it.

Aravis notices the loss of a camera after 8 s. A camera that waits for triggers is silent anyway, so its silence shows
nothing; but a connected one answers questions about its control.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from drivers.cameras.aravis.gvcp import ControlState, control_state

_PAUSE_S = 0.08
_ANSWER_S = 0.12
# Lost after this long without answer or frame, and so many questions: if this program itself was held up, time alone
# shows nothing
_PATIENCE_S = 0.5
_QUESTIONS = 3


class Watch:
    """Asks a camera about ten times a second, in a thread of its own.

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
        """Begin. Of a camera that does not answer such questions at all, Aravis' own knowledge must do (6 to 8 s)."""
        self._answers = control_state(self._address) is not ControlState.SILENT
        self._thread.start()

    def end(self) -> None:
        """Let the thread end; does not wait for it."""
        self._ended.set()

    def _run(self) -> None:
        answered_s = time.monotonic()
        unanswered = 0
        while not self._ended.wait(_PAUSE_S):
            state = control_state(self._address, timeout_s=_ANSWER_S, attempts=1) if self._answers else None
            now = time.monotonic()
            unanswered += 1
            if state is ControlState.HELD:
                answered_s, unanswered = now, 0
            silent_s = now - max(answered_s, self._last_sign_s())
            why = None
            if state is ControlState.FREE:
                why = "has forgotten that it was connected: it was switched off and on"
            elif state is ControlState.SILENT and unanswered >= _QUESTIONS and silent_s > _PATIENCE_S:
                why = "does not answer any more"
            elif not self._in_control():
                why = "is not under our control any more"
            if why is not None:
                if not self._ended.is_set():
                    self._on_lost(why)
                return
