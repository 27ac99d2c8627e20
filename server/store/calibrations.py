"""Calibrations on disk: the plan, the views as taken, the result.

``plan.json`` is written first, ``view.json`` when every view is there, ``calibration.json`` last: only a folder that
holds it is a calibration. A calibration that failed its verdict is kept as ``rejected.json`` instead.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.made import MadeCalibration, failure_state
from stereorig.server.formats.calibrations.kept_checks import checks_file, keep_check, read_checks, with_checks
from stereorig.server.formats.images import GrayImage, encode_tiff
from stereorig.server.formats.manifest import checked_bytes, is_there, require_sound
from stereorig.server.store.durable import make_folder, read_json, record_of, write_bytes
from stereorig.server.store.folder import DataFolder, is_id, now_utc

REJECTED = "rejected.json"
#: state of a guided acquisition, in the folder of its plan
GUIDANCE = "guide.json"
REVIEW = "review.json"


class CalibrationStore:
    """The calibrations of one data folder."""

    def __init__(self, folder: DataFolder) -> None:
        self._folder, self._manifests = folder, folder.manifests

    def path(self, calibration_id: str) -> Path:
        """Folder of an existing calibration.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        """
        path = self._folder.calibrations / calibration_id if is_id(calibration_id, "c") else None
        if path is None or not is_there(path / "plan.json"):
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
        self._manifests.write_json(path / "target.json", target)
        self._manifests.write_json(path / "plan.json", {"id": calibration_id, "created_utc": now_utc(), **plan})
        return calibration_id

    def add_imported(self, plan: Mapping[str, object], content: Mapping[str, object]) -> str:
        """Store a calibration that was made elsewhere, complete at once; return its id."""
        calibration_id = self._folder.ids.new("c")
        path = self._folder.calibrations / calibration_id
        make_folder(path)
        # plan.json makes the folder one of ours, and is written last: once it is there, nothing is missing
        self._manifests.write_json(path / "calibration.json", content, checksum=True)
        self._manifests.write_json(path / "plan.json", {"id": calibration_id, "created_utc": now_utc(), **plan})
        return calibration_id

    def create_repaired(self, plan: Mapping[str, object], mask: bytes | None) -> str:
        """Make the folder of a calibration that is to be repaired from another one; return its id."""
        calibration_id = self._folder.ids.new("c")
        path = self._folder.calibrations / calibration_id
        make_folder(path)
        if mask is not None:
            self._manifests.write(path / "mask.png", mask)
        self._manifests.write_json(path / "plan.json", {"id": calibration_id, "created_utc": now_utc(), **plan})
        return calibration_id

    def put_view(self, calibration_id: str, index: int, cam: str, image: GrayImage) -> dict[str, str]:
        """Store one view; return its file name and checksum."""
        name = f"{index:03d}_{cam}.tif"
        digest = write_bytes(self.path(calibration_id) / "views" / name, encode_tiff(image))
        return {"file": f"views/{name}", "sha256": digest}

    def put_views_done(self, calibration_id: str, views: Sequence[Mapping[str, object]]) -> None:
        """Write ``view.json``: every view with camera, read-back position and checksum."""
        self._manifests.write_json(self.path(calibration_id) / "view.json", {"views": views})

    def put_failure(self, calibration_id: str, problem: Mapping[str, object]) -> None:
        """Record the reason why there is no calibration."""
        self._manifests.write_json(self.path(calibration_id) / "failure.json", problem)

    def put_guidance(self, calibration_id: str, state: Mapping[str, object]) -> None:
        """Store the state of a guided acquisition."""
        self._manifests.write_json(self.path(calibration_id) / GUIDANCE, state)

    def take_over(self, calibration_id: str) -> None:
        """List the files that a worker wrote into a calibration's folder."""
        path = self.path(calibration_id)
        made = [path / name for name in ("calibration.json", "residuals.nc", REJECTED)]
        self._manifests.take_over(path, [one for one in made if one.is_file()])

    def put_review(self, calibration_id: str, document: Mapping[str, object] | None) -> None:
        """Keep the review of a calibration beside it; None removes it."""
        path = self.path(calibration_id) / REVIEW
        self._manifests.write_json(path, {"decision": None} if document is None else document)

    def checks(self, calibration_id: str) -> dict[str, dict[str, Any]]:
        """Findings of the checks made since, by their names; empty without any."""
        path = self.path(calibration_id) / "calibration.json"
        return read_checks(path, self.checksum(calibration_id)) if is_there(checks_file(path)) else {}

    def put_check(self, calibration_id: str, name: str, finding: Mapping[str, object]) -> None:
        """Store a check's finding in the calibration's folder; an earlier one of the same name is replaced."""
        path = self.path(calibration_id) / "calibration.json"
        keep_check(path, self.checksum(calibration_id), name, finding, write=self._manifests.write)

    def read(self, calibration_id: str) -> MadeCalibration:
        """Return plan, views taken, result and state (``unfinished``, ``cancelled``, ``failed``, ``complete``).

        One that failed its verdict has the rejected result.
        """
        path = self.path(calibration_id)
        document: dict[str, object] = {
            "id": calibration_id,
            "state": "unfinished",
            "plan": read_json(path / "plan.json"),
        }
        document["taken"] = read_json(path / "view.json")["views"] if is_there(path / "view.json") else None
        if is_there(path / "calibration.json"):
            # a file from elsewhere may hold anything; the service's own entries come last
            made = with_checks(read_json(path / "calibration.json"), self.checks(calibration_id))
            document = {**made, **document, "state": "complete", "problem": None}
        elif is_there(path / "failure.json"):
            problem = read_json(path / "failure.json")
            document |= {"state": failure_state(problem), "problem": problem}
            if is_there(path / REJECTED):  # a rejected calibration is kept for inspection
                document = {**read_json(path / REJECTED), **document}
        review = read_json(path / REVIEW) if is_there(path / REVIEW) else {}
        document["review"] = review if review.get("decision") is not None else None
        return record_of(MadeCalibration, document, path / "plan.json")

    def view_file(self, calibration_id: str, index: int, cam: str) -> Path:
        """Path of one stored view."""
        path = self.path(calibration_id) / "views" / f"{index:03d}_{cam}.tif"
        if not is_there(path):
            raise NotFoundError(f"Calibration {calibration_id} has no view {index} of {cam}.", kind="view")
        require_sound(path)
        return path

    def checksum(self, calibration_id: str) -> str:
        """SHA-256 of ``calibration.json``, which is as it was written."""
        return hashlib.sha256(checked_bytes(self.path(calibration_id) / "calibration.json")).hexdigest()
