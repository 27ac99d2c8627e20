"""Calibration from a folder of views, a target file and a rig file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from stereorig.core.boards import BoardTarget
from stereorig.core.calibration import CalibrationOptions, CalibrationResult
from stereorig.core.calibration.from_images import ImageOfTarget, calibrate_views
from stereorig.core.calibration.inputs import is_held_out
from stereorig.core.grid import GridView, Localiser
from stereorig.core.progress import Progress, no_progress
from stereorig.core.target import GridTarget
from stereorig.server.formats.calibrations.native import calibration_content, write_calibration
from stereorig.server.formats.calibrations.target_toml import read_rig, read_target
from stereorig.server.formats.calibrations.views import ViewFile, find_views
from stereorig.server.formats.files import make_folder, sha256_of
from stereorig.server.formats.images import decode, read_file
from stereorig.server.formats.version import software_version


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
        self.result.verdict.check()


def calibrate_folder(
    views: Path | Sequence[ViewFile],
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
        free pose, as ``cam2_005.tif``; or the files themselves.
    target, rig
        TOML files: the target; the nominal cameras and the kind of motion between views.
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
    files = find_views(views) if isinstance(views, Path) else list(views)
    decoded = {f.path: decode(read_file(f.path), name=str(f.path)) for f in files}
    unique = len({f.path.name for f in files}) == len(files)
    names = {f.path: f.path.name if unique else str(f.path) for f in files}
    images = [ImageOfTarget(f.camera, f.dz_mm, decoded[f.path].pixels, names[f.path], f.frame) for f in files]
    options = nominal.options(*_held_out(files, hold_out))
    found = calibrate_views(images, grid, (nominal.cam1, nominal.cam2), options, localiser=localiser, progress=progress)
    provenance: dict[str, object] = {
        "software": software_version(),
        "localiser": localiser,
        "line_model": next((g.line_model for g in found.grids if isinstance(g, GridView)), None),
        "views_sha256": {names[f.path]: sha256_of(f.path) for f in files},
        "views_grey_from": {names[f.path]: made for f in files if (made := decoded[f.path].grey_from) is not None}
        or None,
        "target_file": str(target),
        "rig_file": str(rig),
        "nominal_rig": asdict(nominal),
    }
    return FolderCalibration(found.result, grid, provenance)


def _held_out(files: Sequence[ViewFile], hold_out: Sequence[float]) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Split the given values into stage positions and numbers of free poses: a position if a view was taken near it."""
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
