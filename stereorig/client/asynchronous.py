"""The service from a program with an event loop; each method is the counterpart of one of :class:`Client`."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, Unpack

import httpx

from stereorig.client import datasets, operations
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
from stereorig.server.results.gauges.request import GaugeRequest

if TYPE_CHECKING:
    import xarray


class AsyncClient:
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
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.url, self.progress = url, progress
        self._http = httpx.AsyncClient(**options_of(url, key, timeout_s), transport=transport)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Do as :meth:`Client.ask`."""
        try:
            return checked(await self._http.request(method, "/" + path.lstrip("/"), **options))
        except httpx.TransportError as error:
            raise no_answer(self.url, error) from error

    # the rig ---------------------------------------------------------------------------------------------------------

    async def rig(self) -> RigReply:
        """Do as :meth:`Client.rig`."""
        return await self._run(operations.get("/rig", RigReply))

    async def move(self, request: MoveRequest | None = None, **targets: Unpack[MoveParameters]) -> JobReply:
        """Do as :meth:`Client.move`."""
        body = request_of(MoveRequest, request, targets)
        return await self._watched("Moving", lambda on: operations.move(body, on))

    async def set_scene(self, scene: str, load: float = 0.0, **params: Any) -> SceneReply:
        """Do as :meth:`Client.set_scene`."""
        body = request_of(SceneRequest, None, {"scene": scene, "load": load, **({"params": params} if params else {})})
        return await self._run(operations.set_scene(body))

    # calibrations ----------------------------------------------------------------------------------------------------

    async def calibrate(
        self, request: CalibrationRequest | None = None, *, accept: bool = True, **plan: Unpack[CalibrationParameters]
    ) -> CalibrationReply:
        """Do as :meth:`Client.calibrate`."""
        body = request_of(CalibrationRequest, request, plan)
        return await self._watched("Calibration", lambda on: operations.calibrate(body, accept, on))

    async def import_calibration(
        self, path: str | Path, *, label: str = "", accept: bool = False, unit: str | None = None
    ) -> CalibrationReply:
        """Do as :meth:`Client.import_calibration`."""
        file = Path(path)
        return await self._run(operations.import_calibration(file.name, file.read_bytes(), label, accept, unit))

    async def calibrations(self, *, accepted: bool | None = None, state: str | None = None) -> list[CalibrationEntry]:
        """Do as :meth:`Client.calibrations`."""
        return await self._run(operations.calibrations(accepted, state))

    async def calibration(self, calibration_id: str) -> CalibrationReply:
        """Do as :meth:`Client.calibration`."""
        return await self._run(operations.review(calibration_id, None))

    # tests -----------------------------------------------------------------------------------------------------------

    async def new_test(self, name: str, *, calibration_id: str | None = "latest", **fields: Any) -> AsyncTest:
        """Do as :meth:`Client.new_test`."""
        body = request_of(TestRequest, None, {"name": name, "calibration_id": calibration_id, **fields})
        return AsyncTest(self, (await self._run(operations.new_test(body))).id)

    def test(self, test_id: str) -> AsyncTest:
        """Do as :meth:`Client.test`."""
        return AsyncTest(self, operations.id_of_test(test_id))

    async def tests(self) -> list[TestEntry]:
        """Do as :meth:`Client.tests`."""
        return await self._run(operations.tests())

    # jobs ------------------------------------------------------------------------------------------------------------

    async def job(self, job_id: str) -> JobReply:
        """Do as :meth:`Client.job`."""
        return await self._run(operations.get(f"/jobs/{job_id}", JobReply))

    async def wait(self, job: JobReply | str) -> JobReply:
        """Do as :meth:`Client.wait`."""
        found = await self.job(job) if isinstance(job, str) else job
        return await self._watched(found.kind.capitalize(), lambda on: operations.ended(found, on))

    async def cancel(self, job_id: str) -> JobReply:
        """Do as :meth:`Client.cancel`."""
        return await self._run(operations.cancel(job_id))

    # running ---------------------------------------------------------------------------------------------------------

    async def _watched(self, title: str, operation: operations.Watched[Result]) -> Result:
        with shown(self.progress, title) as on_progress:
            return await self._run(operation(on_progress))

    async def _run(self, operation: Operation[Result]) -> Result:
        try:
            wanted = next(operation)
            while True:
                try:
                    answer = await self._answer(wanted)
                except Exception as error:  # noqa: BLE001 - the operation may know what to do
                    wanted = operation.throw(error)
                else:
                    wanted = operation.send(answer)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]

    async def _answer(self, wanted: Ask) -> httpx.Response:
        if wanted.into is None:
            return await self.ask(wanted.method, wanted.path, **wanted.options)
        try:
            async with self._http.stream(
                wanted.method, "/" + wanted.path.lstrip("/"), params=dict(wanted.params)
            ) as response:
                if not response.is_success:
                    await response.aread()
                checked(response)
                with wanted.into.open("wb") as file:
                    async for part in response.aiter_bytes():
                        file.write(part)
                return response
        except httpx.TransportError as error:
            raise no_answer(self.url, error) from error


