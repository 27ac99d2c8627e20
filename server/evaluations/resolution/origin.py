"""The images and the calibration that results were made from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pydantic import ValidationError

from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.core.settings import StoredSettings
from stereorig.server.documents.tests import SummaryRecord
from stereorig.server.evaluations.door import Results
from stereorig.server.formats.calibrations.in_test import calibration_in
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration
from stereorig.server.formats.images import GrayImage, read_image
from stereorig.server.formats.manifest import known_sha256
from stereorig.server.formats.results.folder import home_of
from stereorig.server.store.durable import known_record

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
        if self.test is not None:
            candidates.insert(0, calibration_in(self.test, sha256))
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
    def test(self) -> Path | None:
        """The test's folder; None for results outside a test."""
        home = home_of(self.results.file(self.step)).absolute().parent.parent
        return home if (home / "steps").is_dir() else None

    def _images(self, step: int, sha256: dict[str, str], prefix: str) -> Images:
        one, two = (self._image(step, cam, sha256.get(f"{prefix}{cam}")) for cam in CAMERAS)
        return one, two

    def _image(self, step: int, cam: CameraName, sha256: str | None) -> GrayImage:
        candidates = [] if self.test is None else [self.test / "steps" / f"{step:04d}" / f"{cam}.tif"]
        if step in self.results.steps and self.results.head(step).image_file(cam):
            named = Path(self.results.head(step).image_file(cam))
            candidates += [named, self.results.file(step).parent / named.name]
        for path in candidates:
            if path.is_file() and sha256 is not None and known_sha256(path) == sha256:
                return read_image(path)
        raise _missing(f"The image of {cam} at step {step} is not at hand, or was replaced")


def _missing(why: str) -> InputError:
    return InputError(
        f"{why}.",
        code="images_missing",
        remedy="Put images and calibration back where they were, or leave subsets_px out.",
    )
