"""Calibration from a folder of views, a target file and a rig file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from core.boards import BoardTarget
from core.calibration import CalibrationOptions, CalibrationResult
from core.calibration.from_images import ImageOfTarget, calibrate_views
from core.calibration.inputs import is_held_out
from core.errors import CalibrationError
from core.grid import GridView, Localiser
from core.progress import Progress, no_progress
from core.target import GridTarget
from server.formats.calibrations.native import calibration_content, write_calibration
from server.formats.calibrations.target_toml import read_rig, read_target
from server.formats.files import make_folder, sha256_of
from server.formats.images import decode, read_file
from server.formats.version import software_version
from server.formats.views import ViewFile, find_views


@dataclass(frozen=True)
class FolderCalibration:
    """A calibration with its origin, as its file records it."""

    result: CalibrationResult
    target: GridTarget | BoardTarget
    provenance: dict[str, object]

    def content(self) -> dict[str, object]:
        """Return the content of calibration.json."""
        return calibration_content(self.result, self.target, provenance=self.provenance)

    def write(self, path: Path) -> None:
        """Write calibration.json.

        Raises
        ------
        CalibrationError
            ``calibration_rejected`` if the verdict is failed; nothing is written.
        StorageError
            ``storage_full`` or ``storage_failed``.
        """
        self.check()
        make_folder(path.absolute().parent)
        write_calibration(path, self.result, self.target, provenance=self.provenance)

    def check(self) -> None:
        """Raise CalibrationError ``calibration_rejected`` if the verdict is failed."""
        if self.result.verdict.level == "failed":
            raise CalibrationError(
                f"The calibration is not usable, nothing was written: {' '.join(self.result.verdict.reasons)}",
                code="calibration_rejected",
            )


def calibrate_folder(
    views: Path,
    target: Path,
    rig: Path,
    *,
    hold_out: Sequence[float] = (),
    localiser: Localiser = "profile",
    progress: Progress = no_progress,
) -> FolderCalibration:
    """Calibrate from files.

    Parameters
    ----------
    views
        Folder of images with camera and travel in the name, as ``cam2_+5.000mm.tif``, or with camera and number of a
        free pose, as ``cam2_005.tif``.
    target, rig
        TOML files: the target; the nominal cameras and what moves.
    hold_out
        Positions in mm, or numbers of free poses, to leave out of the fit and check with.
    localiser
        Method of locating the intersections.
    progress
        Reports (phase, done, total).

    Raises
    ------
    StereorigError
        Files that cannot be used, a grid that is not found, positions that do not determine the cameras.
    """
    grid, nominal = read_target(target), read_rig(rig)
    files = find_views(views)
    decoded = {f.path: decode(read_file(f.path), name=str(f.path)) for f in files}
    images = [ImageOfTarget(f.camera, f.dz_mm, decoded[f.path].pixels, f.path.name, f.frame) for f in files]
    options = nominal.options(*_held_out(files, hold_out))
    found = calibrate_views(images, grid, (nominal.cam1, nominal.cam2), options, localiser=localiser, progress=progress)
    provenance: dict[str, object] = {
        "software": software_version(),
        "localiser": localiser,
        "line_model": next((g.line_model for g in found.grids if isinstance(g, GridView)), None),
        "views_sha256": {f.path.name: sha256_of(f.path) for f in files},
        "views_grey_from": {f.path.name: made for f in files if (made := decoded[f.path].grey_from) is not None}
        or None,
        "target_file": str(target),
        "rig_file": str(rig),
        "nominal_rig": asdict(nominal),
    }
    return FolderCalibration(found.result, grid, provenance)


def _held_out(files: Sequence[ViewFile], hold_out: Sequence[float]) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Split the values given into stage positions and numbers of free poses: a position where one is near."""
    frames = {f.frame for f in files if f.frame is not None}
    positions: list[float] = []
    poses: list[int] = []
    for value in hold_out:
        staged = any(
            f.dz_mm is not None and is_held_out(f.dz_mm, CalibrationOptions(held_out_mm=(value,))) for f in files
        )
        if not staged and frames and (value in frames or all(f.dz_mm is None for f in files)) and value == int(value):
            poses.append(int(value))
        else:
            positions.append(value)
    return tuple(positions), tuple(poses)
