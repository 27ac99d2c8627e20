"""The service from a script or a notebook."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, Unpack

import httpx

from stereorig.client import cards, datasets, operations
from stereorig.client.errors import checked, no_answer
from stereorig.client.operations import Ask, Operation, Result, request_of
from stereorig.client.parameters import (
    AnalysisParameters,
    CalibrationParameters,
    ExtensometerGaugeParameters,
    GaugeParameters,
    MoveParameters,
    StepParameters,
)
from stereorig.client.progress import Progress, shown
from stereorig.client.settings import options_of
from stereorig.core.errors import StereorigError
from stereorig.server.api.models import (
    AnalysisReply,
    AnalysisRequest,
    CalibrationReply,
    CalibrationRequest,
    GaugesReply,
    JobReply,
    MoveRequest,
    RigReply,
    SceneReply,
    SceneRequest,
    StepReply,
    StepRequest,
    TestReply,
    TestRequest,
)
from stereorig.server.api.models.calibrations import CalibrationEntry
from stereorig.server.api.models.channels import ChannelsImported, ChannelsPreview
from stereorig.server.api.models.tests import StepEntry, TestEntry
from stereorig.server.formats.figures.card import card
from stereorig.server.results.gauges.request import GaugeRequest

if TYPE_CHECKING:
    import xarray


class Client:
    """A running service and its operations; a context manager that closes its connections.

    Parameters
    ----------
    url
        Address of the service.
    key
        A key that ``stereorig keys add`` made; none is needed on the loopback address.
    progress
        Bars while jobs run: True, False; None: in a terminal or a notebook, if rich is installed; or a function, called
        with the job.
    timeout_s
        Seconds without an answer after which a request fails.
    transport
        Carries the requests; the network when left out.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        key: str | None = None,
        progress: Progress = None,
        timeout_s: float = 60.0,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url, self.progress = url, progress
        self._http = httpx.Client(**options_of(url, key, timeout_s), transport=transport)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __repr__(self) -> str:
        return f"<Client of {self.url}>"

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send any request of the API, with a path below ``/api/v1``, for operations without a method here.

        Raises
        ------
        StereorigError
            As the service refused it.
        """
        try:
            return checked(self._http.request(method, "/" + path.lstrip("/"), **options))
        except httpx.TransportError as error:
            raise no_answer(self.url, error) from error

    # the rig ---------------------------------------------------------------------------------------------------------

    def rig(self) -> RigReply:
        """Return the rig: cameras, stage, target, who holds it."""
        return self._run(operations.get("/rig", RigReply))

    def move(self, request: MoveRequest | None = None, **targets: Unpack[MoveParameters]) -> JobReply:
        """Move axes to their end: ``positions_mm={"1": 2.0}``, ``dz_mm=`` or ``by_mm=``."""
        body = request_of(MoveRequest, request, targets)
        return self._watched("Moving", lambda on: operations.move(body, on))

    def set_scene(self, scene: str, load: float = 0.0, **params: Any) -> SceneReply:
        """Put a scene before a simulated rig's cameras."""
        body = request_of(SceneRequest, None, {"scene": scene, "load": load, **({"params": params} if params else {})})
        return self._run(operations.set_scene(body))

    # calibrations ----------------------------------------------------------------------------------------------------

    def calibrate(
        self, request: CalibrationRequest | None = None, *, accept: bool = True, **plan: Unpack[CalibrationParameters]
    ) -> CalibrationReply:
        """Calibrate the pair, wait for it, and accept it.

        Parameters
        ----------
        request
            The plan as a whole; or by its parameters' names. Values that are left out come from the rig file.
        accept
            Accept it, so that new tests take it. A calibration that fails its verdict raises before.

        Raises
        ------
        StereorigError
            ``calibration_rejected`` and others; nothing is accepted then.
        """
        body = request_of(CalibrationRequest, request, plan)
        return self._watched("Calibration", lambda on: operations.calibrate(body, accept, on))

    def import_calibration(
        self, path: str | Path, *, label: str = "", accept: bool = False, unit: str | None = None
    ) -> CalibrationReply:
        """Import ``calibration.json`` or another program's calibration of a stereo pair, its lengths in ``unit``."""
        file = Path(path)
        return self._run(operations.import_calibration(file.name, file.read_bytes(), label, accept, unit))

    def calibrations(self, *, accepted: bool | None = None, state: str | None = None) -> list[CalibrationEntry]:
        """List calibrations, oldest first; the one in force is the last of ``accepted=True``."""
        return self._run(operations.calibrations(accepted, state))

    def calibration(self, calibration_id: str) -> CalibrationReply:
        """Return a calibration."""
        return self._run(operations.review(calibration_id, None))

    # tests -----------------------------------------------------------------------------------------------------------

    def new_test(self, name: str, *, calibration_id: str | None = "latest", **fields: Any) -> Test:
        """Make a test.

        Parameters
        ----------
        name
            Any text.
        calibration_id
            ``latest``: the newest accepted; None: without one.
        **fields
            ``specimen``, ``notes``.
        """
        body = request_of(TestRequest, None, {"name": name, "calibration_id": calibration_id, **fields})
        return Test(self, self._run(operations.new_test(body)).id)

    def test(self, test_id: str) -> Test:
        """Return a test by its id; nothing is asked of the service.

        Raises
        ------
        InputError
            ``invalid_request`` for a text that is no test's id, as a name.
        """
        return Test(self, operations.id_of_test(test_id))

    def tests(self) -> list[TestEntry]:
        """List tests, oldest first."""
        return self._run(operations.tests())

    # jobs ------------------------------------------------------------------------------------------------------------

    def job(self, job_id: str) -> JobReply:
        """Return a job as it is now."""
        return self._run(operations.get(f"/jobs/{job_id}", JobReply))

    def wait(self, job: JobReply | str) -> JobReply:
        """Wait for a job's end; raises its problem if it did not succeed."""
        found = self.job(job) if isinstance(job, str) else job
        return self._watched(found.kind.capitalize(), lambda on: operations.ended(found, on))

    def cancel(self, job_id: str) -> JobReply:
        """Cancel a job and wait for its end."""
        return self._run(operations.cancel(job_id))

    # running ---------------------------------------------------------------------------------------------------------

    def _watched(self, title: str, operation: operations.Watched[Result]) -> Result:
        with shown(self.progress, title) as on_progress:
            return self._run(operation(on_progress))

    def _run(self, operation: Operation[Result]) -> Result:
        try:
            wanted = next(operation)
            while True:
                try:
                    answer = self._answer(wanted)
                except Exception as error:  # noqa: BLE001 - the operation may know what to do
                    wanted = operation.throw(error)
                else:
                    wanted = operation.send(answer)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]

    def _card(self, made: Operation[str], of: object) -> str:
        """Return the HTML of an object; its one line where the service does not answer."""
        try:
            return self._run(made)
        except StereorigError as error:
            return card(f"{of!r}: {error}", [])

    def _answer(self, wanted: Ask) -> httpx.Response:
        if wanted.into is None:
            return self.ask(wanted.method, wanted.path, **wanted.options)
        try:
            with self._http.stream(
                wanted.method, "/" + wanted.path.lstrip("/"), params=dict(wanted.params)
            ) as response:
                if not response.is_success:
                    response.read()
                checked(response)
                with wanted.into.open("wb") as file:
                    for part in response.iter_bytes():
                        file.write(part)
                return response
        except httpx.TransportError as error:
            raise no_answer(self.url, error) from error


