"""The measurement of a sequence, a step at a time: read, measure, smooth, mark, strain, write, summarise.

The worker and the command line both measure with it, so a folder measured through either gives the same files. A step
depends on the files alone: nothing is kept from the step before but the content of its file.
"""

from __future__ import annotations

import json
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import FileFormatError, MeasurementError, SeedError
from stereorig.core.field.checks.epipolar_offset import rows_not_together
from stereorig.core.field.points.images import MeasureImage, check_calibrated_size
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.lay_points import make_grid
from stereorig.core.field.seeding.image_faults import INTERLACED_PX, field_shift_px, unsure_error
from stereorig.core.field.seeding.seeds import seeds_of
from stereorig.core.field.sequence.joint import agree
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.measure import PreviousStep, ReferencePair, Updating
from stereorig.core.names import CAMERAS
from stereorig.core.progress import CancelToken, Progress
from stereorig.core.settings import StoredSettings
from stereorig.core.strain import StrainOptions
from stereorig.core.systematic.terms import with_strain
from stereorig.server.compute.beside import StepsBeside
from stereorig.server.compute.dense.steps import DenseStep, DenseSteps
from stereorig.server.compute.strain import strain_of_step, summarise_strain
from stereorig.server.compute.tasks import Earlier, StepImages, files_of
from stereorig.server.formats.calibrations.recognise import LoadedCalibration
from stereorig.server.formats.calibrations.volume import rbe_of
from stereorig.server.formats.files import make_folder, sha256_of, write_bytes
from stereorig.server.formats.images import GrayImage, read_image
from stereorig.server.formats.noise_json import LoadedNoise
from stereorig.server.formats.results.folder import dense_result
from stereorig.server.formats.results.reading import read_measured
from stereorig.server.formats.results.starts import starts_file, with_starts, write_starts
from stereorig.server.formats.results.summary import ROWS_APART, summarise, to_json
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.formats.version import software_version

Pair = tuple[MeasureImage, MeasureImage]


@dataclass(frozen=True, kw_only=True)
class FinishedStep:
    """A step whose file is written.

    Attributes
    ----------
    field
        As the file has it: smoothed if asked for, points outside the calibrated volume marked.
    summary
        The step's entry of ``summary.json``, without the time that its measurement took.
    """

    n: int
    field: Field
    summary: dict[str, Any]


