"""Each thing that a client does, as the requests that it takes: one text for :class:`Client` and :class:`AsyncClient`.

An operation is a generator: it yields an :class:`Ask`, is sent the answer, and returns the result. Who runs it decides
whether a thread or an event loop waits.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

import httpx
from pydantic import BaseModel, ValidationError

from stereorig.client.errors import error_of
from stereorig.client.progress import OnProgress
from stereorig.core.errors import InputError, StorageError
from stereorig.server.api.models import (
    AnalysisAccepted,
    AnalysisRequest,
    AnalysisStepList,
    CalibrationAccepted,
    CalibrationReply,
    CalibrationRequest,
    GaugesReply,
    JobReply,
    MoveRequest,
    SceneReply,
    SceneRequest,
    StepReply,
    StepRequest,
    TestReply,
    TestRequest,
)
from stereorig.server.api.models.calibrations import CalibrationEntry, CalibrationList
from stereorig.server.api.models.channels import ChannelsImported, ChannelsPreview
from stereorig.server.api.models.jobs import JobStepList
from stereorig.server.api.models.tests import StepEntry, StepList, TestEntry, TestList
from stereorig.server.base.models import Listing
from stereorig.server.results.gauges.request import GaugeRequest
from stereorig.server.wording import problems_in

Model = TypeVar("Model", bound=BaseModel)
Result = TypeVar("Result")
Page = TypeVar("Page", bound=Listing)
Thing = TypeVar("Thing")
#: seconds that one request waits for a job; shorter if a function receives its progress
_WAIT_S, _LOOK_S = 30.0, 0.5
#: steps of a page of gauge readings
_GAUGE_STEPS = 500
_FINAL = ("succeeded", "failed", "cancelled", "interrupted")


@dataclass(frozen=True)
class Ask:
    """A request that an operation wants answered."""

    method: str
    path: str
    params: Mapping[str, Any] = field(default_factory=dict)
    json: Any = None
    files: Mapping[str, Any] | None = None
    data: Mapping[str, Any] | None = None
    #: the answer is sent into this file
    into: Path | None = None
    #: names the request, so that it has one effect if it must be sent again
    key: str | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Arguments for httpx."""
        headers = {} if self.key is None else {"Idempotency-Key": self.key}
        whole = {"params": dict(self.params), "json": self.json, "files": self.files, "data": self.data}
        return {name: value for name, value in whole.items() if value is not None} | {"headers": headers}


Operation = Generator[Ask, httpx.Response, Result]
#: an operation that waits for a job and reports the job's progress
Watched = Callable[[OnProgress | None], Operation[Result]]


def request_of(model: type[Model], given: Model | None, named: Mapping[str, Any]) -> Model:
    """Return a request that is given as a whole or by its parameters' names.

    Raises
    ------
    InputError
        ``invalid_request`` in the sender's words, before anything is sent.
    """
    if given is not None:
        if named:
            raise InputError("The request is given twice.", remedy="Give it as a whole, or by its parameters' names.")
        return given
    try:
        return model.model_validate(dict(named))
    except ValidationError as error:
        text = " ".join(str(one) for one in problems_in(error)[:3])
        raise InputError(text, code="invalid_request", remedy="Correct the values named above.") from error


def id_of_test(text: str) -> str:
    """Return a test's id.

    Raises
    ------
    InputError
        ``invalid_request`` for a text that is none.
    """
    if not re.fullmatch(r"t[0-9]+-[0-9a-f]+", text):
        raise InputError(
            f"{text[:60]!r} is no test's id.",
            code="invalid_request",
            remedy="Give one as t000001-0c9f1e; `tests()` lists ids and names.",
        )
    return text


def _body(request: BaseModel) -> Any:
    return request.model_dump(mode="json", exclude_unset=True)


def _posted(path: str, request: BaseModel, answer: type[Model]) -> Operation[Model]:
    return _read((yield Ask("POST", path, json=_body(request), key=uuid4().hex)), answer)


def _read(response: httpx.Response, answer: type[Model]) -> Model:
    return answer.model_validate(response.json())


def get(path: str, answer: type[Model], **params: Any) -> Operation[Model]:
    """Read one document."""
    return _read((yield Ask("GET", path, params=params)), answer)


def _all(path: str, answer: type[Page], things: Callable[[Page], list[Thing]], **asked: Any) -> Operation[list[Thing]]:
    """Read a list page by page."""
    found: list[Thing] = []
    while True:
        page = yield from get(path, answer, **asked)
        found += things(page)
        if page.next_cursor is None:
            return found
        asked["cursor"] = page.next_cursor


# jobs ----------------------------------------------------------------------------------------------------------------