class Test:
    """A test of a service: its steps, and their analyses.

    Attributes
    ----------
    id
        Its id.
    """

    def __init__(self, client: Client, test_id: str) -> None:
        self._client, self.id = client, test_id

    def __repr__(self) -> str:
        return f"<Test {self.id} of {self._client.url}>"

    def _repr_html_(self) -> str:
        return self._client._card(cards.test_card(self.id, self._client.url), self)

    def document(self) -> TestReply:
        """Return name, steps and analyses."""
        return self._client._run(operations.get(f"/tests/{self.id}", TestReply))

    def steps(self) -> list[StepEntry]:
        """Return a short entry of each complete step, in order; the test's document holds the first 100."""
        return self._client._run(operations.steps(self.id))

    def step(self, n: int) -> StepReply:
        """Return one step."""
        return self._client._run(operations.get(f"/tests/{self.id}/steps/{n}", StepReply))

    def capture(self, request: StepRequest | None = None, **fields: Unpack[StepParameters]) -> StepReply:
        """Capture a step: ``label=``, ``load_n=``, ``channels={"force_kn": 1.2}``; durable when this returns."""
        body = request_of(StepRequest, request, {"count": 1, **fields} if request is None else {})
        return self._client._run(operations.capture(self.id, body, None))[-1]

    def capture_burst(self, request: StepRequest | None = None, **fields: Unpack[StepParameters]) -> list[StepReply]:
        """Capture ``count`` steps, one every ``interval_ms``, to their end."""
        body = request_of(StepRequest, request, fields)
        return self._client._watched("Burst", lambda on: operations.capture(self.id, body, on))

    def import_step(self, cam1: str | Path, cam2: str | Path, **fields: Any) -> StepReply:
        """Import a pair of image files as a step; ``label``, ``load_n``, ``channels`` as captured."""
        images = Path(cam1).read_bytes(), Path(cam2).read_bytes()
        return self._client._run(operations.import_step(self.id, images, operations.step_form(fields)))

    def import_channels(self, path: str | Path, **options: Any) -> ChannelsImported:
        """Import a load frame's CSV and align it with the steps by time; see the API's ``channels:import``."""
        file = Path(path)
        return self._client._run(operations.import_channels(self.id, file.name, file.read_bytes(), options))

    def preview_channels(self, path: str | Path, **options: Any) -> ChannelsPreview:
        """Return the effect of :meth:`import_channels` with these options: columns, steps, doubts; nothing changes."""
        file = Path(path)
        return self._client._run(operations.preview_channels(self.id, file.name, file.read_bytes(), options))

    def live(self, **settings: Any) -> dict[str, Any]:
        """Begin a live measurement: ``points=[{"name": "p1", "xy_px": [210, 180]}]``, ``extensometers``, ``areas``.

        Takes the parameters of the API's ``POST /tests/{id}/live``, and returns its state.
        """
        return self._client._run(operations.begin_live(self.id, settings))

    def live_values(self) -> dict[str, Any]:
        """Return the newest values of the live measurement: gauges by name, each with ``valid`` and ``values``."""
        state: dict[str, Any] = self._client._run(operations.live_state(self.id))
        values: dict[str, Any] = state["values"]
        return values

    def stop_live(self) -> dict[str, Any]:
        """End the live measurement; return its last state, with the account of its frames."""
        return self._client._run(operations.stop_live(self.id))

    def measure(self, request: AnalysisRequest | None = None, **settings: Unpack[AnalysisParameters]) -> Analysis:
        """Measure the steps, and wait for it; with ``follow=True`` it continues with each new step.

        Parameters
        ----------
        request
            The analysis as a whole; or by its parameters' names: ``region={"rectangle": [90, 80, 420, 400]}`` ...

        Raises
        ------
        StereorigError
            ``steps_failed`` and others; the steps that were measured can be read all the same (:meth:`analyses`).
        """
        body = request_of(AnalysisRequest, request, settings)
        analysis = self._client._watched("Measurement", lambda on: operations.measure(self.id, body, on))
        return Analysis(self._client, self.id, analysis)

    def analysis(self, analysis_id: str) -> Analysis:
        """Return an analysis by its id; nothing is asked of the service."""
        return Analysis(self._client, self.id, analysis_id)

    def analyses(self) -> list[Analysis]:
        """Return the test's analyses, oldest first."""
        return [self.analysis(one.id) for one in self.document().analyses]


