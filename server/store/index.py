"""The catalogue's index, rebuilt from the folders at every start."""

from __future__ import annotations

from typing import Any

from core.errors import FileFormatError
from server.problem import RESTART, problem_of
from server.store.calibrations import CalibrationStore
from server.store.catalog import Catalog
from server.store.folder import DataFolder
from server.store.tests import TestStore


def calibration_entry(store: CalibrationStore, calibration_id: str) -> dict[str, Any]:
    """What a list shows of a calibration."""
    document = store.read(calibration_id)
    verdict = document.get("verdict")
    return {
        "id": calibration_id,
        "state": document["state"],
        "label": document["plan"].get("label", ""),
        "created_utc": document["plan"]["created_utc"],
        "verdict": verdict,
    }


def test_entry(document: dict[str, Any]) -> dict[str, Any]:
    """What a list shows of a test."""
    return {k: document.get(k) for k in ("id", "name", "specimen", "calibration_id", "created_utc")}


def step_entry(document: dict[str, Any]) -> dict[str, Any]:
    """What a list shows of a step."""
    entry = {k: document.get(k) for k in ("n", "label", "load_n", "source", "captured_utc", "skew_ms")}
    return {**entry, "quality": document.get("quality", {}).get("code")}


def analysis_entry(document: dict[str, Any]) -> dict[str, Any]:
    """What a list shows of an analysis."""
    return {k: document.get(k) for k in ("id", "kind", "label", "created_utc", "job_id")}


def rebuild(catalog: Catalog, folder: DataFolder, calibrations: CalibrationStore, tests: TestStore) -> list[str]:
    """Make the index say what the folders hold; also take over Idempotency-Keys and ids found there.

    Returns
    -------
    list of str
        Differences between index and folders, and files that cannot be read.
    """
    entries: list[tuple[str, str, str, dict[str, Any]]] = []
    trouble: list[str] = []
    requests: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for calibration_id in calibrations.ids():
        folder.ids.seen(calibration_id)
        try:
            if calibrations.read(calibration_id)["state"] == "unfinished":
                # nobody works on it any more: the job that did ended with the last service
                calibrations.put_failure(calibration_id, problem_of(RESTART))
            document = calibrations.read(calibration_id)
            if document["plan"].get("source") == "import":  # the others' requests were for jobs that are gone
                requests.append((document["plan"], {"calibration_id": calibration_id}))
            entries.append(("calibration", "", calibration_id, calibration_entry(calibrations, calibration_id)))
        except (FileFormatError, KeyError) as error:
            trouble.append(f"calibration {calibration_id}: {error}")
    for test_id in tests.ids():
        folder.ids.seen(test_id)
        try:
            document = tests.read(test_id)
            requests.append((document, {"test_id": test_id}))
            entries.append(("test", "", test_id, test_entry(document)))
            for n in tests.step_numbers(test_id):
                step = tests.step(test_id, n).document
                requests.append((step, {"test_id": test_id, "n": n}))
                entries.append(("step", test_id, f"{n:04d}", step_entry(step)))
            for analysis_id in tests.analysis_ids(test_id):
                folder.ids.seen(analysis_id)
                analysis = tests.analysis(test_id, analysis_id)
                entries.append(("analysis", test_id, analysis_id, analysis_entry(analysis)))
        except (FileFormatError, KeyError) as error:
            trouble.append(f"test {test_id}: {error}")
    for document, made in requests:
        request = document.get("request")
        if request and catalog.request(request["scope"], request["key"]) is None:
            catalog.put_request(request["scope"], request["key"], request["body_sha256"], made)
    return catalog.replace_entries(entries) + trouble
