"""What a killed service is asked for before it is killed, and what it must have afterwards.

A lab has one data folder. It keeps a book of everything that was acknowledged over HTTP, and of every request that had no
answer yet when the service was killed: only those may be half there.
"""

from __future__ import annotations

import hashlib
import json
import random
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.images import encode_tiff
from stereorig.server.store.verify import verify
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld
from tests.support.tiny_rig import tiny_rig

FINAL = ("succeeded", "failed", "cancelled", "interrupted")
REGION = {"rectangle": [25, 25, 130, 115]}
MADE = "2026-01-01T00:00:00Z"
_ANSWER_S = 30.0

RIG = tiny_rig(
    positions_mm="positions_mm = [0.0, 1.0]",
    held_out_mm="held_out_mm = [0.5]",
    frames="frames = 1",
    compute_queue="compute_queue = 4",
    speckle_mm="speckle_mm = 0.4",
    time_scale="time_scale = 10.0",
)


class Pictures:
    """Pairs of images of a loaded plate, and the cameras' truth to measure them with; rendered once."""

    def __init__(self, pairs: int = 12) -> None:
        rig = SimRig.from_dict(parse_config(RIG).model_dump(exclude_none=True))
        world = SimWorld(rig, lambda _: 0.0)
        rng = np.random.default_rng(5)
        pair = world.true_pair()
        self.calibration = {"cam1": pair.cam1.paper_parameters(), "cam2": pair.cam2.paper_parameters()}
        world.set_scene("plate", load=0.0)
        self.pairs = [
            {cam: encode_tiff(world.expose(cam, exposure_ms=10.0, gain_db=0.0, rng=rng)) for cam in ("cam1", "cam2")}  # type: ignore[arg-type]
            for _ in range(pairs)
        ]

    def write_test(self, folder: Path) -> None:
        """Write a test as another service would have left it: a copied folder is a valid test."""
        (folder / "analyses").mkdir(parents=True)
        (folder / "calibration.json").write_text(json.dumps(self.calibration))
        for n, images in enumerate(self.pairs):
            step = folder / "steps" / f"{n:04d}"
            step.mkdir(parents=True)
            for cam, content in images.items():
                (step / f"{cam}.tif").write_bytes(content)
            metadata = {"label": "", "load_n": None, "source": "import", "captured_utc": MADE, "skew_ms": None}
            sha256 = {cam: hashlib.sha256(content).hexdigest() for cam, content in images.items()}
            document = {"n": n, "test_id": folder.name, **metadata, "quality": {}, "sha256": sha256}
            (step / "step.json").write_text(json.dumps(document))
        document = {"id": folder.name, "name": "copied", "specimen": "", "notes": "", "calibration_id": None}
        (folder / "test.json").write_text(json.dumps({**document, "created_utc": MADE}))


def _share(job: dict[str, Any]) -> float:
    """How far a job is: the taking of views or frames is the first half of those that take some."""
    if job["state"] in FINAL:
        return 1.0
    shown = job["progress"]
    share = shown["done"] / shown["total"] if shown["total"] else 0.0
    if job["kind"] == "analysis":
        return float(share)
    return 0.5 * share if shown["phase"] in ("views", "frames", "waiting") else 0.5 + 0.5 * share


def steps_of(client: httpx.Client, test_id: str) -> set[int]:
    """Numbers of a test's steps, page by page: its own document holds the first hundred."""
    found: set[int] = set()
    cursor = ""
    while True:
        page = client.get(f"/tests/{test_id}/steps", params={"cursor": cursor} if cursor else {}).json()
        found |= {step["n"] for step in page["steps"]}
        cursor = page.get("next_cursor") or ""
        if not cursor:
            return found


@dataclass
class Asked:
    """A request without an answer."""

    url: str
    key: str
    test_id: str
    files: dict[str, Any] | None = None


