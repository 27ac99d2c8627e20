"""Steps measured anew with another subset, from the images and the calibration that the results were made from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.names import CAMERAS, CameraName
from stereorig.core.settings import StoredSettings
from stereorig.core.status import PointStatus
from stereorig.server.documents.tests import SummaryRecord
from stereorig.server.evaluations.door import Results
from stereorig.server.formats.calibrations.in_test import calibration_in
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration
from stereorig.server.formats.images import GrayImage, read_image
from stereorig.server.formats.manifest import known_sha256
from stereorig.server.formats.results.folder import home_of
from stereorig.server.store.durable import known_record

_MOST = 40_000  # points that are measured; of more, those about the middle

Images = tuple[GrayImage, GrayImage]


@dataclass(frozen=True, eq=False)
class Origin:
    """The results' images and calibration; each part raises ``images_missing`` if a file is gone or was replaced."""

    results: Results
    step: int
    """A step with displacements; its reference is that of all."""

    @cached_property
    def settings(self) -> StoredSettings:
        """Settings of the measurement."""
        try:
            found = StoredSettings.model_validate(self.results.head(self.step).settings)
        except ValidationError as error:
            raise _missing("The results do not state all settings of their measurement") from error
        return found

    @cached_property
    def reference(self) -> Images:
        """Both images of the reference."""
        return self._images(self.settings.reference, self.results.head(self.step).inputs_sha256, "reference_")

    @cached_property
    def calibration(self) -> LoadedCalibration:
        """The calibration that the results were measured with."""
        folder = home_of(self.results.file(self.step)).absolute()
        sha256 = self.results.head(self.step).inputs_sha256.get("calibration")
        named = known_record(SummaryRecord, folder / "summary.json").calibration.get("file")
        candidates = [Path(named)] if isinstance(named, str) else []
        if self._test is not None:
            candidates.insert(0, calibration_in(self._test, sha256))
        for path in candidates:
            if path.is_file():
                loaded = load_calibration(path)
                if sha256 is None or loaded.sha256 == sha256:
                    return loaded
        raise _missing("The calibration that the results were measured with is not at hand")

    def images(self, step: int) -> Images:
        """Return both images of a step."""
        return self._images(step, self.results.head(step).inputs_sha256, "")

    @property
    def _test(self) -> Path | None:
        home = home_of(self.results.file(self.step)).absolute().parent.parent
        return home if (home / "steps").is_dir() else None

    def _images(self, step: int, sha256: dict[str, str], prefix: str) -> Images:
        one, two = (self._image(step, cam, sha256.get(f"{prefix}{cam}")) for cam in CAMERAS)
        return one, two

    def _image(self, step: int, cam: CameraName, sha256: str | None) -> GrayImage:
        candidates = [] if self._test is None else [self._test / "steps" / f"{step:04d}" / f"{cam}.tif"]
        if step in self.results.steps and self.results.head(step).image_file(cam):
            named = Path(self.results.head(step).image_file(cam))
            candidates += [named, self.results.file(step).parent / named.name]
        for path in candidates:
            if path.is_file() and sha256 is not None and known_sha256(path) == sha256:
                return read_image(path)
        raise _missing(f"The image of {cam} at step {step} is not at hand, or was replaced")


class MeasuredAnew:
    """Steps of the results, measured with other subsets at the same points.

    Parameters
    ----------
    origin
        Images and calibration.
    like
        A field of the results: its points are measured.
    """

    def __init__(self, origin: Origin, like: Field, spacing_px: float) -> None:
        self._origin = origin
        wanted = like.status != PointStatus.MASKED
        rows, cols = (np.flatnonzero(wanted.any(axis=axis)) for axis in (1, 0))
        share = min(1.0, float(np.sqrt(_MOST / (len(rows) * len(cols)))))
        r, c = (_middle(one, share) for one in (rows, cols))
        x, y = like.x_px[r, c], like.y_px[r, c]
        grid = PointGrid.rectangle(*(float(v) for v in (x[0, 0], y[0, 0], x[-1, -1], y[-1, -1])), spacing_px=spacing_px)
        self._grid = replace(grid, allowed=grid.allowed & wanted[r, c], cuts=like.cuts)
        self._pair = ReferencePair(origin.calibration.pair, *origin.reference)

    def fields(self, steps: list[int], subset_px: int) -> list[Field]:
        """Return the fields of steps with a subset."""
        settings = self._origin.settings.model_copy(update={"subset_px": subset_px})
        options = MeasureOptions.of(settings)
        shape = self._pair.shape(self._grid, options)
        return [self._pair.motion(*self._origin.images(n), self._grid, options, shape=shape) for n in steps]


def _middle(of: np.ndarray, share: float) -> slice:
    cut = int(np.floor(0.5 * (1.0 - share) * len(of)))
    return slice(int(of[cut]), int(of[len(of) - 1 - cut]) + 1)


def _missing(why: str) -> InputError:
    return InputError(
        f"{why}.",
        code="images_missing",
        remedy="Put images and calibration back where they were, or leave subsets_px out.",
    )
