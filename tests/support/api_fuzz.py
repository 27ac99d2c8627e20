"""Schema fuzzing of the whole API: schemathesis against the service with a running simulated rig.

Used by test_fuzz.py; ``make fuzz`` runs it for longer.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import schemathesis
from schemathesis.config import SchemathesisConfig
from schemathesis.engine import events, from_schema

from stereorig.core.errors import StateError
from stereorig.server.api.app import create_app
from stereorig.server.api.docs.pages import known_problems
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.deletion import restore
from stereorig.server.workflows.service import Service
from tests.support.impatient_client import Impatient
from tests.support.service_rig import TINY, served, true_cameras, wait_for_job, wait_for_rig
from tests.support.tiny_rig import tiny_rig

PHASES = ("examples", "coverage", "fuzzing", "stateful")
# a whole number as no schema writes it
_OTHER_TEXT = re.compile(r"[+-]?\d+\.0*|\+\d+")
# what an earlier request of a run can have made: an id, or the number of one of its steps
_MADE = re.compile(r"[tcjna][0-9]{6}-[0-9a-f]{6}|[1-9][0-9]?")
# moves take no time, frames little; a clock that runs faster yet would lose frames on a busy machine
FAST = {"velocity_mm_s": "velocity_mm_s = 20.0", "time_scale": "time_scale = 10.0"}


@schemathesis.check
def nothing_that_fits_the_schema_is_malformed(ctx: Any, response: Any, case: Any) -> None:
    """What the description allows may be refused for its values, never for its form."""
    if case.meta is None or not case.meta.generation.mode.is_positive or response.status_code != 422:
        return
    problem = json.loads(response.content)
    assert problem["code"] not in ("invalid_request", "malformed_request"), f"fits the schema, refused: {problem}"


@schemathesis.check
def every_error_is_a_problem_of_the_list(ctx: Any, response: Any, case: Any) -> None:
    """Every refusal has a code that the list of problems explains."""
    if response.status_code < 400:
        return
    problem = json.loads(response.content)
    known = known_problems().get(problem["code"])
    assert known is not None, f"not in the list of problems: {problem}"
    assert response.status_code in known["status"], f"{known['status']} in the list: {problem}"
    assert problem["status"] == response.status_code, problem
    assert problem["detail"], problem
    assert problem["remedy"], problem


@dataclass
class Report:
    """What a run did and found."""

    cases: int = 0
    seconds: float = 0.0
    statuses: Counter[int] = field(default_factory=Counter)
    operations: Counter[str] = field(default_factory=Counter)
    answering_s: Counter[str] = field(default_factory=Counter)
    codes: Counter[str] = field(default_factory=Counter)
    phases: Counter[str] = field(default_factory=Counter)
    failures: dict[str, str] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)

    def note(self, event: events.ScenarioFinished, loud: bool) -> None:
        """Add what a scenario did; each failure is kept once a kind and operation."""
        recorder = event.recorder
        for case_id, interaction in recorder.interactions.items():
            label = recorder.cases[case_id].value.operation.label
            answer = interaction.response
            self.cases += 1
            self.phases[event.phase.value] += 1
            self.operations[label] += 1
            if answer is not None:
                self.statuses[answer.status_code] += 1
                self.answering_s[label] += answer.elapsed  # type: ignore[assignment]
                if answer.status_code >= 400:
                    self.codes[json.loads(answer.content or b'{"code": "no body"}')["code"]] += 1
            for check in recorder.checks.get(case_id, []):
                if check.failure_info is None:
                    continue
                failure = check.failure_info.failure
                key = f"{label}: {check.name}: {failure.title}: {None if answer is None else answer.status_code}"
                if key not in self.failures:
                    body = b"" if answer is None else answer.content[:600]
                    self.failures[key] = f"{failure.message}\n{check.failure_info.code_sample}\n{body!r}"
                    if loud:
                        print("FAILURE", key, self.failures[key], sep="\n", flush=True)


@contextlib.contextmanager
def running_service(folder: Path) -> Iterator[Service]:
    """The service on a fast tiny rig."""
    lines = tiny_rig(**FAST).splitlines()
    lines.insert(lines.index("[service]") + 1, "requests_per_s = 100000.0")
    service = Service(parse_config("\n".join(lines)), folder / "data").start()
    try:
        yield service
    finally:
        service.close()


def _within(path: str, folder: str) -> bool:
    return path == folder or path.startswith(f"{folder}/")


def _no_verb(value: Any) -> Any:
    return value.replace(":", ";") if isinstance(value, str) else value


@dataclass
class Known:
    """What there is when a run begins: without it, most requests would end at an unknown id."""

    ids: dict[str, Any]
    made: set[str] = field(default_factory=set)
    deleted: set[str] = field(default_factory=set)

    def note_deleted(self, service: Service, case: Any) -> None:
        """Bring back what all cases need; the rest of what was deleted stays so, see :meth:`check_there`."""
        needed = {self.ids[name] for name in ("test_id", "calibration_id", "noise_id")}
        for entry in service.trash.entries():
            if needed & {entry.test_id, entry.calibration_id, entry.noise_id}:
                restore(service, entry.id)
        # a whole list that was deleted is there still, and empty
        if case.path_parameters and not needed & set(case.path_parameters.values()):
            gone = case.formatted_path
            self.deleted.add(gone)
            self.made = {path for path in self.made if not _within(path, gone)}

    def check_there(self, ctx: Any, response: Any, case: Any) -> None:
        """What was made is there, and what was deleted is not, for every later request of the run.

        In place of schemathesis' own checks, which know nothing of what a run brings back, and take an id of one thing
        for the id of another's part.
        """
        path, method = case.formatted_path, case.operation.method.upper()
        if response.status_code == 404:
            assert path not in self.made or method != "GET", f"made, and not deleted: {path}"
        elif response.status_code < 300 and method in ("PUT", "POST"):
            self.deleted = set() if path.endswith(":restore") else self.deleted - {path}
            answer = json.loads(response.content or b"null") if response.status_code == 201 else None
            made = answer.get("id", answer.get("n")) if isinstance(answer, dict) else None
            if made is not None:
                self.made.add(f"{path.partition(':')[0]}/{made}")
        elif response.status_code < 300 and method == "GET":
            assert not any(_within(path, gone) for gone in self.deleted), f"deleted: {path}"

    def before_call(self, context: Any, case: Any, kwargs: Any) -> None:
        """Put ids that there are into a request's path, where it was not meant to be wrong."""
        wrong = case.meta is not None and case.meta.generation.mode.is_negative
        for values in (case.query, case.headers) if wrong else ():
            # "+0.0" is a number's other text, which a reader of whole numbers takes: no violation of its schema
            for name in [n for n, v in (values or {}).items() if isinstance(v, str) and _OTHER_TEXT.fullmatch(v)]:
                values[name] = "half"
        # nor are 0 and 1 in a form, whose values are texts, another kind than true and false
        if wrong and isinstance(case.body, dict) and case.media_type != "application/json":
            case.body = {name: "half" if value in (0, 1, "0", "1") else value for name, value in case.body.items()}
        # a colon in a path is another operation's address
        case.path_parameters = {name: _no_verb(value) for name, value in (case.path_parameters or {}).items()}
        parts = case.meta.components if case.meta is not None else {}
        path = next((info for kind, info in parts.items() if kind.value == "path_parameters"), None)
        mutations = getattr(case.meta.phase.data, "mutations", ()) if case.meta is not None else ()
        if (path is not None and path.mode.is_negative) or any(m.parameter_location.value == "path" for m in mutations):
            return
        for name, value in list((case.path_parameters or {}).items()):
            known = self.ids.get(name)
            made = _MADE.fullmatch(str(value)) is not None
            meant = len(str(value)) > 40  # wrong on purpose, beside something else that is
            if known is not None and not made and not meant and zlib.crc32(str(value).encode()) % 4:
                case.path_parameters[name] = known