def ended(job: JobReply, on_progress: OnProgress | None = None) -> Operation[JobReply]:
    """Wait for a job's end.

    Raises
    ------
    StereorigError
        The job's problem, if it did not succeed.
    """
    wait = _WAIT_S if on_progress is None else _LOOK_S
    while job.state not in _FINAL:
        if on_progress is not None:
            on_progress(job)
        job = yield from get(f"/jobs/{job.id}", JobReply, wait=wait)
    if on_progress is not None:
        on_progress(job)
    if job.state == "succeeded":
        return job
    problem = {} if job.problem is None else job.problem.model_dump()
    if job.state == "cancelled":  # the reason for the cancelling, a stopped motion for example
        problem["code"] = "cancelled"
    raise error_of({"code": f"job_{job.state}", "detail": f"The {job.kind} is {job.state}.", **problem})


def cancel(job_id: str) -> Operation[JobReply]:
    """Cancel a job, and wait for its end."""
    return _read((yield Ask("POST", f"/jobs/{job_id}:cancel", params={"wait": _WAIT_S})), JobReply)


# rig -----------------------------------------------------------------------------------------------------------------


def move(request: MoveRequest, on_progress: OnProgress | None) -> Operation[JobReply]:
    """Move axes to their end."""
    answer = yield Ask("POST", "/stage/moves", json=_body(request), key=uuid4().hex)
    return (yield from ended(JobReply.model_validate(answer.json()["job"]), on_progress))


def set_scene(request: SceneRequest) -> Operation[SceneReply]:
    """Put a scene before a simulated rig's cameras."""
    return _read((yield Ask("PUT", "/sim/scene", json=_body(request))), SceneReply)


# calibrations --------------------------------------------------------------------------------------------------------


def calibrate(request: CalibrationRequest, accept: bool, on_progress: OnProgress | None) -> Operation[CalibrationReply]:
    """Calibrate, wait, and accept the result."""
    begun = yield from _posted("/calibrations", request, CalibrationAccepted)
    yield from ended(begun.job, on_progress)
    return (yield from review(begun.calibration_id, "accepted" if accept else None))


def import_calibration(
    name: str, content: bytes, label: str, accept: bool, unit: str | None
) -> Operation[CalibrationReply]:
    """Import another program's calibration."""
    data = {"label": label, **({} if unit is None else {"unit": unit})}
    sent = Ask("POST", "/calibrations:import", files={"file": (name, content)}, data=data, key=uuid4().hex)
    made = _read((yield sent), CalibrationReply)
    return (yield from review(made.id, "accepted" if accept else None))


def review(calibration_id: str, decision: str | None) -> Operation[CalibrationReply]:
    """Decide on a calibration; without a decision, read it."""
    if decision is None:
        return (yield from get(f"/calibrations/{calibration_id}", CalibrationReply))
    answer = yield Ask("PUT", f"/calibrations/{calibration_id}/review", json={"decision": decision})
    return _read(answer, CalibrationReply)


def calibrations(accepted: bool | None, state: str | None) -> Operation[list[CalibrationEntry]]:
    """List calibrations, oldest first."""
    asked: dict[str, Any] = {"accepted": accepted, "state": state}
    asked = {name: value for name, value in asked.items() if value is not None}
    return (yield from _all("/calibrations", CalibrationList, lambda page: page.calibrations, **asked))


# tests ---------------------------------------------------------------------------------------------------------------


def new_test(request: TestRequest) -> Operation[TestReply]:
    """Make a test."""
    return (yield from _posted("/tests", request, TestReply))


def tests() -> Operation[list[TestEntry]]:
    """List tests, oldest first."""
    return (yield from _all("/tests", TestList, lambda page: page.tests))


def steps(test_id: str) -> Operation[list[StepEntry]]:
    """List a test's complete steps, in order."""
    return (yield from _all(f"/tests/{test_id}/steps", StepList, lambda page: page.steps))


def capture(test_id: str, request: StepRequest, on_progress: OnProgress | None) -> Operation[list[StepReply]]:
    """Capture a step, or a burst of them, to its end."""
    answer = yield Ask("POST", f"/tests/{test_id}/steps", json=_body(request), key=uuid4().hex)
    if request.count == 1:
        return [_read(answer, StepReply)]
    job = yield from ended(JobReply.model_validate(answer.json()["job"]), on_progress)
    taken = yield from _all(f"/jobs/{job.id}/steps", JobStepList, lambda page: page.steps)
    found = []
    for one in taken:
        found.append((yield from get(f"/tests/{test_id}/steps/{one.n}", StepReply)))
    return found