@dataclass(eq=False)
class SequenceMeasurement:
    """The measurement of a sequence: the parts that its steps share, and the measuring and finishing of each.

    Parameters
    ----------
    calibration, settings
        The calibration, and the settings of the measurement.
    mask
        (rows, cols) True where points are allowed, or None.
    reference
        Step that the first comparison is made with.
    folder
        Result files go there, and are read from there.
    noise
        Models of both cameras.
    inputs
        Name and SHA-256 of further files that the result depends on.

    Raises
    ------
    ImageError, FileFormatError
        The reference's images cannot be used, or do not have the calibration's size.
    RegionError
        As :func:`make_grid`.
    """

    calibration: LoadedCalibration
    settings: StoredSettings
    mask: NDArray[np.bool_] | None
    reference: StepImages
    folder: Path
    noise: LoadedNoise | None = None
    inputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.options = MeasureOptions.of(self.settings)
        self.steps: dict[int, StepImages] = {}
        self._models = (None, None) if self.noise is None else self.noise.models
        self._rbe_px = rbe_of(self.calibration)
        self._fields: dict[Path, Field] = {}  # by the file that has it, or will have it
        self._previous: int | None = None
        self._from_head = False
        self._generation = 0
        self._last_images: tuple[int, Pair] | None = None
        self._interlaced: dict[int, str] = {}
        self._sequence: Updating | None = None
        self._watched: int | None = None  # the last step that the cameras' watch was given
        self._dense = DenseSteps(self.calibration.pair, self.options, self.settings.dense_step_px)
        images = self.read(self.reference)
        sizes = (self.calibration.image_size1_px, self.calibration.image_size2_px)
        for cam, image, size in zip(("cam1", "cam2"), images, sizes, strict=True):
            check_calibrated_size(f"The image of {cam}", image.shape, size)
        self.grid = make_grid(self.settings, self.mask, images[0].shape)
        self.pair = ReferencePair(self.calibration.pair, *images)
        own = self.pair.image1, self.pair.image2
        self._beside = StepsBeside(self.calibration, self.settings, self.options, self.reference.n, own)

    def forget_replaced(self, generation: int) -> None:
        """Forget fields of steps, and work begun on them, if their results have been replaced since."""
        if generation != self._generation:
            own = self.file_of(self.reference.n)
            self._fields = {path: f for path, f in self._fields.items() if path == own}
            self._sequence, self._generation, self._watched = None, generation, None

    def read(self, step: StepImages) -> Pair:
        """Read both images of a step; everything derived from them is computed on the calling thread."""
        return self.prepared(step, [read_image(path) for path in step.files])

    def prepared(self, step: StepImages, pixels: Sequence[GrayImage]) -> Pair:
        """Return both images of a step whose pixels were read, as :meth:`read` does."""
        one, two = (
            MeasureImage(grey, str(path), noise=None if model is None else model.averaged(*step.averages))
            for grey, path, model in zip(pixels, step.files, self._models, strict=True)
        )
        for image in (one, two):
            image.prepared(self.options.interpolation, None, self.options.blur)
            image.contrast()
        return one, two

    def measure(
        self,
        step: StepImages,
        images: Pair | None = None,
        *,
        previous: int | None = None,
        from_head: bool = False,
        against: int | None = None,
        progress: Progress | None = None,
        cancel: CancelToken | None = None,
    ) -> Field:
        """Measure a step: the reference's shape, or another step's displacement.

        Parameters
        ----------
        images
            The step's, if they were read already.
        previous
            The step measured before, whose field gives start values.
        from_head
            Take the previous step's field from its head, see :meth:`keep_head`.
        against
            Reference to match the step against from seeds, without a previous step.

        Raises
        ------
        SeedError
            No start was found.
        FileFormatError
            An earlier step's file is missing, or its images were replaced.
        MeasurementError
            ``nothing_measured``: no point passed the checks.
        Cancelled
            If the token was set.
        """
        more: dict[str, Any] = {"progress": progress, "cancel": cancel}
        seeds = seeds_of(self.settings)
        if seeds is not None:
            more["seeds"] = seeds
        self.steps[step.n], self._previous, self._from_head = step, previous, from_head
        if step.n == self.reference.n:
            own = self.pair.image1, self.pair.image2
            result = self._matched(step.n, own, lambda: self.pair.shape(self.grid, self.options, **more))
        else:
            shape = self._field(self.reference.n)
            previous_step = None
            if previous is not None and previous != self.reference.n:
                previous_step = PreviousStep(previous, self._field(previous))
            images = images or self.read(step)
            if against is not None:
                return self._matched(step.n, images, lambda: self._updating(shape).begin_at(images, against, **more))
            result = self._matched(step.n, images, lambda: self._updating(shape).measure(images, previous_step, **more))
            self._last_images = None if self.settings.reference_update == "never" else (step.n, images)
        self._beside.begin(
            step.n,
            result,
            images or (self.pair.image1, self.pair.image2),
            shape=result if step.n == self.reference.n else self._field(self.reference.n),
            previous=previous,
            before=self._unwatched(previous),
        )
        self._watched = step.n
        if self._dense.wanted:
            self._dense.measure(
                step.n,
                self._field(self.reference.n) if result.has_motion else result,
                result,
                (self.pair.image1, self.pair.image2, *(images or ())),
                self.grid,
            )
        self._keep(self.file_of(step.n), result)
        return result

    def _keep(self, file: Path, field: Field) -> None:
        """Keep a field, and the reference's, for the next step."""
        own = self.file_of(self.reference.n)
        self._fields = {path: f for path, f in self._fields.items() if path == own} | {file: field}

    def keep_head(self, step: StepImages, result: Field) -> None:
        """Write the field of a block's first step, which is measured again from the step before it.

        Raises
        ------
        StorageError
            ``storage_full`` or ``storage_failed``.
        """
        path = self.file_of(step.n, "head")
        if result.starts is not None:
            write_starts(starts_file(path), result, exact=self.settings.reference_update != "never")
        write_field(path, result, self._provenance(step, result, {}), None, checksum=False)
        self._keep(path, result)

    def agrees(self, step: StepImages, result: Field, earlier: Earlier) -> bool:
        """Return True if steps measured from the earlier result of a step remain valid, see :func:`agree`."""
        path = self.file_of(step.n, earlier)
        return path.exists() and agree(result, read_measured(path))

    def _unwatched(self, previous: int | None) -> tuple[Field, Pair] | None:
        """Field and images of the step before, where the cameras' watch was not given just these."""
        if previous is None or previous == self.reference.n or (previous == self._watched and not self._from_head):
            return None
        return self._field(previous), self._previous_images(previous)

    def _matched(self, n: int, images: Pair, measure: Callable[[], Field]) -> Field:
        """Return the measured field; if nothing matches, raise an error that names a camera that turned too far."""
        try:
            result = measure()
        except SeedError as error:
            self._beside.watch.refuse_moved(n, images, error)
            raise
        if not result.valid.any():
            self._beside.watch.refuse_moved(n, images)
            one, two = self.steps[n].files
            if result.unsure is not None:
                raise unsure_error(
                    f"step {n} ({one.name}, {two.name})",
                    self.pair.pair,
                    (self.pair.image1, self.pair.image2),
                    images if result.has_motion else (),
                    result.unsure,
                    subset_px=self.settings.subset_px,
                    region_px=self.grid.extent_px,
                )
            raise MeasurementError(
                f"No point of step {n} ({one.name}, {two.name}) could be measured.",
                code="nothing_measured",
                remedy="Check that both cameras see the same textured surface, in this order, and the region.",
            )
        rows = rows_not_together(result, self._rbe_px)
        if rows is not None:
            raise MeasurementError(
                f"Step {n} is not measured: {rows}.",
                code="rows_not_together",
                remedy="Take the images with a global shutter, with a flash, or of a specimen at rest.",
            )
        self._fields_of_rows(n, images)
        return result

    def _fields_of_rows(self, n: int, images: Pair) -> None:
        """Note where an image consists of two fields, whose rows alternate."""
        off = {k: abs(field_shift_px(image.pixels)) for k, image in enumerate(images, 1)}
        named = [f"of camera {k} are {px:.1f} px apart" for k, px in off.items() if px > INTERLACED_PX]
        if named:
            self._interlaced[n] = (
                f"every second row is of another moment, the rows {' and those '.join(named)}: interlaced images, "
                "whose measured values are between both moments; take whole frames"
            )

    def finish(
        self, step: StepImages, result: Field, *, about: Mapping[str, str], in_service: bool, keep_starts: bool = False
    ) -> FinishedStep:
        """Compute the strain of a measured step, after its smoothing and marking; write its file, and summarise it.

        Parameters
        ----------
        result
            As :meth:`measure` gave it.
        about
            Further text attributes of the file.
        in_service
            Write the file's SHA-256 and its summary too: after a kill, a step is complete or not there.
        keep_starts
            Write the matcher's own unknowns into a file next to it, for a process that continues from there.

        Raises
        ------
        StorageError
            ``storage_full`` or ``storage_failed``.
        """
        began = time.perf_counter()
        subset_px = self.settings.subset_px
        begun = self._beside.take(step.n)
        shown, lines = begun.shown.result()
        strain = strain_of_step(shown, StrainOptions.of(self.settings.strain), subset_px=subset_px)
        path = self.file_of(step.n)
        judged = begun.judged.result()
        systematic = with_strain(judged.terms, shown, strain, subset_px=subset_px).document()
        about = {**about, "systematic": json.dumps(systematic, sort_keys=True)}
        rows_apart = self._interlaced.pop(step.n, "")
        if rows_apart:
            about[ROWS_APART] = rows_apart
        summary = {
            "n": step.n,
            "step": step.n,
            "file": path.name,
            **summarise(
                shown,
                rbe_px=self._rbe_px,
                reference=self.reference.n,
                imported=self.calibration.imported,
                camera_motion=judged.motion,
                systematic=systematic,
                rows_apart=rows_apart,
            ).document(),
            "strain": None if strain is None else summarise_strain(strain, shown).document(),
        }
        dense = self._dense.take(step.n)
        if dense is not None:
            summary["dense"] = self._finish_dense(step, dense, about, systematic, in_service=in_service)
        if lines is not None:
            summary["sensor_pattern"] = lines.document()
            about = {**about, "sensor_pattern": json.dumps(summary["sensor_pattern"], sort_keys=True)}
        greys = {cam: made for cam, made in zip(CAMERAS, step.grey_from, strict=True) if made is not None}
        if greys:
            summary["grey_from"] = greys
            about = {**about, **{f"{cam}_grey_from": made for cam, made in greys.items()}}
        if in_service:  # first: where the result is, they are
            write_bytes(path.with_suffix(".json"), to_json(summary))
            if result.starts is not None and keep_starts:
                exact = step.n == self.reference.n or self.settings.reference_update != "never"
                write_starts(starts_file(path), result, exact=exact)
        write_field(path, shown, self._provenance(step, result, about), strain, measured=result, checksum=in_service)
        return FinishedStep(
            n=step.n, field=shown, summary={**summary, "write_s": round(time.perf_counter() - began, 3)}
        )

    def _finish_dense(
        self,
        step: StepImages,
        dense: DenseStep,
        about: Mapping[str, str],
        systematic: Mapping[str, Any],
        *,
        in_service: bool,
    ) -> dict[str, Any]:
        """Write the dense field of a step, before the step's own file; return its entry of the summary."""
        if dense.field is None:
            return dense.entry(None, None)
        shown = self._beside.show_dense(dense.field)
        path = dense_result(self.file_of(step.n))
        make_folder(path.parent)
        # interpolation acts the same on both; the ordinary patches' own terms are not a dense field's
        terms = {"interpolation": systematic["interpolation"], "patch_order": None, "strain_window": None}
        more = {**about, "systematic": json.dumps(terms)}
        provenance = self._provenance(step, dense.field, more)
        settings = {**provenance.settings, "spacing_px": self.settings.dense_step_px, "strain": None}
        write_field(path, shown, replace(provenance, settings=settings), checksum=in_service)
        return dense.entry(shown, f"{path.parent.name}/{path.name}")

    def file_of(self, n: int, kind: Earlier = "step") -> Path:
        """Return the path of a step's result, or of its head."""
        return self.folder / files_of(n, kind)[0]

    def _updating(self, shape: Field) -> Updating:
        if self._sequence is None:
            own = weakref.proxy(self)  # no circle: dropped objects, images above all, are to be freed at once
            self._sequence = self.pair.sequence(
                shape,
                self.grid,
                self.options,
                reference_update=self.settings.reference_update,
                first=self.reference.n,
                images_of=lambda n: own._previous_images(n),
                field_of=lambda n: own._field(n),
            )
        return self._sequence

    def _previous_images(self, n: int) -> Pair:
        """Images of an earlier step: the last step's are still here, others are read and checked again."""
        if self._last_images is not None and self._last_images[0] == n:
            return self._last_images[1]
        step = self.steps[n]
        for path, recorded in zip(step.files, step.sha256, strict=True):
            if sha256_of(path) != recorded:
                raise FileFormatError(
                    f"{path} does not match the checksum in its step.json.",
                    code="checksum_mismatch",
                    remedy="Restore the file, or start the analysis again.",
                )
        return self.read(step)

    def _field(self, n: int) -> Field:
        """Field of an earlier step as it was measured: before smoothing, and without the calibration's own error.

        Later steps propagate the noise of its images; the calibration's error is added once, to the total.
        """
        path = self.file_of(n, "head" if self._from_head and n == self._previous else "step")
        if path not in self._fields:
            known = n in (self.reference.n, self._previous)
            if not path.exists():
                raise FileFormatError(
                    f"The result of step {n} is missing.", code="file_missing", remedy="Start the analysis again."
                )
            measured = read_measured(path)
            if known:  # of others a file of start values may just be there still
                measured = with_starts(measured, starts_file(path))
            if n != self.reference.n:
                return measured
            self._fields[path] = measured
        return self._fields[path]

    def _provenance(self, step: StepImages, result: Field, about: Mapping[str, str]) -> Provenance:
        inputs = {"calibration": self.calibration.sha256, **self.inputs}
        if self.noise is not None:
            inputs["noise"] = self.noise.sha256
        shown = {"reference": self.reference, "": step}
        if result.references is not None:
            shown["matched"] = self.steps[result.references.step]
        for name, images in shown.items():
            for cam, sha256 in zip(("cam1", "cam2"), images.sha256, strict=True):
                inputs[f"{name}_{cam}" if name else cam] = sha256
        return Provenance(
            settings=self.settings.model_dump(),
            inputs=inputs,
            software_version=software_version(),
            step=step.n,
            reference=self.reference.n,
            frame="target" if self.calibration.source == "calibration_json" else "camera1",
            extra=about,
        )