class AsyncTest:
    """A test of a service: its steps, and their analyses.

    Attributes
    ----------
    id
        Its id.
    """

    def __init__(self, client: AsyncClient, test_id: str) -> None:
        self._client, self.id = client, test_id

    async def document(self) -> TestReply:
        """Do as :meth:`Test.document`."""
        return await self._client._run(operations.get(f"/tests/{self.id}", TestReply))

    async def steps(self) -> list[StepEntry]:
        """Do as :meth:`Test.steps`."""
        return await self._client._run(operations.steps(self.id))

    async def step(self, n: int) -> StepReply:
        """Do as :meth:`Test.step`."""
        return await self._client._run(operations.get(f"/tests/{self.id}/steps/{n}", StepReply))

    async def capture(self, request: StepRequest | None = None, **fields: Unpack[StepParameters]) -> StepReply:
        """Do as :meth:`Test.capture`."""
        body = request_of(StepRequest, request, {"count": 1, **fields} if request is None else {})
        return (await self._client._run(operations.capture(self.id, body, None)))[-1]

    async def capture_burst(
        self, request: StepRequest | None = None, **fields: Unpack[StepParameters]
    ) -> list[StepReply]:
        """Do as :meth:`Test.capture_burst`."""
        body = request_of(StepRequest, request, fields)
        return await self._client._watched("Burst", lambda on: operations.capture(self.id, body, on))

    async def import_step(self, cam1: str | Path, cam2: str | Path, **fields: Any) -> StepReply:
        """Do as :meth:`Test.import_step`."""
        images = Path(cam1).read_bytes(), Path(cam2).read_bytes()
        return await self._client._run(operations.import_step(self.id, images, operations.step_form(fields)))

    async def import_channels(self, path: str | Path, **options: Any) -> ChannelsImported:
        """Do as :meth:`Test.import_channels`."""
        file = Path(path)
        return await self._client._run(operations.import_channels(self.id, file.name, file.read_bytes(), options))

    async def preview_channels(self, path: str | Path, **options: Any) -> ChannelsPreview:
        """Do as :meth:`Test.preview_channels`."""
        file = Path(path)
        return await self._client._run(operations.preview_channels(self.id, file.name, file.read_bytes(), options))

    async def live(self, **settings: Any) -> dict[str, Any]:
        """Begin a live measurement: ``points=[{"name": "p1", "xy_px": [210, 180]}]``, ``extensometers``, ``areas``.

        Takes the parameters of the API's ``POST /tests/{id}/live``, and returns its state.
        """
        return await self._client._run(operations.begin_live(self.id, settings))

    async def live_values(self) -> dict[str, Any]:
        """Return the newest values of the live measurement: gauges by name, each with ``valid`` and ``values``."""
        state: dict[str, Any] = await self._client._run(operations.live_state(self.id))
        values: dict[str, Any] = state["values"]
        return values

    async def stop_live(self) -> dict[str, Any]:
        """End the live measurement; return its last state, with the account of its frames."""
        return await self._client._run(operations.stop_live(self.id))

    async def measure(
        self, request: AnalysisRequest | None = None, **settings: Unpack[AnalysisParameters]
    ) -> AsyncAnalysis:
        """Do as :meth:`Test.measure`."""
        body = request_of(AnalysisRequest, request, settings)
        analysis = await self._client._watched("Measurement", lambda on: operations.measure(self.id, body, on))
        return AsyncAnalysis(self._client, self.id, analysis)

    def analysis(self, analysis_id: str) -> AsyncAnalysis:
        """Return an analysis by its id; nothing is asked of the service."""
        return AsyncAnalysis(self._client, self.id, analysis_id)

    async def analyses(self) -> list[AsyncAnalysis]:
        """Do as :meth:`Test.analyses`."""
        return [self.analysis(one.id) for one in (await self.document()).analyses]


class AsyncAnalysis:
    """The results of one measurement of a test's steps.

    Attributes
    ----------
    id, test_id
        Its id, and its test's.
    """

    def __init__(self, client: AsyncClient, test_id: str, analysis_id: str) -> None:
        self._client, self.test_id, self.id = client, test_id, analysis_id
        self._path = f"/tests/{test_id}/analyses/{analysis_id}"

    async def document(self) -> AnalysisReply:
        """Do as :meth:`Analysis.document`."""
        return await self._client._run(operations.get(self._path, AnalysisReply))

    async def finish(self) -> JobReply:
        """Do as :meth:`Analysis.finish`."""
        return await self._client._watched("Measurement", lambda on: operations.finish(self._path, on))

    async def dataset(self, step: int | None = None, *, frame: str | None = None) -> xarray.Dataset:
        """Do as :meth:`Analysis.dataset`."""
        return datasets.stacked(await self._client._run(operations.netcdf_of(self._path, None, step, frame)))

    async def field(self, name: str, step: int | None = None, *, frame: str | None = None) -> xarray.DataArray:
        """Do as :meth:`Analysis.field`."""
        return datasets.array_of(await self._client._run(operations.netcdf_of(self._path, name, step, frame)), name)

    async def gauges(
        self, request: GaugeRequest | None = None, *, frame: str | None = None, **gauges: Unpack[GaugeParameters]
    ) -> GaugesReply:
        """Do as :meth:`Analysis.gauges`."""
        return await self._client._run(operations.gauges(self._path, request_of(GaugeRequest, request, gauges), frame))

    async def extensometer(self, a_px: tuple[float, float], b_px: tuple[float, float], **more: Any) -> xarray.Dataset:
        """Do as :meth:`Analysis.extensometer`."""
        ends: list[ExtensometerGaugeParameters] = [{"a_px": a_px, "b_px": b_px}]
        return datasets.extensometers(await self.gauges(extensometers=ends, **more))

    async def export(self, path: str | Path, format: str = "nc", **options: Any) -> Path:  # noqa: A002
        """Do as :meth:`Analysis.export`."""
        params = {"format": format, **options}
        return await self._client._run(operations.saved(f"{self._path}/export", Path(path), params))

    async def report(self, path: str | Path, *, frame: str | None = None) -> Path:
        """Do as :meth:`Analysis.report`."""
        return await self._client._run(operations.saved(f"{self._path}/report", Path(path), operations.in_frame(frame)))
