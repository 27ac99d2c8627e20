"""Shape and motion measured from images in memory, a step at a time, as the service measures them."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import InputError
from stereorig.core.field.checks.unreached import mark_extrapolated
from stereorig.core.field.common import with_common_parts
from stereorig.core.field.points.images import MeasureImage, check_calibrated_size
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.lay_points import make_grid
from stereorig.core.field.seeding.seeds import seeds_of
from stereorig.core.field.sequence.reference_steps import PreviousStep
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.field.smoothed import smoothed_displacement
from stereorig.core.measure import ReferencePair
from stereorig.core.settings import AnalysisSettings
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.core.systematic.sensor_pull import fixed_lines
from stereorig.parameters import MeasurementParameters
from stereorig.result import Result
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration
from stereorig.server.formats.calibrations.volume import parameter_covariance, volume_of
from stereorig.server.formats.noise_json import LoadedNoise

Image = NDArray[np.generic]


class Measurement:
    """A sequence that is measured against its first image pair.

    Parameters
    ----------
    calibration
        As :func:`stereorig.read_calibration` gives it, or the path of a file.
    image1, image2
        (rows, cols) camera 1's and camera 2's reference image, 8 or 16 bit.
    settings
        All parameters; or give them by name, as ``subset_px=33``: see :class:`stereorig.AnalysisSettings`.
    roi
        Rectangle x0, y0, x1, y1 in camera 1's reference image, px; short for ``region={"rectangle": roi}``.
    mask
        (rows, cols) True at allowed pixels.
    noise
        Noise models of the cameras.

    Raises
    ------
    StereorigError
        Images of another size than the calibration's; a region that leaves nothing to measure.
    """

    def __init__(
        self,
        calibration: LoadedCalibration | str | Path,
        image1: Image,
        image2: Image,
        settings: AnalysisSettings | None = None,
        *,
        roi: tuple[float, float, float, float] | None = None,
        mask: NDArray[np.bool_] | None = None,
        noise: LoadedNoise | None = None,
        **parameters: Unpack[MeasurementParameters],
    ) -> None:
        if isinstance(calibration, str | Path):
            calibration = load_calibration(calibration)
        if settings is not None and (parameters or roi is not None):
            raise InputError("settings are given twice.", remedy="Give `settings`, or parameters by their names.")
        if settings is None:
            if roi is not None:
                parameters["region"] = {"rectangle": roi}
            parameters.setdefault("region", {})
            settings = AnalysisSettings.model_validate(parameters)
        self.calibration, self.settings = calibration, settings
        self._noise = (None, None) if noise is None else noise.models
        self._options = MeasureOptions.of(settings)
        one, two = self._prepared(image1, image2, "the reference image")
        for cam, image, size in (("cam1", one, calibration.image_size1_px), ("cam2", two, calibration.image_size2_px)):
            check_calibrated_size(f"The image of {cam}", image.shape, size)
        self._grid = make_grid(settings, mask, one.shape)
        self._reference = ReferencePair(calibration.pair, one, two)
        self._images: list[tuple[Image, Image]] = [(image1, image2)]
        self._fields: list[Field] = []

    @cached_property
    def shape(self) -> Result:
        """The reference's shape."""
        return self._result(0, self._shape)

    def displacement(self, image1: Image, image2: Image) -> Result:
        """Measure the next step: the displacement since the reference, three comparisons at once.

        Start values come from the step measured before. If the first reference no longer matches, a later step takes
        its part (``reference_update``), for which the images of all steps are kept; displacements stay totals.

        Parameters
        ----------
        image1, image2
            (rows, cols) camera 1's and camera 2's current image.

        Raises
        ------
        StereorigError
            ``image_shape``, ``not_seeded`` and others; the step can then be left out.
        """
        shape = self._shape
        n = len(self._images)
        images = self._prepared(image1, image2, f"step {n}")
        previous = PreviousStep(n - 1, self._fields[n - 1]) if n > 1 else None
        field = self._steps.measure(images, previous, seeds=seeds_of(self.settings))
        self._images.append((image1, image2) if self.settings.reference_update != "never" else (shape.x_px,) * 2)
        self._fields.append(field)
        kind, blur = self._options.interpolation, self._options.blur
        first, now = (image.prepared(kind, None, blur) for image in (self._reference.image1, images[0]))
        lines = fixed_lines(field, self.calibration.pair, first, now, subset_px=self.settings.subset_px)
        return self._result(n, field, None if lines is None else lines.pull_mm)

    @cached_property
    def _shape(self) -> Field:
        shape = self._reference.shape(self._grid, self._options, seeds=seeds_of(self.settings))
        self._fields.append(shape)
        return shape

    @cached_property
    def _steps(self) -> Any:
        return self._reference.sequence(
            self._shape,
            self._grid,
            self._options,
            reference_update=self.settings.reference_update,
            images_of=lambda n: self._prepared(*self._images[n], f"step {n}"),
            field_of=lambda n: self._fields[n],
        )

    def _prepared(self, image1: Image, image2: Image, name: str) -> tuple[MeasureImage, MeasureImage]:
        one, two = (
            MeasureImage(image, f"{cam}, {name}", noise=model)
            for cam, image, model in zip(("camera 1", "camera 2"), (image1, image2), self._noise, strict=True)
        )
        return one, two

    def _result(self, n: int, measured: Field, pull: NDArray[np.float64] | None = None) -> Result:
        settings = self.settings
        field, strain = measured, None
        if settings.smoothing_window and field.has_motion:
            field = smoothed_displacement(field, settings.smoothing_window, subset_px=settings.subset_px)
        field = mark_extrapolated(field, volume_of(self.calibration))
        field = with_common_parts(field, parameter_covariance(self.calibration), self.calibration.pair, pull)
        options = StrainOptions.of(settings.strain)
        if options is not None and field.has_motion:
            strain = surface_strain(field, options, subset_px=settings.subset_px)
        frame = "target" if self.calibration.source == "calibration_json" else "camera1"
        return Result(field, strain, settings, step=n, frame=frame, calibration_sha256=self.calibration.sha256)
