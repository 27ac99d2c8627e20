"""Check of the accepted calibration by the live pair, for an operator at the rig; nothing is kept."""

from __future__ import annotations

import time
from dataclasses import dataclass

from stereorig.core.errors import MeasurementError, StateError
from stereorig.server.compute.functions import check_live
from stereorig.server.compute.tasks import LiveCheckTask, LiveFinding
from stereorig.server.rig.cameras import CapturedPair
from stereorig.server.rig.shared import SharedReading
from stereorig.server.store.folder import now_utc
from stereorig.server.workflows.calibration.review import newest_accepted
from stereorig.server.workflows.calibration.sequence import way_back
from stereorig.server.workflows.service import Service

_PAIR_S = 5.0
_PATIENCE_S = 30.0


@dataclass(frozen=True)
class LiveCheck:
    """A finding, its calibration's id and its time; the level is ``off_zero`` or ``busy`` if no check was made."""

    calibration_id: str
    finding: LiveFinding
    checked_utc: str


class LiveChecks:
    """The live checks of one service; who asks while one is made shares the next."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._shared = SharedReading(self._check)

    def __call__(self) -> LiveCheck:
        """Return the check of the newest accepted calibration by a live pair.

        Its ``level`` is ``off_zero`` if a stage is not at dZ = 0, ``busy`` while jobs compute: then nothing was
        checked.

        Raises
        ------
        StateError
            ``no_calibration_accepted``, ``camera_busy``.
        CameraError
            The cameras' own errors.
        """
        return self._shared()

    def _check(self) -> LiveCheck:
        service = self._service
        calibration_id = newest_accepted(service)
        return LiveCheck(calibration_id, self._finding(calibration_id), now_utc())

    def _finding(self, calibration_id: str) -> LiveFinding:
        service = self._service
        if service.config.calibration.moves != "target" and (back := way_back(service)) is not None:
            text = str(back["text"]).split(":")[0] + ": the calibration holds at dZ = 0"
            return LiveFinding("off_zero", text)
        if service.jobs.active_count() or not service.worker.ready.is_set():
            return LiveFinding("busy", "a job is running, or the computation starts; the check continues after it")
        pixels = self._pair().pixels
        file = service.calibrations.path(calibration_id) / "calibration.json"
        task = LiveCheckTask(file, (pixels["cam1"], pixels["cam2"]))
        try:
            running = service.worker.submit(check_live, task)
            found: LiveFinding = running.result(timeout=_PATIENCE_S)
        except TimeoutError:
            running.request_stop()
            return LiveFinding("busy", "the computation took too long")
        except MeasurementError as error:
            return LiveFinding("no_texture", error.cause)
        return found

    def _pair(self) -> CapturedPair:
        """Take a pair as a live view does: without the hold; give up if none comes."""
        given_up = time.monotonic() + _PAIR_S

        def check() -> None:
            if time.monotonic() > given_up:
                raise StateError(
                    "No pair of live frames has come.",
                    code="camera_busy",
                    remedy="Check that the trigger reaches both cameras, or ask again once they are free.",
                )

        return self._service.rig.pair.capture(1, check)