def step_form(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return a step's entries as a form sends them.

    Raises
    ------
    InputError
        ``invalid_request`` in the sender's words.
    """
    form = _body(request_of(StepRequest, None, fields))
    if "channels" in form:
        form["channels"] = json.dumps(form["channels"])
    return {name: value for name, value in form.items() if value is not None}


def import_step(test_id: str, images: tuple[bytes, bytes], form: Mapping[str, Any]) -> Operation[StepReply]:
    """Import a pair of image files as a step."""
    files = {cam: (f"{cam}.img", data) for cam, data in zip(("cam1", "cam2"), images, strict=True)}
    sent = Ask("POST", f"/tests/{test_id}/steps:import", files=files, data=form, key=uuid4().hex)
    return _read((yield sent), StepReply)


def import_channels(test_id: str, name: str, content: bytes, options: Mapping[str, Any]) -> Operation[ChannelsImported]:
    """Import a load frame's CSV and align it with the steps."""
    return _read((yield _record(test_id, "import", name, content, options)), ChannelsImported)


def preview_channels(test_id: str, name: str, content: bytes, options: Mapping[str, Any]) -> Operation[ChannelsPreview]:
    """Return the effect that an import of a load frame's CSV would have."""
    return _read((yield _record(test_id, "preview", name, content, options)), ChannelsPreview)


def _record(test_id: str, action: str, name: str, content: bytes, options: Mapping[str, Any]) -> Ask:
    sent = {option: str(value) for option, value in options.items() if value is not None}
    files = {"file": (name, content)}
    return Ask("POST", f"/tests/{test_id}/channels:{action}", files=files, data=sent, key=uuid4().hex)


def begin_live(test_id: str, body: Mapping[str, Any]) -> Operation[dict[str, Any]]:
    """Begin a live measurement; return its state."""
    answer = yield Ask("POST", f"/tests/{test_id}/live", json=dict(body), key=uuid4().hex)
    return _plain(answer)


def live_state(test_id: str) -> Operation[dict[str, Any]]:
    """Return the state of a live measurement, with its newest values."""
    answer = yield Ask("GET", f"/tests/{test_id}/live")
    return _plain(answer)


def stop_live(test_id: str) -> Operation[dict[str, Any]]:
    """End a live measurement; return its last state."""
    answer = yield Ask("POST", f"/tests/{test_id}/live:stop")
    return _plain(answer)


def _plain(answer: httpx.Response) -> dict[str, Any]:
    found: dict[str, Any] = answer.json()
    return found


def measure(test_id: str, request: AnalysisRequest, on_progress: OnProgress | None) -> Operation[str]:
    """Measure a test's steps; return the analysis' id once it has ended, of one that follows at once."""
    begun = yield from _posted(f"/tests/{test_id}/analyses", request, AnalysisAccepted)
    if not request.follow:
        yield from ended(begun.job, on_progress)
    return begun.analysis_id


# results -------------------------------------------------------------------------------------------------------------


def finish(path: str, on_progress: OnProgress | None) -> Operation[JobReply]:
    """Let an analysis that follows its test come to its end."""
    answer = yield Ask("POST", f"{path}:finish")
    return (yield from ended(JobReply.model_validate(answer.json()["job"]), on_progress))


def finished_steps(path: str) -> Operation[list[int]]:
    """Return the numbers of the steps whose results can be read."""
    each = yield from _all(f"{path}/steps", AnalysisStepList, lambda page: page.steps, figures=False)
    return [one.n for one in each if one.state == "finished"]


def in_frame(frame: str | None) -> dict[str, str]:
    """Return the parameter that asks for a frame; none for None."""
    return {} if frame is None else {"frame": frame}


def netcdf_of(path: str, name: str | None, step: int | None, frame: str | None) -> Operation[dict[int, bytes]]:
    """Return NetCDF files of one step or of all that are finished: of all variables, or of one."""
    form = {"format": "nc", **in_frame(frame)}
    steps = (yield from finished_steps(path)) if step is None else [step]
    found: dict[int, bytes] = {}
    for n in steps:
        if name is None:
            found[n] = (yield Ask("GET", f"{path}/export", params={**form, "step": n})).content
            continue
        try:
            found[n] = (yield Ask("GET", f"{path}/steps/{n}/fields/{name}", params=form)).content
        except InputError as error:
            # the reference has a shape and no displacement
            if error.code != "field_missing" or len(steps) == 1 or n == steps[-1]:
                raise
    return found


def gauges(path: str, request: GaugeRequest, frame: str | None) -> Operation[GaugesReply]:
    """Read gauges in every step, page by page."""
    pages: list[GaugesReply] = []
    asked: dict[str, Any] = {"limit": _GAUGE_STEPS, **in_frame(frame)}
    while True:
        answer = yield Ask("POST", f"{path}/gauges", json=_body(request), params=dict(asked), key=uuid4().hex)
        pages.append(_read(answer, GaugesReply))
        if pages[-1].next_cursor is None:
            break
        asked["cursor"] = pages[-1].next_cursor
    inputs = {name: sha256 for page in pages for name, sha256 in page.inputs_sha256.items()}
    reasons = list(dict.fromkeys(reason for page in pages for reason in page.stale_reasons))
    units = {name: unit for page in pages for name, unit in page.channel_units.items()}
    whole = {"inputs_sha256": inputs, "stale": any(page.stale for page in pages), "stale_reasons": reasons}
    steps = [step for page in pages for step in page.steps]
    return pages[0].model_copy(update={**whole, "channel_units": units, "steps": steps, "next_cursor": None})


def saved(path: str, into: Path, params: Mapping[str, Any]) -> Operation[Path]:
    """Write the answer of a GET into a file."""
    try:
        into.parent.mkdir(parents=True, exist_ok=True)
        yield Ask("GET", path, params=params, into=into)
    except OSError as error:
        raise StorageError(f"{into} cannot be written ({error.strerror}).") from error
    return into
