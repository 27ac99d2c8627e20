"""Tests of many steps: documents hold the first of them, pages the others, and no answer grows with their number."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import stereorig
from stereorig.server.api.models import AnalysisRequest
from stereorig.server.documents.jobs import JobRecord
from stereorig.server.formats.images import encode_tiff
from stereorig.server.results.warnings import checks as results_checks
from stereorig.server.results.warnings.checks import checks_of, state_of
from stereorig.server.store.indexing.entries import analysis_entry
from stereorig.server.worker.executor import WorkerDiedError
from stereorig.server.workflows.analysis import checks as service_checks
from stereorig.server.workflows.analysis.checks import AnalysisChecks
from stereorig.server.workflows.service import Service
from tests.bench.years.folder import TrueTest
from tests.support.patience import Deadline
from tests.support.service_rig import new_test, served, tiny_config

API = "/api/v1"
FEW, MANY = 130, 1300


def _pair(seed: int) -> dict[str, tuple[str, bytes]]:
    dice = np.random.default_rng(seed)
    images = [dice.integers(0, 255, (144, 160), dtype=np.uint8) for _ in range(2)]
    return {f"cam{k + 1}": (f"{k}.tif", encode_tiff(image)) for k, image in enumerate(images)}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder that ended without a mark: a test of 130 steps, and one of 1,300."""
    folder = tmp_path_factory.mktemp("many") / "data"
    with Service(tiny_config(), folder) as service, served(service) as client:
        test_id = new_test(client, name="two steps")
        for n in range(2):
            client.post(f"{API}/tests/{test_id}/steps:import", files=_pair(n)).raise_for_status()
    true = TrueTest(folder / "tests" / test_id)
    for number, steps in ((2, FEW), (3, MANY)):
        true.copy(number, steps, analysed=False)
    (folder / "catalog.sqlite.clean").unlink(missing_ok=True)
    return folder


@pytest.fixture(scope="module")
def service(data: Path) -> Iterator[Service]:
    with Service(tiny_config(), data) as made:
        yield made


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx.Client]:
    with served(service) as made:
        yield made


@pytest.fixture(scope="module")
def few(data: Path) -> str:
    return next(path.name for path in (data / "tests").glob("t000002-*"))


@pytest.fixture(scope="module")
def many(data: Path) -> str:
    return next(path.name for path in (data / "tests").glob("t000003-*"))


def test_a_test_holds_its_first_steps_and_says_where_the_others_are(client: httpx.Client, many: str) -> None:
    shown = client.get(f"{API}/tests/{many}").json()
    assert shown["n_steps"] == MANY
    assert [one["n"] for one in shown["steps"]] == list(range(100))
    assert shown["newest_step"]["n"] == MANY - 1
    found, cursor = [one["n"] for one in shown["steps"]], shown["steps_next_cursor"]
    while cursor is not None:
        page = client.get(f"{API}/tests/{many}/steps", params={"cursor": cursor, "limit": 500}).json()
        found += [one["n"] for one in page["steps"]]
        cursor = page["next_cursor"]
    assert found == list(range(MANY))


def test_a_test_of_few_steps_holds_them_all(client: httpx.Client, service: Service) -> None:
    first = service.tests.ids()[0]
    shown = client.get(f"{API}/tests/{first}").json()
    assert ([one["n"] for one in shown["steps"]], shown["n_steps"], shown["steps_next_cursor"]) == ([0, 1], 2, None)


def test_the_client_follows_the_pages(client: httpx.Client, many: str) -> None:
    with stereorig.Client(str(client.base_url), progress=False) as rig:
        assert [one.n for one in rig.test(many).steps()] == list(range(MANY))


def _analysis(service: Service, test_id: str, steps: int) -> str:
    """An analysis whose results are there; what is in them is not asked for."""
    body = AnalysisRequest.model_validate({"region": {"rectangle": [30, 30, 120, 110]}})
    sha256 = service.tests.steps.read(test_id, 0).document.sha256
    document: dict[str, Any] = {
        "kind": "displacement",
        "settings": body.stored().model_dump(mode="json"),
        "steps": list(range(steps)),
        "inputs": {"calibration_sha256": None, "steps": {str(n): sha256 for n in range(steps)}},
    }
    made = service.tests.analyses.create(test_id, document)
    folder = service.tests.analyses.path(test_id, made.id)
    for n in range(steps - 1):  # the last one failed
        (folder / f"step_{n:04d}.nc").write_bytes(b"")
        valid = 30 if n == steps - 2 else 100
        figures = {"n": n, "points": 100, "valid": valid, "valid_fraction": valid / 100}
        (folder / f"step_{n:04d}.json").write_text(json.dumps(figures))
    problem = {"code": "image_blank", "detail": "It is blank.", "remedy": "Capture it again."}
    summary = {"state": "succeeded", "steps": [{"n": n} for n in range(steps - 1)], "steps_failed": {}}
    service.tests.analyses.put_summary(test_id, made.id, summary | {"steps_failed": {str(steps - 1): problem}})
    service.catalog.put_entry("analysis", test_id, made.id, analysis_entry(made))
    return made.id


