"""The service beside a small model of what it must hold: any order of requests, repeats, kills and starts."""

from __future__ import annotations

import functools
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from stereorig.server.config.rig_file import parse_config
from stereorig.server.jobs.idempotency import OneEffect
from stereorig.server.store.verify import verify
from tests.bench.reliability.torture_lab import RIG, Pictures
from tests.support.service_model import Lab, Modelled, Request, Trashed, copy_folder
from tests.support.service_rig import true_cameras

#: requests and kills; the deep form, and how many of them are one case
OPERATIONS = int(os.environ.get("STEREORIG_MODEL_OPERATIONS", "800"))
STEPS = 80
CONFIG = parse_config(RIG)
CALIBRATION = true_cameras(RIG)
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # thousands of starts on a disk take hours
FINAL = {"succeeded", "failed", "cancelled", "interrupted"}
numbers = st.integers(0, 10**6)
labels = st.sampled_from(["", "load", "peak", "10 kN"])


@functools.cache
def pictures() -> Pictures:
    """Two pairs of the plate that is before the cameras too, so that analyses succeed."""
    return Pictures(2)


def pair(kind: int) -> dict[str, Any]:
    return {cam: (f"{cam}.tif", content) for cam, content in pictures().pairs[kind % 2].items()}


class ServiceBesideModel(RuleBasedStateMachine):
    """Rules are requests; what is drawn as a number picks one of the things that are there."""

    operations = 0

    @initialize(stocked=st.booleans())
    def open(self, stocked: bool) -> None:
        self.lab = Lab(Path(tempfile.mkdtemp(prefix="model-", dir=MEMORY)), CONFIG)
        self.tests: dict[str, Modelled] = {}
        self.calibrations: set[str] = set()
        self.recipes: dict[str, str] = {}
        self.trash: dict[str, Trashed] = {}
        self.requests: dict[str, Request] = {}
        self.jobs: set[str] = set()
        self.kill_at: int | None = None
        self.keys = 0
        if stocked:  # with what an analysis needs, which seldom comes together by chance
            self.import_calibration()
            self.new_test("stocked")
            for kind in range(2):
                self.import_step(0, kind, "")

    def teardown(self) -> None:
        if hasattr(self, "lab"):
            try:
                self.everything_is_as_modelled()
            finally:
                self.lab.close()

    # sending ---------------------------------------------------------------------------------------------------

    def send(self, method: str, url: str, **body: Any) -> httpx.Response | None:
        """Send a request; None if the service was killed before it answered, and started again since."""
        type(self).operations += 1
        if self.kill_at is None:
            return self.ended(self.lab.client.request(method, url, **body))
        aside = self.lab.new_folder()
        self.lab.disk.arm(self.kill_at, aside)
        self.kill_at = None
        answer = self.ended(self.lab.client.request(method, url, **body))
        if not self.lab.disk.disarm():
            return answer
        self.lab.restart(aside)
        return None

    def ended(self, answer: httpx.Response) -> httpx.Response:
        """Wait for the job that an answer names; what follows finds nothing in use."""
        job = answer.json().get("job") if answer.status_code == 202 else None
        if job is not None:
            ended = self.lab.client.get(f"/jobs/{job['id']}?wait=60")
            assert ended.json()["state"] in FINAL, ended.text
        return answer

    def make(self, url: str, **body: Any) -> dict[str, Any]:
        """Make something under a key; killed before the answer, it is asked for again and made once."""
        self.keys += 1
        key = f"key-{self.keys:06d}"
        request = self.requests[key] = Request(url, body)
        answer = self.send("POST", url, headers={"Idempotency-Key": key}, **body)
        if answer is None:
            answer = self.ended(self.lab.client.request("POST", url, headers={"Idempotency-Key": key}, **body))
        assert answer.status_code in (200, 201, 202), answer.text
        request.made = answer.json()
        return request.made

    def change(self, method: str, url: str, **body: Any) -> httpx.Response:
        """Change something; killed before the answer, the same change is made again."""
        headers = {"If-Match": "*"}
        answer = self.send(method, url, headers=headers, **body)
        return answer if answer is not None else self.lab.client.request(method, url, headers=headers, **body)

    def one(self, things: Any, pick: int) -> Any:
        return sorted(things)[pick % len(things)]

    # making ----------------------------------------------------------------------------------------------------

    @rule(name=labels)
    def new_test(self, name: str) -> None:
        made = self.make("/tests", json={"name": name or "unnamed"})
        self.tests[made["id"]] = Modelled(name or "unnamed")

    @precondition(lambda self: self.tests)
    @rule(pick=numbers, kind=numbers, label=labels)
    def import_step(self, pick: int, kind: int, label: str) -> None:
        test_id = self.one(self.tests, pick)
        self.add(test_id, self.make(f"/tests/{test_id}/steps:import", files=pair(kind), data={"label": label}), label)

    @precondition(lambda self: self.tests)
    @rule(pick=numbers, label=labels)
    def capture_step(self, pick: int, label: str) -> None:
        test_id = self.one(self.tests, pick)
        self.add(test_id, self.make(f"/tests/{test_id}/steps", json={"label": label}), label)

    def add(self, test_id: str, made: dict[str, Any], label: str) -> None:
        test, n = self.tests[test_id], made["n"]
        assert n not in test.given, f"step {n} was given twice"
        # a number may be left out where a kill left half a step, never the first
        assert n > max(test.given, default=-1)
        assert test.given or n == 0
        test.given.add(n)
        test.steps[n] = label

    @rule()
    def import_calibration(self) -> None:
        file = {"file": ("c.json", json.dumps(CALIBRATION))}
        self.calibrations.add(self.make("/calibrations:import", files=file)["id"])

    @precondition(lambda self: any(len(t.steps) > 1 for t in self.tests.values()) and self.calibrations)
    @rule(pick=numbers)
    def analyse(self, pick: int) -> None:
        test_id = self.one([i for i, t in self.tests.items() if len(t.steps) > 1], pick)
        calibration_id = self.one(self.calibrations, pick)
        body = {
            "region": {"rectangle": [25, 25, 130, 115]},
            "subset_px": 21,
            "spacing_px": 40,
            "calibration_id": calibration_id,
        }
        if 0 not in self.tests[test_id].steps:
            return
        made = self.make(f"/tests/{test_id}/analyses", json=body)
        self.tests[test_id].analyses.add(made["analysis_id"])
        self.jobs.add(made["job"]["id"])

    # changing --------------------------------------------------------------------------------------------------

    @precondition(lambda self: self.tests)
    @rule(pick=numbers, name=labels)
    def rename(self, pick: int, name: str) -> None:
        test_id = self.one(self.tests, pick)
        assert self.change("PATCH", f"/tests/{test_id}", json={"name": name or "unnamed"}).status_code == 200
        self.tests[test_id].name = name or "unnamed"

    @precondition(lambda self: any(t.steps for t in self.tests.values()))
    @rule(pick=numbers, label=labels)
    def relabel(self, pick: int, label: str) -> None:
        test_id = self.one([i for i, t in self.tests.items() if t.steps], pick)
        n = self.one(self.tests[test_id].steps, pick)
        assert self.change("PATCH", f"/tests/{test_id}/steps/{n}", json={"label": label}).status_code == 200
        self.tests[test_id].steps[n] = label

    @rule(name=labels)
    def new_recipe(self, name: str) -> None:
        body = {"name": name or "plain", "recipe": {"version": 1}}
        taken = body["name"] in self.recipes.values()
        answer = self.send("POST", "/recipes", json=body)
        if answer is None:  # there is no key: whether it was made can be seen by its name
            found = {r["name"]: r["id"] for r in self.lab.client.get("/recipes").json()["recipes"]}
            if not taken and body["name"] in found:
                self.recipes[found[body["name"]]] = str(body["name"])
        elif taken:
            assert answer.status_code in (409, 422), answer.text
        else:
            assert answer.status_code == 201, answer.text
            self.recipes[answer.json()["id"]] = str(body["name"])

    @precondition(lambda self: self.recipes)
    @rule(pick=numbers)
    def remove_recipe(self, pick: int) -> None:
        recipe_id = self.one(self.recipes, pick)
        answer = self.change("DELETE", f"/recipes/{recipe_id}")
        assert answer.status_code in (200, 204, 404), answer.text
        del self.recipes[recipe_id]

    # deleting and restoring ------------------------------------------------------------------------------------

    def delete(self, kind: str, url: str, ids: dict[str, Any], content: Any) -> None:
        answer = self.send("DELETE", url)
        if answer is None:
            found = [e["id"] for e in self.lab.client.get("/trash").json()["trash"] if e["id"] not in self.trash]
            if found:
                assert len(found) == 1
                assert self.lab.client.get(url).status_code == 404, "it is in its place and in the trash"
                self.trash[found[0]] = Trashed(kind, ids, content)
                return
            answer = self.lab.client.request("DELETE", url)
        assert answer.status_code == 200, answer.text
        self.trash[answer.json()["id"]] = Trashed(kind, ids, content)

    @precondition(lambda self: self.tests)
    @rule(pick=numbers)
    def delete_test(self, pick: int) -> None:
        test_id = self.one(self.tests, pick)
        self.delete("test", f"/tests/{test_id}", {"test_id": test_id}, self.tests[test_id])
        del self.tests[test_id]

    @precondition(lambda self: any(t.steps for t in self.tests.values()))
    @rule(pick=numbers)
    def delete_step(self, pick: int) -> None:
        test_id = self.one([i for i, t in self.tests.items() if t.steps], pick)
        n = self.one(self.tests[test_id].steps, pick)
        ids = {"test_id": test_id, "n": n}
        self.delete("step", f"/tests/{test_id}/steps/{n}", ids, self.tests[test_id].steps[n])
        del self.tests[test_id].steps[n]

    @precondition(lambda self: any(t.analyses for t in self.tests.values()))
    @rule(pick=numbers)
    def delete_analysis(self, pick: int) -> None:
        test_id = self.one([i for i, t in self.tests.items() if t.analyses], pick)
        analysis_id = self.one(self.tests[test_id].analyses, pick)
        ids = {"test_id": test_id, "analysis_id": analysis_id}
        self.delete("analysis", f"/tests/{test_id}/analyses/{analysis_id}", ids, None)
        self.tests[test_id].analyses.discard(analysis_id)

    @precondition(lambda self: self.calibrations)
    @rule(pick=numbers)
    def delete_calibration(self, pick: int) -> None:
        calibration_id = self.one(self.calibrations, pick)
        self.delete("calibration", f"/calibrations/{calibration_id}", {"calibration_id": calibration_id}, None)
        self.calibrations.discard(calibration_id)

    @precondition(lambda self: self.trash)
    @rule(pick=numbers)
    def restore(self, pick: int) -> None:
        trash_id = self.one(self.trash, pick)
        entry = self.trash[trash_id]
        parent = entry.ids.get("test_id") if entry.kind != "test" else None
        answer = self.send("POST", f"/trash/{trash_id}:restore")
        if parent is not None and parent not in self.tests:
            assert answer is None or (answer.status_code, answer.json()["code"]) == (409, "parent_deleted"), answer.text
            return
        if answer is None:
            left = {e["id"] for e in self.lab.client.get("/trash").json()["trash"]}
            if trash_id in left:
                answer = self.lab.client.request("POST", f"/trash/{trash_id}:restore")
        assert answer is None or answer.status_code == 200, answer.text
        del self.trash[trash_id]
        match entry.kind:
            case "test":
                self.tests[entry.ids["test_id"]] = entry.content
            case "step":
                self.tests[entry.ids["test_id"]].steps[entry.ids["n"]] = entry.content
            case "analysis":
                self.tests[entry.ids["test_id"]].analyses.add(entry.ids["analysis_id"])
            case "calibration":
                self.calibrations.add(entry.ids["calibration_id"])

    @precondition(lambda self: self.trash)
    @rule(pick=numbers)
    def empty(self, pick: int) -> None:
        trash_id = self.one(self.trash, pick)
        answer = self.change("DELETE", f"/trash/{trash_id}")
        assert answer.status_code in (200, 204, 404), answer.text
        del self.trash[trash_id]

    # again, and again after a kill -----------------------------------------------------------------------------

    @precondition(lambda self: self.requests)
    @rule(pick=numbers)
    def send_again(self, pick: int) -> None:
        key = self.one(self.requests, pick)
        request = self.requests[key]
        assert request.made is not None
        answer = self.lab.client.request("POST", request.url, headers={"Idempotency-Key": key}, **request.body)
        type(self).operations += 1
        if answer.status_code == 404:  # what it made, or its test, was deleted
            return
        assert answer.status_code in (200, 201, 202), answer.text
        for name in ("id", "n", "analysis_id"):
            assert answer.json().get(name) == request.made.get(name)

    @precondition(lambda self: self.tests)
    @rule(pick=numbers)
    def another_body_under_a_used_key(self, pick: int) -> None:
        key = self.one([k for k, r in self.requests.items()], pick)
        if not self.requests[key].url.startswith("/tests"):
            return
        answer = self.lab.client.request(
            "POST", "/tests", headers={"Idempotency-Key": key}, json={"name": "quite another"}
        )
        type(self).operations += 1
        if answer.status_code == 201:  # the key was of another kind of thing
            self.requests.pop(key)
            self.tests[answer.json()["id"]] = Modelled("quite another")
        else:
            assert (answer.status_code, answer.json()["code"]) == (409, "idempotency_key_reused")

    @rule(n=st.integers(1, 14))
    def kill_in_the_next_request(self, n: int) -> None:
        self.kill_at = n

    @rule()
    def kill(self) -> None:
        aside = self.lab.new_folder()
        copy_folder(self.lab.data, aside)
        self.lab.restart(aside)
        type(self).operations += 1

    @rule()
    def restart(self) -> None:
        self.lab.restart()
        type(self).operations += 1

    # comparing -------------------------------------------------------------------------------------------------

    @rule(n=st.integers(0, 2))
    def compare_now_and_then(self, n: int) -> None:
        if n == 0:  # to look at everything takes as long as ten operations
            self.everything_is_as_modelled()

    def everything_is_as_modelled(self) -> None:
        get = self.lab.client.get
        assert {t["id"]: t["name"] for t in get("/tests").json()["tests"]} == {i: t.name for i, t in self.tests.items()}
        for test_id, test in self.tests.items():
            steps = get(f"/tests/{test_id}/steps").json()["steps"]
            assert {s["n"]: s["label"] for s in steps} == test.steps, test_id
            found = {a["id"] for a in get(f"/tests/{test_id}/analyses").json()["analyses"]}
            assert found == test.analyses, test_id
        assert {c["id"] for c in get("/calibrations").json()["calibrations"]} == self.calibrations
        assert {r["id"]: r["name"] for r in get("/recipes").json()["recipes"]} == self.recipes
        assert {e["id"]: e["kind"] for e in get("/trash").json()["trash"]} == {i: e.kind for i, e in self.trash.items()}
        for job_id in self.jobs:
            assert get(f"/jobs/{job_id}").json()["state"] in FINAL
        assert [f for f in verify(self.lab.data).findings if f.level in ("damaged", "foreign")] == []

    @invariant()
    def it_lives(self) -> None:
        if hasattr(self, "lab"):
            assert self.lab.service.is_alive()


def search(operations: int, phases: tuple[Phase, ...] = (Phase.generate, Phase.shrink)) -> int:
    """Run cases until so many requests, kills and starts were made; return their number."""
    ServiceBesideModel.operations = 0
    while ServiceBesideModel.operations < operations:
        _search(phases)
    return ServiceBesideModel.operations


def _search(phases: tuple[Phase, ...]) -> None:
    run_state_machine_as_test(
        ServiceBesideModel,
        settings=settings(
            max_examples=5,
            stateful_step_count=STEPS,
            deadline=None,
            database=None,
            suppress_health_check=list(HealthCheck),
            phases=phases,
            print_blob=True,
        ),
    )


@pytest.mark.deep
def test_a_service_that_forgets_its_keys_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(OneEffect, "once", lambda _self, _mark, make: (make(), False))
    with pytest.raises((AssertionError, ExceptionGroup)):
        search(1000, (Phase.generate,))


@pytest.mark.timeout(7200)
@pytest.mark.parametrize("operations", [100, pytest.param(OPERATIONS, marks=pytest.mark.deep)])
def test_the_service_holds_what_the_model_holds(operations: int) -> None:
    print(f"{search(operations)} requests, kills and starts")