class Analysis:
    """The results of one measurement of a test's steps.

    Attributes
    ----------
    id, test_id
        Its id, and its test's.
    """

    def __init__(self, client: Client, test_id: str, analysis_id: str) -> None:
        self._client, self.test_id, self.id = client, test_id, analysis_id
        self._path = f"/tests/{test_id}/analyses/{analysis_id}"

    def __repr__(self) -> str:
        return f"<Analysis {self.id} of {self.test_id}, {self._client.url}>"

    def _repr_html_(self) -> str:
        return self._client._card(cards.analysis_card(self._path), self)

    def document(self) -> AnalysisReply:
        """Return settings, state and summary."""
        return self._client._run(operations.get(self._path, AnalysisReply))

    def finish(self) -> JobReply:
        """Let an analysis that follows its test measure the steps there are, and end."""
        return self._client._watched("Measurement", lambda on: operations.finish(self._path, on))

    def dataset(self, step: int | None = None, *, frame: str | None = None) -> xarray.Dataset:
        """Return one step's result, or all of them along ``step``; needs xarray.

        ``frame`` is that of positions, displacements and strain: None or ``system``, as stored; ``specimen``, the
        test's own, in which the page shows them. The attribute ``frame`` of each array states it.
        """
        return datasets.stacked(self._client._run(operations.netcdf_of(self._path, None, step, frame)))

    def field(self, name: str, step: int | None = None, *, frame: str | None = None) -> xarray.DataArray:
        """Return a variable (``w_mm``, ``exx`` ...) of one step or of all that have it, as :meth:`dataset` does."""
        return datasets.array_of(self._client._run(operations.netcdf_of(self._path, name, step, frame)), name)

    def gauges(
        self, request: GaugeRequest | None = None, *, frame: str | None = None, **gauges: Unpack[GaugeParameters]
    ) -> GaugesReply:
        """Read points, extensometers, lines and areas in every step: ``points=[{"xy_px": [210, 180]}]`` ..."""
        return self._client._run(operations.gauges(self._path, request_of(GaugeRequest, request, gauges), frame))

    def extensometer(self, a_px: tuple[float, float], b_px: tuple[float, float], **more: Any) -> xarray.Dataset:
        """Read a strain gauge between two positions in every step, with load, channels and time; needs xarray."""
        ends: list[ExtensometerGaugeParameters] = [{"a_px": a_px, "b_px": b_px}]
        return datasets.extensometers(self.gauges(extensometers=ends, **more))

    def export(self, path: str | Path, format: str = "nc", **options: Any) -> Path:  # noqa: A002
        """Write results in a form that other programs read: ``csv``, ``vtu``, ``mat``, ``h5``, ``png``, ``gif`` ..."""
        params = {"format": format, **options}
        return self._client._run(operations.saved(f"{self._path}/export", Path(path), params))

    def report(self, path: str | Path, *, frame: str | None = None) -> Path:
        """Write the report, a self-contained HTML page."""
        return self._client._run(operations.saved(f"{self._path}/report", Path(path), operations.in_frame(frame)))
