"""A laboratory's day on the service itself, recorded down to every change of its data folder.

Captures, a burst, imports, calibrations, noise, an analysis, models, certificates, recipes, deletion and restoring,
over HTTP and one after the other: after each answer, the folder as it is then is what was acknowledged.
"""

from __future__ import annotations

import json
import random
import sqlite3
import threading
import uuid
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

import stereorig.server.formats.disk
from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.images import encode_tiff
from stereorig.server.worker.executor import TaskExecutor, TaskFuture
from stereorig.server.workflows.service import Service
from tests.bench.reliability.torture_lab import REGION, Pictures
from tests.support.power_loss.journal import Journal
from tests.support.service_rig import SMALL, served, wait_for_job, wait_for_rig

COPIED = "t000007-abcdef"
_RIG = SMALL.replace("frames = 2", "frames = 1").replace("time_scale = 2.5", "time_scale = 10.0")
#: nodes of a finite element result about the plate's face
_MODEL = b"x,y,z,ux,uy,uz\n" + b"".join(b"%d,%d,0,0,0,0.01\n" % (x, y) for x in (-20, 0, 20) for y in (-20, 0, 20))


class ThreadWorker(TaskExecutor):
    """Runs each task where it is handed over, so that what it writes is recorded too."""

    def __init__(self) -> None:
        self.ready, self.compiling = threading.Event(), threading.Event()
        self.ready.set()
        self.pid: int | None = None
        self.starts = 1

    @property
    def width(self) -> int:
        """One."""
        return 1

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> TaskFuture:
        """Run it now."""
        future = TaskFuture()
        future.set_running_or_notify_cancel()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001 - it belongs to the future
            future.set_exception(error)
        return future


@dataclass(frozen=True)
class Answer:
    """The moment of an answer.

    Parameters
    ----------
    what
        The request.
    at
        Number of changes before it.
    keys
        Idempotency-Keys of all requests that were answered so far.
    catalog
        Key of the catalogue's content then.
    """

    what: str
    at: int
    keys: frozenset[str]
    catalog: str


@dataclass
class Recording:
    """A day: its changes, and what was acknowledged when."""

    journal: Journal
    answers: list[Answer] = field(default_factory=list)


