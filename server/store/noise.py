"""Noise measurements on disk: the frames as taken, the models.

``plan.json`` is written first, ``frames.json`` when every frame is there, ``noise.json`` last: only a folder that holds
it is a noise measurement.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from stereorig.core.errors import FileFormatError, StateError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.base.problem import RESTART, problem_of
from stereorig.server.documents.made import MadeRecord, failure_state
from stereorig.server.formats.images import GrayImage, encode_tiff
from stereorig.server.formats.manifest import is_there, require_sound
from stereorig.server.store.durable import make_folder, read_json, record_of, write_bytes
from stereorig.server.store.folder import DataFolder, is_id, now_utc


class NoiseStore:
    """The noise measurements of one data folder."""

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder

    def end_unfinished(self) -> None:
        """Reserve the ids that exist, and mark every unfinished measurement as failed."""
        for noise_id in self.ids():
            self._folder.ids.reserve(noise_id)
            with contextlib.suppress(FileFormatError):  # one that is damaged must not keep the service from starting
                if self.read(noise_id).state == "unfinished":
                    # no job works on it any more: the job that did ended with the last service
                    self.put_failure(noise_id, problem_of(RESTART).plain())

    @property
    def _root(self) -> Path:
        return self._folder.root / "noise"

    def path(self, noise_id: str) -> Path:
        """Folder of an existing noise measurement.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        """
        path = self._root / noise_id if is_id(noise_id, "n") else None
        if path is None or not is_there(path / "plan.json"):
            raise NotFoundError(f"There is no noise measurement {noise_id[:40]!r}.", kind="noise")
        return path

    def ids(self) -> list[str]:
        """Ids of all noise measurements, finished or not, in the order of their making."""
        return sorted(p.parent.name for p in self._root.glob("n*/plan.json") if is_id(p.parent.name, "n"))

    def create(self, plan: Mapping[str, object]) -> str:
        """Make the folder of a new noise measurement and return its id."""
        noise_id = self._folder.ids.new("n")
        if not self._root.exists():
            make_folder(self._root)
        path = self._root / noise_id
        make_folder(path)
        make_folder(path / "frames")
        self._folder.manifests.write_json(path / "plan.json", {"id": noise_id, "created_utc": now_utc(), **plan})
        return noise_id

    def put_frame(self, noise_id: str, index: int, cam: str, image: GrayImage) -> dict[str, str]:
        """Store one frame; return its camera, file name and checksum."""
        name = f"frames/{index:03d}_{cam}.tif"
        return {"camera": cam, "file": name, "sha256": write_bytes(self.path(noise_id) / name, encode_tiff(image))}

    def put_frames_done(
        self, noise_id: str, frames: Sequence[Mapping[str, str]], entries: Mapping[str, object]
    ) -> None:
        """Write ``frames.json``: every frame with camera and checksum, and the cameras' settings."""
        self._folder.manifests.write_json(self.path(noise_id) / "frames.json", {**entries, "frames": frames})

    def put_failure(self, noise_id: str, problem: Mapping[str, object]) -> None:
        """Record the reason why there are no models."""
        self._folder.manifests.write_json(self.path(noise_id) / "failure.json", problem)

    def take_over(self, noise_id: str) -> None:
        """List the files that a worker wrote into the folder of a noise measurement."""
        path = self.path(noise_id)
        self._folder.manifests.take_over(path, [path / "noise.json"])

    def read(self, noise_id: str) -> MadeRecord:
        """Return plan, models and state (``unfinished``, ``cancelled``, ``failed``, ``complete``)."""
        path = self.path(noise_id)
        document: dict[str, object] = {"id": noise_id, "state": "unfinished", "plan": read_json(path / "plan.json")}
        if is_there(path / "noise.json"):
            document = {**read_json(path / "noise.json"), **document, "state": "complete", "problem": None}
        elif is_there(path / "failure.json"):
            problem = read_json(path / "failure.json")
            document |= {"state": failure_state(problem), "problem": problem}
        return record_of(MadeRecord, document, path / "plan.json")

    def file(self, noise_id: str) -> Path:
        """Path of ``noise.json``.

        Raises
        ------
        StateError
            ``noise_not_complete`` if it is not there.
        """
        path = self.path(noise_id) / "noise.json"
        if not is_there(path):
            raise StateError(
                f"Noise measurement {noise_id} is {self.read(noise_id).state}.",
                code="noise_not_complete",
                remedy="Wait for its job, or measure again.",
            )
        require_sound(path)
        return path
