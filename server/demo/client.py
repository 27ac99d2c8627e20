"""A client of the service: everything the demo does with the rig goes through here, over HTTP."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
from pydantic import TypeAdapter

from stereorig.core.arrays import Float
from stereorig.core.errors import MeasurementError, StateError, StorageError
from stereorig.server.formats.calibrations.record import CalibrationRecord
from stereorig.server.formats.gauges.readings import StepReadings
from stereorig.server.formats.records import Record

OnProgress = Callable[[str, int, int, float | None], None]

_POLL_S = 0.25
_REQUEST_TIMEOUT_S = 60.0
_READINGS = TypeAdapter(list[StepReadings])
_ENDED = ("succeeded", "failed", "cancelled", "interrupted")


@dataclass(frozen=True)
class AnalysisHandle:
    """An analysis that has ended."""

    test_id: str
    analysis_id: str


@dataclass(frozen=True)
class Calibrated:
    """A calibration that has ended: its record, and the checks that the service made."""

    id: str
    record: CalibrationRecord
    checks: object
    verdict: object


class _Progress(Record):
    phase: str | None = None
    done: int = 0
    total: int = 0
    eta_s: float | None = None


class _Problem(Record):
    code: str = "job_failed"
    detail: str = "no reason given"
    remedy: str = "Look at the service's log."


class DemoJob(Record):
    """A job of the service."""

    kind: str
    state: str
    progress: _Progress = _Progress()
    problem: _Problem = _Problem()


class ServiceClient:
    """Drives one service.

    Parameters
    ----------
    base_url
        ``http://127.0.0.1:port``.
    on_progress
        Called with (phase, done, total, seconds left or None) while a job runs.
    transport
        Carries the requests; the network when left out.
    headers
        Sent with every request, such as a key.
    """

    def __init__(
        self,
        base_url: str,
        on_progress: OnProgress | None = None,
        *,
        transport: httpx.BaseTransport | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        self._http = httpx.Client(
            base_url=f"{base_url}/api/v1",
            timeout=_REQUEST_TIMEOUT_S,
            trust_env=False,
            transport=transport,
            headers=headers,
        )
        self._on_progress = on_progress

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> ServiceClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Make one request; a problem comes back as the project's own error.

        Raises
        ------
        StateError
            With the service's code, cause and remedy, for any answer that is not a success.
        """
        try:
            response = self._http.request(method, path, **options)
        except httpx.TransportError as error:
            raise StateError(
                f"{method} {path} got no answer ({type(error).__name__}).",
                code="service_lost",
                remedy="Look at the service's log.",
            ) from error
        if response.is_success:
            return response
        try:
            problem = response.json()
        except ValueError:
            problem = {}
        raise StateError(
            f"{method} {path} was answered {response.status_code}: {problem.get('detail', response.text[:200])}",
            code=str(problem.get("code", "http_error")),
            remedy=str(problem.get("remedy", "Look at the service's log.")),
        )

    def get(self, path: str, **params: Any) -> Any:
        """GET a JSON document."""
        return self.call("GET", path, params=params).json()

    def set_scene(self, scene: str, load: float = 0.0, **params: Any) -> None:
        """Put a scene before the simulated cameras; load in kPa (plate) or kN (panel)."""
        body = {"scene": scene, "load": load}
        self.call("PUT", "/sim/scene", json=body | ({"params": params} if params else {}))

    def calibrate(self, **plan: Any) -> Calibrated:
        """Run the calibration sequence; return the reply of ``GET /calibrations/{id}``."""
        accepted = self.call("POST", "/calibrations", json=plan).json()
        self.wait(accepted["job"]["id"])
        calibration_id = str(accepted["calibration_id"])
        document = self.get(f"/calibrations/{calibration_id}")
        record = CalibrationRecord.model_validate(document)
        return Calibrated(calibration_id, record, document.get("checks"), document.get("verdict"))

    def create_test(self, name: str, calibration_id: str, specimen: str = "") -> str:
        """Make a test; return its id."""
        body = {"name": name, "calibration_id": calibration_id, "specimen": specimen}
        return str(self.call("POST", "/tests", json=body).json()["id"])

    def capture(self, test_id: str, label: str, *, load_n: float | None = None) -> None:
        """Capture one step."""
        self.call("POST", f"/tests/{test_id}/steps", json={"label": label, "load_n": load_n})

    def analyse(self, test_id: str, kind: str, region: Mapping[str, object], **settings: Any) -> AnalysisHandle:
        """Run an analysis to its end; the region as the API takes it."""
        body = {"kind": kind, "region": region, **settings}
        accepted = self.call("POST", f"/tests/{test_id}/analyses", json=body).json()
        self.wait(accepted["job"]["id"])
        return AnalysisHandle(test_id, str(accepted["analysis_id"]))

    def field(self, analysis: AnalysisHandle, step: int, name: str) -> Float:
        """Fetch one variable of one step."""
        path = f"/tests/{analysis.test_id}/analyses/{analysis.analysis_id}/steps/{step}/fields/{name}"
        data = self.call("GET", path, params={"format": "npy"}).content
        return np.asarray(np.load(io.BytesIO(data), allow_pickle=False))

    def gauges(self, analysis: AnalysisHandle, **request: Any) -> Sequence[StepReadings]:
        """Read gauges in every step; the request as ``POST .../gauges`` takes it."""
        path = f"/tests/{analysis.test_id}/analyses/{analysis.analysis_id}/gauges"
        found: list[object] = []
        cursor: dict[str, str] = {}
        while True:
            page = self.call("POST", path, json=request, params=cursor).json()
            found += page["steps"]
            if page.get("next_cursor") is None:
                return _READINGS.validate_python(found)
            cursor = {"cursor": page["next_cursor"]}

    def evaluate(self, analysis: AnalysisHandle, name: str, **settings: Any) -> Any:
        """Return the document of an evaluation, with the settings that it takes."""
        path = f"/tests/{analysis.test_id}/analyses/{analysis.analysis_id}/evaluations/{name}"
        return self.call("POST", path, json={"settings": settings}).json()["document"]

    def export(self, analysis: AnalysisHandle, step: int) -> bytes:
        """Fetch the result file of one step."""
        path = f"/tests/{analysis.test_id}/analyses/{analysis.analysis_id}/export"
        data = self.call("GET", path, params={"format": "nc", "step": step}).content
        if not data:
            raise StorageError(f"The export of step {step} came back empty.")
        return data

    def wait(self, job_id: str) -> None:
        """Wait for a job's end.

        Raises
        ------
        MeasurementError
            With the job's problem, if it did not succeed.
        """
        while True:
            job = DemoJob.model_validate(self.get(f"/jobs/{job_id}"))
            at = job.progress
            if self._on_progress is not None:
                self._on_progress(at.phase or job.state, at.done, at.total, at.eta_s)
            if job.state in _ENDED:
                break
            time.sleep(_POLL_S)
        if job.state != "succeeded":
            problem = job.problem
            raise MeasurementError(
                f"The {job.kind} job {job_id} ended as {job.state}: {problem.detail}",
                code=problem.code,
                remedy=problem.remedy,
            )
