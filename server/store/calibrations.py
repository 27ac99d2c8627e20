"""Calibrations on disk: the plan, the views as taken, the result.

``plan.json`` is written first, ``view.json`` when every view is there, ``calibration.json`` last: only a folder that
holds it is a calibration. A calibration that failed its verdict is kept as ``rejected.json`` instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from server.base.errors import NotFoundError
from server.formats.calibrations.kept_checks import checks_file, keep_check, read_checks, with_checks
from server.formats.files import known_sha256, mismatch, require_recorded, sha256_of
from server.formats.images import GrayImage, encode_tiff
from server.store.documents import CalibrationRecord, failure_state
from server.store.durable import make_folder, read_json, record_of, write_bytes, write_json
from server.store.folder import DataFolder, is_id, now_utc

REJECTED = "rejected.json"


#: a review's file, and its earlier name
_REVIEWS = ("review.json", "judgement.json")


class CalibrationStore:
    """The calibrations of one data folder."""

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder

    def path(self, calibration_id: str) -> Path:
        """Folder of an existing calibration.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        """
        path = self._folder.calibrations / calibration_id if is_id(calibration_id, "c") else None
        if path is None or not (path / "plan.json").is_file():
            raise NotFoundError(f"There is no calibration {calibration_id[:40]!r}.", kind="calibration")
        return path

    def ids(self) -> list[str]:
        """Ids of all calibrations, finished or not, in the order of their making."""
        return sorted(
            p.parent.name for p in self._folder.calibrations.glob("c*/plan.json") if is_id(p.parent.name, "c")
        )

    def create(self, plan: Mapping[str, object], target: Mapping[str, object]) -> str:
        """Make the folder of a new calibration and return its id."""
        calibration_id = self._folder.ids.new("c")
        path = self._folder.calibrations / calibration_id
        make_folder(path)
        make_folder(path / "views")
        write_json(path / "target.json", target)
        write_json(path / "plan.json", {"id": calibration_id, "created_utc": now_utc(), **plan})
        return calibration_id

    def add_imported(self, plan: Mapping[str, object], content: Mapping[str, object]) -> str:
        """Store a calibration that was made elsewhere, complete at once; return its id."""
        calibration_id = self._folder.ids.new("c")
        path = self._folder.calibrations / calibration_id
        make_folder(path)
        # plan.json is what makes the folder one of ours: after it, nothing is missing
        write_json(path / "calibration.json", content, checksum=True)
        write_json(path / "plan.json", {"id": calibration_id, "created_utc": now_utc(), **plan})
        return calibration_id

    def create_repaired(self, plan: Mapping[str, object], mask: bytes | None) -> str:
        """Make the folder of a calibration that is to be repaired from another one; return its id."""
        calibration_id = self._folder.ids.new("c")
        path = self._folder.calibrations / calibration_id
        make_folder(path)
        if mask is not None:
            write_bytes(path / "mask.png", mask)
        write_json(path / "plan.json", {"id": calibration_id, "created_utc": now_utc(), **plan})
        return calibration_id

    def put_view(self, calibration_id: str, index: int, cam: str, image: GrayImage) -> dict[str, str]:
        """Store one view; return its file name and checksum."""
        name = f"{index:03d}_{cam}.tif"
        digest = write_bytes(self.path(calibration_id) / "views" / name, encode_tiff(image))
        return {"file": f"views/{name}", "sha256": digest}

    def put_views_done(self, calibration_id: str, views: Sequence[Mapping[str, object]]) -> None:
        """Write ``view.json``: every view with camera, read-back position and checksum."""
        write_json(self.path(calibration_id) / "view.json", {"views": views})

    def put_failure(self, calibration_id: str, problem: Mapping[str, object]) -> None:
        """Record the reason why there is no calibration."""
        write_json(self.path(calibration_id) / "failure.json", problem)

    def put_review(self, calibration_id: str, document: Mapping[str, object] | None) -> None:
        """Keep the review of a calibration beside it; None removes it."""
        path = self.path(calibration_id) / _REVIEWS[0]
        write_json(path, {"decision": None} if document is None else document)

    def checks(self, calibration_id: str) -> dict[str, dict[str, Any]]:
        """Findings of the checks made since, by their names; empty without any."""
        path = self.path(calibration_id) / "calibration.json"
        return read_checks(path, self.checksum(calibration_id)) if checks_file(path).exists() else {}

    def put_check(self, calibration_id: str, name: str, finding: Mapping[str, object]) -> None:
        """Keep a check's finding beside the calibration; an earlier one of the same name is replaced."""
        keep_check(self.path(calibration_id) / "calibration.json", self.checksum(calibration_id), name, finding)

    def read(self, calibration_id: str) -> CalibrationRecord:
        """Return plan, views taken, result and state (``unfinished``, ``cancelled``, ``failed``, ``complete``).

        One that failed its verdict has the rejected result.
        """
        path = self.path(calibration_id)
        document: dict[str, object] = {
            "id": calibration_id,
            "state": "unfinished",
            "plan": read_json(path / "plan.json"),
        }
        document["taken"] = read_json(path / "view.json")["views"] if (path / "view.json").exists() else None
        if (path / "calibration.json").exists():
            require_recorded(
                path / "calibration.json", f"calibration {calibration_id}", f"calibrations/{calibration_id}"
            )
            # a file from elsewhere may hold anything; the service's own entries come last
            made = with_checks(read_json(path / "calibration.json"), self.checks(calibration_id))
            document = {**made, **document, "state": "complete", "problem": None}
        elif (path / "failure.json").exists():
            problem = read_json(path / "failure.json")
            document |= {"state": failure_state(problem), "problem": problem}
            if (path / REJECTED).exists():  # a rejected calibration is kept for inspection
                document = {**read_json(path / REJECTED), **document}
        kept = next((path / name for name in _REVIEWS if (path / name).exists()), None)
        review = {} if kept is None else read_json(kept)
        document["review"] = review if review.get("decision") is not None else None
        return record_of(CalibrationRecord, document, path / "plan.json")

    def view_file(self, calibration_id: str, index: int, cam: str) -> Path:
        """Path of one stored view."""
        path = self.path(calibration_id) / "views" / f"{index:03d}_{cam}.tif"
        if not path.is_file():
            raise NotFoundError(f"Calibration {calibration_id} has no view {index} of {cam}.", kind="view")
        taken = self.path(calibration_id) / "view.json"
        for view in read_json(taken)["views"] if taken.exists() else ():
            if view.get("file") == f"views/{path.name}" and known_sha256(path) != view.get("sha256"):
                raise mismatch(path.name, f"calibration {calibration_id}", f"calibrations/{calibration_id}/views")
        return path

    def checksum(self, calibration_id: str) -> str:
        """SHA-256 of ``calibration.json``."""
        return sha256_of(self.path(calibration_id) / "calibration.json")