def fill(client: httpx.Client) -> Known:
    """Make one of each thing: a calibration, a test with two steps, an analysis, a noise measurement."""
    wait_for_rig(client)
    api = "/api/v1"
    file = json.dumps(true_cameras(TINY)).encode()
    calibration = client.post(f"{api}/calibrations:import", files={"file": ("calibration.json", file)}).json()
    noise = client.post(f"{api}/noise", json={"frames": 2}).json()
    wait_for_job(client, noise["job"])
    test = client.post(f"{api}/tests", json={"name": "fuzzed", "calibration_id": calibration["id"]}).json()["id"]
    for load in (0.0, 1.0):
        client.put(f"{api}/sim/scene", json={"scene": "plate", "load": load}).raise_for_status()
        client.post(f"{api}/tests/{test}/steps", json={"load_n": load}).raise_for_status()
    body = {"region": {"rectangle": [55, 55, 105, 90]}, "subset_px": 21, "spacing_px": 10}
    analysis = client.post(f"{api}/tests/{test}/analyses", json=body).json()
    job = wait_for_job(client, analysis["job"], 600.0)  # where kernels are compiled first, on a busy machine
    assert job["state"] == "succeeded", job
    ids = {
        "test_id": test,
        "calibration_id": calibration["id"],
        "noise_id": noise["noise_id"],
        "analysis_id": analysis["analysis_id"],
        "job_id": job["id"],
        "n": 1,
        "axis": 1,
        "name": "w_mm",
    }
    return Known(ids)