@pytest.fixture(scope="module")
def analyses(service: Service, few: str, many: str) -> dict[str, str]:
    return {few: _analysis(service, few, FEW), many: _analysis(service, many, MANY)}


def test_an_analysis_holds_its_first_steps_and_lists_them_all_page_by_page(
    client: httpx.Client, many: str, analyses: dict[str, str]
) -> None:
    url = f"{API}/tests/{many}/analyses/{analyses[many]}"
    shown = client.get(url).json()
    assert (shown["n_steps"], shown["n_finished"], shown["n_failed"]) == (MANY, MANY - 1, 1)
    assert shown["steps"] == shown["steps_finished"] == list(range(100))
    assert [one["n"] for one in shown["summary"]["steps"]] == list(range(50))
    assert list(shown["steps_failed"]) == [str(MANY - 1)]
    found, cursor = [], None
    while True:
        page = client.get(f"{url}/steps", params={"limit": 400, "cursor": cursor} if cursor else {"limit": 400}).json()
        found += page["steps"]
        if (cursor := page["next_cursor"]) is None:
            break
    assert [one["n"] for one in found] == list(range(MANY))
    assert [one["state"] for one in found] == ["finished"] * (MANY - 1) + ["failed"]
    assert found[7]["figures"]["points"] == 100
    assert found[-1]["problem"]["code"] == "image_blank"
    (one,) = client.get(f"{url}/steps", params={"first": 777, "limit": 1, "figures": False}).json()["steps"]
    assert (one["n"], one["figures"]) == (777, None)


def test_the_checks_of_an_analysis_of_many_steps_are_made_and_renewed(
    client: httpx.Client, service: Service, many: str, analyses: dict[str, str]
) -> None:
    url = f"{API}/tests/{many}/analyses/{analyses[many]}"

    def codes() -> set[str]:
        return {one["code"] for one in client.get(url).json()["warnings"]}

    deadline = Deadline(60.0)
    while codes() == {"not_checked_yet"} and deadline.left:
        time.sleep(0.1)
    assert {"low_coverage", "steps_failed"} <= codes() <= {"low_coverage", "steps_failed", "image_quality"}
    trash = client.delete(f"{API}/tests/{many}/steps/{MANY - 3}").raise_for_status().json()["id"]
    while "out_of_date" not in codes() and deadline.left:
        time.sleep(0.1)
    assert client.get(url).json()["stale_reasons"] == [f"step {MANY - 3} is gone"]
    client.post(f"{API}/trash/{trash}:restore").raise_for_status()