@dataclass
class Lab:
    """One data folder, and the book of what was acknowledged.

    Parameters
    ----------
    data
        The folder.
    pictures
        To import and to analyse.
    seed
        Of everything that is random.
    """

    data: Path
    pictures: Pictures
    seed: int
    wrong: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    steps: dict[tuple[str, int], dict[str, Any]] = field(default_factory=dict)
    fresh: set[tuple[str, int]] = field(default_factory=set)
    jobs: dict[str, str] = field(default_factory=dict)
    results: dict[tuple[str, int], str] = field(default_factory=dict)
    deleted: dict[str, set[str]] = field(default_factory=dict)
    asked: dict[str, Asked] = field(default_factory=dict)
    incomplete: dict[str, set[int]] = field(default_factory=dict)
    test_id: str = ""
    copied: str = "t000007-abcdef"
    progress: float = 0.0  # of the job that runs; 1 once one has ended
    killed: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self.pictures.write_test(self.data / "tests" / self.copied)

    def complain(self, text: str) -> None:
        """Note something that must not be."""
        self.wrong.append(text)

    # what goes on until the kill -------------------------------------------------------------------------------

    def begin(self, kind: str, url: str) -> list[threading.Thread]:
        """Start what is to be killed: ``record``, ``calibrate``, ``noise``, ``analyse`` or ``delete``."""
        self.over.clear()
        self.killed.clear()
        self.progress = 0.0
        acts: dict[str, list[Callable[[httpx.Client], None]]] = {
            "record": [self._capture, self._import],
            "calibrate": [self._calibrate, self._import],
            "noise": [self._noise, self._import],
            "analyse": [self._analyse, self._capture],
            "delete": [self._delete, self._capture],
        }
        threads = [threading.Thread(target=self._until_over, args=(act, url)) for act in acts[kind]]
        for thread in threads:
            thread.start()
        return threads

    def _until_over(self, act: Callable[[httpx.Client], None], url: str) -> None:
        with httpx.Client(base_url=f"{url}/api/v1", timeout=_ANSWER_S, trust_env=False, verify=False) as client:
            try:
                act(client)
            except httpx.TransportError as error:
                if not self.killed.is_set():
                    self.complain(f"the service stopped answering by itself: {error!r}")

    def _make(self, client: httpx.Client, asked: Asked) -> httpx.Response:
        self.asked[asked.key] = asked
        headers = {"Idempotency-Key": asked.key}
        more: dict[str, Any] = {"json": {}} if asked.files is None else {"files": asked.files}
        answer = client.post(asked.url, headers=headers, **more)
        if answer.status_code == 201:
            step = answer.json()
            self.steps[step["test_id"], step["n"]] = step
            self.fresh.add((step["test_id"], step["n"]))
            self.counts["steps"] += 1
        elif answer.status_code != 409:
            self.complain(f"{asked.url} answered {answer.status_code}: {answer.text[:300]}")
        del self.asked[asked.key]
        return answer

    def capture_request(self) -> Asked:
        """A step to capture."""
        return Asked(f"/tests/{self.test_id}/steps", uuid.uuid4().hex, self.test_id)

    def import_request(self) -> Asked:
        """A step to import."""
        pair = self.random.choice(self.pictures.pairs)
        files = {cam: (f"{cam}.tif", content) for cam, content in pair.items()}
        return Asked(f"/tests/{self.test_id}/steps:import", uuid.uuid4().hex, self.test_id, files)

    def _capture(self, client: httpx.Client) -> None:
        while not self.over.is_set():
            if self._make(client, self.capture_request()).status_code == 409:
                time.sleep(0.02)

    def _import(self, client: httpx.Client) -> None:
        while not self.over.is_set():
            self._make(client, self.import_request())

    def _job(self, client: httpx.Client, url: str, body: dict[str, Any]) -> dict[str, Any] | None:
        answer = client.post(url, json=body)
        if answer.status_code == 202:
            self.jobs[answer.json()["job"]["id"]] = "queued"
            self.counts["jobs"] += 1
            return dict(answer.json())
        if answer.status_code != 409:
            self.complain(f"{url} answered {answer.status_code}: {answer.text[:300]}")
        return None

    def _follow(self, client: httpx.Client, job_id: str, meanwhile: Callable[[], None] = lambda: None) -> None:
        while not self.over.is_set():
            meanwhile()
            job = client.get(f"/jobs/{job_id}").json()
            state = self.jobs[job_id] = job["state"]
            self.progress = max(self.progress, _share(job))
            if state in FINAL:
                meanwhile()
                self.counts[f"{state} jobs"] += 1
                return
            time.sleep(0.01)

    def _calibrate(self, client: httpx.Client) -> None:
        while not self.over.is_set():
            made = self._job(client, "/calibrations", {})
            if made is not None:
                self._follow(client, made["job"]["id"])

    def _noise(self, client: httpx.Client) -> None:
        while not self.over.is_set():
            made = self._job(client, "/noise", {"frames": 4})
            if made is not None:
                self._follow(client, made["job"]["id"])

    def _analyse(self, client: httpx.Client) -> None:
        body = {
            "region": REGION,
            "steps": [1, 2, 3, 4, 5],
            "subset_px": 21,
            "spacing_px": 12,
            "patch": "affine",
            "strain": None,
        }
        while not self.over.is_set():
            made = self._job(client, f"/tests/{self.copied}/analyses", body)
            if made is None:
                continue
            analysis_id = made["analysis_id"]

            def meanwhile(analysis_id: str = analysis_id) -> None:
                shown = client.get(f"/tests/{self.copied}/analyses/{analysis_id}").json()
                for n in shown["steps_finished"]:
                    if (analysis_id, n) not in self.results:
                        path = self.data / "tests" / self.copied / "analyses" / analysis_id / f"step_{n:04d}.nc"
                        self.results[analysis_id, n] = hashlib.sha256(path.read_bytes()).hexdigest()
                        self.counts["results"] += 1

            self._follow(client, made["job"]["id"], meanwhile)

    def _delete(self, client: httpx.Client) -> None:
        while not self.over.is_set():
            answer = client.post("/tests", json={"name": "short-lived"})
            if answer.status_code != 201:
                self.complain(f"a test was not made: {answer.status_code}")
                return
            test_id = answer.json()["id"]
            where = self.deleted[test_id] = {"there"}
            where.add("trash")
            entry = client.delete(f"/tests/{test_id}").json()
            where.discard("there")
            self.counts["deleted"] += 1
            if self.random.random() < 0.5:
                where.add("there")
                client.post(f"/trash/{entry['id']}:restore").raise_for_status()
                where.discard("trash")

    # what must be after the next start -------------------------------------------------------------------------

    def check(self, client: httpx.Client) -> None:
        """Compare everything that was acknowledged with what the restarted service has."""
        in_flight = list(self.asked.values())
        self.asked.clear()
        self._check_steps(client, in_flight)
        self._check_files()
        for job_id, last in self.jobs.items():
            state = client.get(f"/jobs/{job_id}").json().get("state")
            if state not in FINAL or (last in FINAL and state != last):
                self.complain(f"job {job_id} was {last} and reads {state} after the restart")
            self.counts[f"{state} after a kill"] += last not in FINAL
        self.jobs = {}
        for calibration in client.get("/calibrations").json()["calibrations"]:
            if calibration["state"] == "unfinished":
                self.complain(f"calibration {calibration['id']} reads unfinished though nobody works on it")
        self._check_results(client)
        trashed = {entry.get("test_id") for entry in client.get("/trash").json()["trash"]}
        there = {test["id"] for test in client.get("/tests").json()["tests"]}
        for test_id, where in self.deleted.items():
            found = {name for name, ids in (("there", there), ("trash", trashed)) if test_id in ids}
            if len(found) != 1 or not found <= where:
                self.complain(f"test {test_id} is {found or 'nowhere'}, it was acknowledged as {where}")
            where.intersection_update(found)

    def _check_steps(self, client: httpx.Client, in_flight: list[Asked]) -> None:
        for test_id in {t for t, _ in self.steps} | {a.test_id for a in in_flight}:
            shown = client.get(f"/tests/{test_id}").json()
            here = steps_of(client, test_id)
            mine = {n for t, n in self.steps if t == test_id}
            if mine - here:
                self.complain(f"acknowledged steps {sorted(mine - here)} of test {test_id} are lost")
            waiting = [a for a in in_flight if a.test_id == test_id]
            half = set(shown["incomplete_steps"]) - self.incomplete.get(test_id, set())
            self.incomplete.setdefault(test_id, set()).update(half)
            self.counts["incomplete steps"] += len(half)
            self.counts["complete, unacknowledged steps"] += len(here - mine)
            if len(half) + len(here - mine) > len(waiting):
                self.complain(
                    f"{len(waiting)} steps had no answer, {half} are incomplete, {here - mine} unacknowledged"
                )
            for asked in waiting:  # sent again, it has one effect
                self._make(client, asked)
            now = steps_of(client, test_id)
            if now != {n for t, n in self.steps if t == test_id}:
                self.complain(f"after sending {len(waiting)} requests again, test {test_id} has steps {sorted(now)}")
        # the files of all are compared below; over HTTP the new ones, and some of the others
        old = [key for key in self.steps if key not in self.fresh]
        for test_id, n in {*self.fresh, *self.random.sample(old, min(len(old), 10))}:
            document = self.steps[test_id, n]
            if client.get(f"/tests/{test_id}/steps/{n}").json() != document:
                self.complain(f"step {n} of test {test_id} is not what was acknowledged")
            for cam in ("cam1", "cam2"):
                content = client.get(f"/tests/{test_id}/steps/{n}/{cam}").content
                if hashlib.sha256(content).hexdigest() != document["sha256"][cam]:
                    self.complain(f"{cam} of step {n} of test {test_id} is not what was acknowledged")
                self.counts["images read back"] += 1
        self.fresh.clear()

    def _check_results(self, client: httpx.Client) -> None:
        for (analysis_id, n), sha256 in self.results.items():
            url = f"/tests/{self.copied}/analyses/{analysis_id}"
            if n not in client.get(url).json()["steps_finished"]:
                self.complain(f"the announced result of step {n} of analysis {analysis_id} is gone")
            content = client.get(f"{url}/export", params={"step": n}).content
            if hashlib.sha256(content).hexdigest() != sha256:
                self.complain(f"the result of step {n} of analysis {analysis_id} is not what was announced")
            self.counts["results read back"] += 1

    def _check_files(self) -> None:
        for (test_id, n), document in self.steps.items():
            path = self.data / "tests" / test_id / "steps" / f"{n:04d}" / "step.json"
            if not path.is_file() or json.loads(path.read_text())["sha256"] != document["sha256"]:
                self.complain(f"step.json of step {n} of test {test_id} is not what was acknowledged")
        found = verify(self.data)
        for finding in found.findings:
            if finding.level != "incomplete" or "half written" in finding.text:
                self.complain(f"verify: {finding.level}: {finding.path}: {finding.text}")

    def new_capture(self, client: httpx.Client) -> None:
        """A new capture works; the first of a folder makes its test."""
        if not self.test_id:
            self.test_id = client.post("/tests", json={"name": "torture"}).json()["id"]
        deadline = time.monotonic() + _ANSWER_S
        while (answer := self._make(client, self.capture_request())).status_code != 201:
            if time.monotonic() > deadline:
                self.complain(f"no capture after a restart: {answer.text[:300]}")
                return
            time.sleep(0.02)