def fuzz(
    service: Service,
    *,
    cases_each: int,
    seed: int,
    phases: tuple[str, ...] = PHASES,
    loud: bool = False,
    only: str | None = None,
) -> Report:
    """Run phases of schemathesis over every operation, or one."""
    with served(service) as client:
        known = fill(client)
    service.closing = False  # the server of the preparation is gone, the service goes on
    app = Impatient(create_app(service, close_service=False, hosts=frozenset({"testserver"})))
    few = {"include-operation-id": "get_report", "generation": {"max-examples": min(cases_each, 4)}}
    config = SchemathesisConfig.from_dict(
        {
            "seed": seed,
            "workers": 1,
            "request-timeout": 120,
            "suppress-health-check": ["all"],
            "continue-on-failure": True,
            "generation": {"max-examples": cases_each, "mode": "all", "no-shrink": True, "database": "none"},
            # seconds each: drawn anew for every case; beside a choice of one operation it would undo the choice
            "operations": [] if only else [few],
            "phases": {name: {"enabled": name in phases} for name in PHASES},
            "checks": {
                "not_a_server_error": {"expected-statuses": ["2xx", "3xx", "4xx", "503", "507"]},
                # values that do not fit each other or the rig are refused by rules that no schema can say; what the
                # schema does say is held against `invalid_request` by a check of our own, above
                "positive_data_acceptance": {"expected-statuses": ["2xx", "3xx", "4xx", "503", "507"]},
                "use_after_free": {"enabled": False},  # see `Known.check_there`
                "ensure_resource_availability": {"enabled": False},
            },
        }
    )
    schema = schemathesis.openapi.from_asgi("/api/v1/openapi.json", app, config=config)

    @schemathesis.hook
    def before_call(context: Any, case: Any, kwargs: Any) -> None:
        known.before_call(context, case, kwargs)

    @schemathesis.hook
    def after_call(context: Any, case: Any, response: Any) -> None:
        # a burst may take a step a day, a guided acquisition waits for a hand: both keep the cameras from later cases
        if response.status_code == 202 and case.operation.path.endswith(("/steps", ":guide")):
            with contextlib.suppress(StateError):  # it was a short one
                service.jobs.cancel(json.loads(response.content)["job"]["id"])
        # and what all cases need comes back from the trash
        if response.status_code < 300 and case.operation.method.upper() == "DELETE":
            known.note_deleted(service, case)

    @schemathesis.check
    def what_is_made_is_there(ctx: Any, response: Any, case: Any) -> None:
        known.check_there(ctx, response, case)
        assert str(service.folder.root).encode() not in response.content, "an answer names the data folder's place"

    if only:
        schema = schema.include(operation_id=only)
    report = Report()
    began = time.monotonic()
    try:
        for event in from_schema(schema).execute():
            if isinstance(event, events.ScenarioFinished):
                report.note(event, loud)
            elif isinstance(event, events.NonFatalError):
                report.errors.append(f"{event.label}: {event.info.format()}")
            elif isinstance(event, events.FatalError):
                report.errors.append(repr(event.exception))
            elif isinstance(event, events.PhaseFinished) and loud:
                print(f"{event.phase.name.value}: {report.cases} cases, {time.monotonic() - began:.1f} s", flush=True)
    finally:  # hooks are schemathesis' own, and would go on with this service in the next run
        schemathesis.hooks.unregister(before_call)
        schemathesis.hooks.unregister(after_call)
        schemathesis.checks.CHECKS.unregister("what_is_made_is_there")
    report.seconds = time.monotonic() - began
    return report


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Fuzz the whole API on a simulated rig.")
    parser.add_argument("--each", type=int, default=1000, help="generated cases of each operation")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="the same seed gives the same cases")
    parser.add_argument("--only", help="one operation, by its operationId")
    parser.add_argument("--phases", default=",".join(PHASES))
    given = parser.parse_args()
    print(f"seed {given.seed}", flush=True)
    with tempfile.TemporaryDirectory() as folder, running_service(Path(folder)) as service:
        phases = tuple(given.phases.split(","))
        report = fuzz(service, cases_each=given.each, seed=given.seed, phases=phases, loud=True, only=given.only)
    for name, n in sorted(report.operations.items()):
        print(f"{n:6d} {report.answering_s[name]:7.2f} s {name}")
    print(*(f"{n:6d} {name}" for name, n in report.codes.most_common()), sep="\n")
    print(f"{report.cases} cases in {report.seconds:.0f} s; answers {dict(sorted(report.statuses.items()))}")
    print(*sorted(report.failures), *report.errors, sep="\n")
    print(f"{len(report.failures)} failures, {len(report.errors)} errors")
    return int(bool(report.failures or report.errors))


if __name__ == "__main__":
    sys.exit(main())