def test_only_the_first_request_waits_for_the_checks(
    service: Service, many: str, analyses: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[float | None] = []

    class Unfinished(Future[None]):
        def result(self, timeout: float | None = None) -> None:
            waited.append(timeout)
            raise TimeoutError

    checks = AnalysisChecks(service.tests)
    monkeypatch.setattr(checks._beside, "submit", lambda *_: Unfinished())
    for _ in range(3):
        assert [one.code for one in checks.of(many, analyses[many]).warnings] == ["not_checked_yet"]
    checks.close()
    assert len(waited) == 1


@pytest.mark.parametrize("dies", [False, True])
def test_the_checks_of_many_steps_are_found_by_a_process_of_their_own(
    service: Service, many: str, analyses: dict[str, str], monkeypatch: pytest.MonkeyPatch, dies: bool
) -> None:
    checks = AnalysisChecks(service.tests)
    asked: list[Future[Any]] = []
    submit = checks._process.submit

    def submitted(task: Callable[..., Any], *args: Any) -> Future[Any]:
        asked.append(Future[Any]() if dies else submit(task, *args))
        if dies:
            asked[0].set_exception(WorkerDiedError("It ended.", exit_code=-9, signal=9))
        return asked[0]

    monkeypatch.setattr(checks._process, "submit", submitted)
    deadline = Deadline(60.0)
    while (found := checks.of(many, analyses[many])).warnings[0].code == "not_checked_yet":
        assert deadline.left
        time.sleep(0.05)
    assert len(asked) == 1
    assert found == checks_of(service.tests.analyses.path(many, analyses[many]))
    checks.close()


def test_a_request_while_the_service_closes_gets_the_last_known_checks(
    service: Service, many: str, analyses: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = AnalysisChecks(service.tests)
    closed.close()
    assert [one.code for one in closed.of(many, analyses[many]).warnings] == ["not_checked_yet"]
    waiting: Future[Any] = Future()
    waiting.cancel()
    waiting.set_running_or_notify_cancel()
    checks = AnalysisChecks(service.tests)
    monkeypatch.setattr(checks._beside, "submit", lambda *_: waiting)  # closed while somebody waits
    assert [one.code for one in checks.of(many, analyses[many]).warnings] == ["not_checked_yet"]
    checks.close()


def test_checks_of_some_age_are_confirmed_without_reading_the_steps(
    service: Service, few: str, analyses: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    checks = AnalysisChecks(service.tests)
    deadline = Deadline(60.0)
    while (found := checks.of(few, analyses[few])).warnings[0].code == "not_checked_yet":
        assert deadline.left
        time.sleep(0.05)
    looked: list[Path] = []

    def noted(folder: Path) -> bytes:
        looked.append(folder)
        return state_of(folder)

    monkeypatch.setattr(results_checks, "state_of", noted)
    monkeypatch.setattr(results_checks, "checks_of", lambda *_: pytest.fail("read again"))
    monkeypatch.setattr(service_checks, "_FRESH_S", 0.0)
    monkeypatch.setattr(service_checks, "_SHARE", 1e9)
    while len(looked) < 2:
        assert checks.of(few, analyses[few]) == found
        assert deadline.left
        time.sleep(0.01)
    checks.close()


@pytest.mark.parametrize("path", ["", "/analyses/{}", "/analyses", "/steps?limit=50", "/analyses/{}/steps?limit=50"])
def test_no_answer_grows_with_the_steps(
    client: httpx.Client, few: str, many: str, analyses: dict[str, str], path: str
) -> None:
    sizes = []
    for test_id in (few, many):
        answer = client.get(f"{API}/tests/{test_id}{path.format(analyses[test_id])}").raise_for_status()
        sizes.append(len(answer.content))
    assert sizes[1] < 1.1 * sizes[0] + 500, "ten times the steps"


def test_the_jobs_of_many_steps_are_cut_and_paged(client: httpx.Client, service: Service, many: str) -> None:
    steps = [{"index": k, "n": k, "quality": "ok"} for k in range(1000)]
    made = JobRecord.model_validate(
        {
            "id": service.folder.ids.new("j"),
            "kind": "burst",
            "state": "succeeded",
            "subject": {"test_id": many},
            "progress": {"phase": "done", "done": 1000, "total": 1000},
            "created_utc": "2026-01-01T00:00:00Z",
            "result": {"test_id": many, "count": 1000, "steps": steps, "failures": []},
        }
    )
    service.catalog.put_job(made)
    shown = client.get(f"{API}/jobs/{made.id}").json()["result"]
    assert (len(shown["steps"]), shown["n_steps"], shown["count"]) == (100, 1000, 1000)
    listed = next(one for one in client.get(f"{API}/jobs").json()["jobs"] if one["id"] == made.id)
    assert (len(listed["result"]["steps"]), listed["result"]["n_steps"]) == (1, 1000)
    found = client.get(f"{API}/jobs/{made.id}/steps").json()["steps"]
    assert [one["n"] for one in found] == list(range(1000))


@pytest.mark.fault(49)
def test_a_request_that_is_repeated_right_after_a_kill_has_one_effect_though_its_test_is_not_read_yet(
    data: Path, service: Service, tmp_path: Path
) -> None:
    """The catalogue never had the keys of these steps; the folder has, and is asked before anything is captured."""
    copy = tmp_path / "data"
    true = TrueTest(data / "tests" / service.tests.ids()[0])
    (copy / "tests").mkdir(parents=True)
    for number in range(6):
        path = true.copy(900 + number, 40, analysed=False)
        path.rename(copy / "tests" / path.name)
    with contextlib.ExitStack() as stack:
        fresh = Service(tiny_config(), copy)
        fresh.index._thread.run = lambda: None  # type: ignore[method-assign]  # nothing is read but what is asked for
        stack.enter_context(fresh)
        asked = stack.enter_context(served(fresh))
        oldest = fresh.tests.ids()[0]
        assert asked.get("/healthz").json()["tests_to_read"] == 6
        key = {"Idempotency-Key": f"{oldest}-7"}
        answer = asked.post(f"{API}/tests/{oldest}/steps", json={}, headers=key)
        assert answer.status_code == 409, "the body differs from that of the first, whose key is known"
        assert answer.json()["code"] == "idempotency_key_reused"
        assert asked.get(f"{API}/tests/{oldest}").json()["n_steps"] == 40
        assert asked.get("/healthz").json()["tests_to_read"] == 5
        assert len(asked.get(f"{API}/tests").json()["tests"]) == 6