class _Day:
    def __init__(self, client: httpx.Client, data: Path, recording: Recording, pictures: Pictures, seed: int) -> None:
        self.client, self.data, self.recording, self.pictures = client, data, recording, pictures
        self.random = random.Random(seed)
        self.keys: set[str] = set()

    def answered(self, what: str) -> None:
        """Note that everything up to here is acknowledged."""
        journal = self.recording.journal
        copy = sqlite3.connect(":memory:")
        with closing(copy), closing(sqlite3.connect(self.data / "catalog.sqlite")) as catalog:
            catalog.backup(copy)
            content = copy.serialize()
        key = f"catalog {len(self.recording.answers)}"
        journal.blobs[key] = content
        self.recording.answers.append(Answer(what, len(journal.changes), frozenset(self.keys), key))

    def ask(self, method: str, url: str, **body: Any) -> Any:
        key = uuid.uuid4().hex
        headers = {"Idempotency-Key": key} if method == "POST" else {} if url.endswith("/watch") else {"If-Match": "*"}
        answer = self.client.request(method, f"/api/v1{url}", headers=headers, **body)
        assert answer.is_success, f"{method} {url}: {answer.status_code} {answer.text[:500]}"
        found = answer.json() if answer.content else {}
        if method == "POST" and url.split("?")[0].rsplit("/", 1)[-1].split(":")[0] in (
            "steps",
            "calibrations",
            "analyses",
        ):
            self.keys.add(key)
        if isinstance(found, dict) and isinstance(found.get("job"), dict):
            # what it writes until its end is not acknowledged
            job = wait_for_job(self.client, found["job"])
            assert job["state"] == "succeeded", job
        self.answered(f"{method} {url}")
        return found

    def noise_pair(self) -> dict[str, Any]:
        """Return a pair of images as an upload; nothing is measured in it."""
        pixels = np.random.default_rng(3).integers(0, 255, (2, 240, 256)).astype(np.uint8)
        return {f"cam{i}": (f"cam{i}.tif", encode_tiff(pixels[i - 1])) for i in (1, 2)}

    def plate_pair(self) -> dict[str, Any]:
        """Return a pair of the copied test's images as an upload."""
        return {cam: (f"{cam}.tif", content) for cam, content in self.pictures.pairs[2].items()}

    def run(self) -> None:
        """Do the day's work."""
        self.answered("start")
        self._recipes()
        self.ask("PUT", "/sim/scene", json={"scene": "grid"})
        calibration = self.ask("POST", "/calibrations", json={"frames": 2})["calibration_id"]
        self.ask("PUT", f"/calibrations/{calibration}/review", json={"decision": "accepted", "note": "seen"})
        noise = self.ask("POST", "/noise", json={"frames": 4})["noise_id"]
        self.ask("PUT", "/sim/scene", json={"scene": "plate"})
        parts: list[Callable[[], list[str]]] = [lambda: self._test(calibration), self._analysis]
        self.random.shuffle(parts)
        made = [url for part in parts for url in part()]
        # a test after what belongs to it
        urls = [f"/noise/{noise}", f"/calibrations/{calibration}", *sorted(made, key=len, reverse=True)]
        for url in [urls[i] for i in self._order(urls)]:
            self._delete(url)

    def stopped(self) -> None:
        """Note an orderly stop; the catalogue is closed, and the mark that stands beside it names it as it is."""
        key = f"catalog {len(self.recording.answers)}"
        self.recording.journal.blobs[key] = (self.data / "catalog.sqlite").read_bytes()
        self.recording.answers.append(
            Answer("an orderly stop", len(self.recording.journal.changes), frozenset(self.keys), key)
        )

    def run_on(self) -> None:
        """Do some more after the next start."""
        self.answered("start after an orderly stop")
        self.ask("POST", f"/tests/{COPIED}/steps:import", files=self.plate_pair())
        self.ask("PATCH", f"/tests/{COPIED}", json={"name": "copied and renamed"})
        url = f"/tests/{self.ask('POST', '/tests', json={'name': 'two'})['id']}"
        self.ask("POST", f"{url}/steps:import", files=self.plate_pair())

    def _order(self, urls: list[str]) -> list[int]:
        order = list(range(len(urls)))
        self.random.shuffle(order)
        inner = sorted(i for i in order if urls[i].startswith("/tests"))
        return [inner.pop(0) if urls[i].startswith("/tests") else i for i in order]

    def _recipes(self) -> None:
        recipe = self.ask("POST", "/recipes", json={"name": "coupon", "recipe": {"version": 1}})["id"]
        self.ask("PATCH", f"/recipes/{recipe}", json={"name": "coupon 2"})
        if self.random.random() < 0.5:
            self.ask("DELETE", f"/recipes/{recipe}")

    def _test(self, calibration: str) -> list[str]:
        """Make a test with steps of every kind; return it and a step."""
        ask = self.ask
        url = f"/tests/{ask('POST', '/tests', json={'name': 'one', 'calibration_id': calibration})['id']}"
        kinds: list[dict[str, Any]] = [
            {"json": {"label": "load"}},
            {"json": {"count": 2}},
            {"files": self.noise_pair()},
            {"json": {"label": "more", "channels": {"stroke_mm": 0.1}}},
        ]
        self.random.shuffle(kinds)
        for body in kinds:
            ask("POST", f"{url}/steps:import" if "files" in body else f"{url}/steps", **body)
        ask("PATCH", url, json={"name": "renamed"})
        ask("PUT", f"{url}/metadata", json={"operator": "a name"})
        ask("PATCH", f"{url}/steps/1", json={"label": "another"})
        ask("PUT", f"{url}/watch", json={"channel": "stroke_mm", "threshold": 0.1})
        for stroke_mm in (0.0, 0.5):
            ask("POST", f"{url}/channels", json={"channels": {"stroke_mm": stroke_mm}})
        ask("POST", f"{url}/watch:end")
        return [url, f"{url}/steps/2"]

    def _analysis(self) -> list[str]:
        """Measure the copied test, and give it another calibration; return the analysis."""
        body = {"region": REGION, "steps": [1, 2], "subset_px": 21, "spacing_px": 16, "patch": "affine"}
        analysis = self.ask("POST", f"/tests/{COPIED}/analyses", json=body)["analysis_id"]
        cameras = {"file": ("c.json", json.dumps(self.pictures.calibration))}
        imported = self.ask("POST", "/calibrations:import", files=cameras)["id"]
        self.ask("PATCH", f"/tests/{COPIED}", json={"calibration_id": imported})
        parts = [self._model, lambda: self._certificates(analysis)]
        self.random.shuffle(parts)
        for part in parts:
            part()
        return [f"/tests/{COPIED}/analyses/{analysis}"]

    def _model(self) -> None:
        """Keep two models with the copied test, and delete one."""
        url = f"/tests/{COPIED}/models"
        model = self.ask("POST", url, files={"file": ("plate.csv", _MODEL)}, data={"unit": "mm"})["id"]
        self.ask("POST", url, files={"file": ("plate.csv", _MODEL)}, data={"unit": "um"})
        self.ask("DELETE", f"{url}/{model}")

    def _certificates(self, analysis: str) -> None:
        """Make certificates of the analysis, and withdraw them, or it could not be deleted."""
        for title in ("first", "second"):
            plan = {"title": title, "static_steps": [1, 2]}
            self.ask("POST", "/certificates", json={"test_id": COPIED, "analysis_id": analysis, "plan": plan})
        for one in self.client.get("/api/v1/certificates").json()["certificates"]:
            self.ask("POST", f"/certificates/{one['id']}:withdraw", json={"reason": "the next part of the day"})

    def _delete(self, url: str) -> None:
        """Delete, restore, and delete again; for good sometimes."""
        entry = self.ask("DELETE", url)["id"]
        self.ask("POST", f"/trash/{entry}:restore")
        if self.random.random() < 0.8:
            entry = self.ask("DELETE", url)["id"]
            if self.random.random() < 0.7:
                self.ask("DELETE", f"/trash/{entry}")


def record(top: Path, pictures: Pictures, seed: int) -> Recording:
    """Record a day in ``top/data``; the service starts on a folder that holds one copied test.

    Parameters
    ----------
    top
        An empty folder.
    pictures
        Of the copied test.
    seed
        Of the order of things.
    """
    data = top / "data"
    pictures.write_test(data / "tests" / COPIED)
    journal = Journal(top)
    recording = Recording(journal)
    real, stereorig.server.formats.disk.disk = stereorig.server.formats.disk.disk, journal
    try:
        service = Service(parse_config(_RIG), data, worker=ThreadWorker())  # type: ignore[arg-type] - as the service uses it
        with service, served(service) as client:
            wait_for_rig(client)
            day = _Day(client, data, recording, pictures, seed)
            day.run()
        day.stopped()
        service = Service(parse_config(_RIG), data, worker=ThreadWorker())  # type: ignore[arg-type]
        with service, served(service) as client:
            wait_for_rig(client)
            day.client = client
            day.run_on()
    finally:
        journal.stop()
        stereorig.server.formats.disk.disk = real
    return recording
