"""The measurement of a sequence of pairs: one file a step, a summary at the end.

While a step is measured, the next pair is read and the last result is written; no more than these are in memory.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from core.compiling import COMPILING, told_when_compiling
from core.errors import MeasurementError
from core.field.checks.extrapolated import mark_extrapolated
from core.field.points.images import MeasureImage
from core.field.points.patch import PatchSetting
from core.field.points.result import Field
from core.field.reference_update import DEFAULT_REFERENCE_UPDATE, ReferenceUpdate
from core.strain import StrainOptions
from server.cli.measurement.image_lists import ImagePair
from server.cli.measurement.region import RegionRequest
from server.cli.terminal import ProgressLine, duration
from server.compute.compile_aside import CompileAside
from server.compute.overlap import ReadAhead, WriteBehind
from server.compute.strain import smoothed_step, smoothing_note, strain_of_step, strain_settings, summarise_strain
from server.formats.calibrations.recognise import LoadedCalibration
from server.formats.calibrations.volume import rbe_of, volume_of
from server.formats.files import make_folder, sha256_of, write_bytes
from server.formats.images import read_image
from server.formats.noise_json import LoadedNoise
from server.formats.results.reading import read_measured
from server.formats.results.summary import summarise, to_json
from server.formats.results.writing import Provenance, write_field
from server.formats.version import software_version

if TYPE_CHECKING:
    from core import measure

_LEAST_OF_STATED, _MOST_OF_STATED = 0.75, 1.5  # residuals hold interpolation error besides noise, never less
_SEEDS_SHARE = 0.15  # of a step's time, as a rule
_RESULT = re.compile(r"step_\d{4}\.nc")


def _strain_noise(strain: dict[str, Any] | None) -> str:
    """What a step's line says of its strain."""
    if strain is None:
        return ""
    if strain["points"] == 0:
        return f"no strain (no window of {strain['window']} points is whole enough), "
    floor = strain["noise_floor_microstrain"]["exx"]
    return f"strain noise {floor:.0f} microstrain over {strain['gauge_mm']:.3g} mm, "


@dataclass(frozen=True)
class CheckedPair:
    """One step's files and the hashes of what was found in them."""

    files: ImagePair
    sha256: tuple[str, str]


@dataclass(frozen=True, kw_only=True)
class MeasureJob:
    """Everything that ``stereorig measure`` was asked to do, checked."""

    calibration: LoadedCalibration
    calibration_file: Path
    pairs: list[CheckedPair]
    region: RegionRequest
    subset_px: int
    step_px: int
    patch: PatchSetting
    interpolation: Literal["cubic", "quintic"]
    mask_file: Path | None
    out: Path
    noise: LoadedNoise | None = None
    strain: StrainOptions | None = None
    prefilter_px: float = 0.0
    reference_update: ReferenceUpdate = DEFAULT_REFERENCE_UPDATE
    smoothing_window: int | None = None

    def settings(self) -> dict[str, Any]:
        """Return what the result depends on besides its inputs."""
        seeds = self.region.seeds
        return {
            "roi": list(self.region.rectangle_px),
            "subset_px": self.subset_px,
            "step_px": self.step_px,
            "patch": self.patch,
            "interpolation": self.interpolation,
            "seeds": None if seeds is None else [list(seed.xy_px) for seed in seeds],
            "seeds_cam2": None if seeds is None else [None if s.xy2_px is None else list(s.xy2_px) for s in seeds],
            "cracks": list(self.region.cracks_px),
            "holes": list(self.region.holes_px),
            "mask": None if self.mask_file is None else str(self.mask_file),
            "noise": None if self.noise is None else self.noise.record(),
            "prefilter_px": self.prefilter_px,
            "smoothing_window": self.smoothing_window,
            "reference_update": self.reference_update,
            "strain": strain_settings(self.strain),
        }


def measure_sequence(job: MeasureJob, progress: ProgressLine) -> dict[str, Any]:
    """Measure every step; write the results and ``summary.json``; return the summary.

    Raises
    ------
    StereorigError
        As the measurement raises them. Results of steps that were finished before stay; no summary is written.
    """
    started = time.monotonic()

    def on_compiling() -> None:
        progress.note(f"{COMPILING} ...")
        if len(job.pairs) > 1:
            aside.start()

    with (
        _output_folder(job.out),
        CompileAside(job.patch) as aside,
        told_when_compiling(on_compiling),
        WriteBehind[dict[str, Any]]() as written,
    ):
        runner = _Runner(job, progress, written)
        with ReadAhead(runner.read, job.pairs[1:]) as pairs:
            runner.measure(None)
            aside.wait()
            for images in pairs:
                runner.measure(images)
        steps = written.finish()
    seconds = round(time.monotonic() - started, 3)
    summary = {
        "software_version": software_version(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "calibration": {
            "file": str(job.calibration_file),
            "sha256": job.calibration.sha256,
            "source": job.calibration.source,
        },
        "settings": job.settings(),
        "seconds": seconds,
        "steps": steps,
    }
    write_bytes(job.out / "summary.json", to_json(summary))
    progress.note(f"{len(steps)} steps in {duration(seconds)}: {job.out / 'summary.json'}")
    return summary


@contextlib.contextmanager
def _output_folder(out: Path) -> Iterator[None]:
    """Make the output folder before hours of work, and take it away again if nothing came into it."""
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    make_folder(out)
    try:
        yield
    except BaseException:
        for folder in made:
            if next(folder.iterdir(), None) is not None:
                break
            folder.rmdir()
        raise


class _Runner:
    """Measures the steps in order; keeps the reference, its shape and the last field, whatever the number of steps."""

    def __init__(self, job: MeasureJob, progress: ProgressLine, written: WriteBehind[dict[str, Any]]) -> None:
        # the kernels' modules take seconds to load: after the input was checked is early enough
        from core import measure

        self._job = job
        self._progress = progress
        self._written = written
        self._options = measure.MeasureOptions(
            subset_px=job.subset_px,
            patch=job.patch,
            interpolation=job.interpolation,
            prefilter_px=job.prefilter_px,
            noise=(None, None) if job.noise is None else job.noise.models,
        )
        self._reference = measure.ReferencePair(job.calibration.pair, *self.read(job.pairs[0]))
        self._volume, self._rbe_px = volume_of(job.calibration), rbe_of(job.calibration)
        self._n = 0
        self._shape: Field | None = None
        self._sequence: measure.Updating | None = None
        self._last: measure.Earlier | None = None
        self._last_images: tuple[MeasureImage, MeasureImage] | None = None
        self._matched = 0
        self._chosen: tuple[str, bool] | None = None
        self._checked = "ok"
        self._told_smoothing = False
        self._done = 0.0

    def read(self, pair: CheckedPair) -> tuple[MeasureImage, MeasureImage]:
        """Read both images of a step; what will be asked of them is found on this thread."""
        one, two = (MeasureImage(read_image(path), str(path)) for path in (pair.files.cam1, pair.files.cam2))
        for image, noise in zip((one, two), self._options.noise, strict=True):
            image.prepared(self._options.interpolation, noise, self._options.blur)
            image.contrast()
        return one, two

    def measure(self, images: tuple[MeasureImage, MeasureImage] | None) -> None:
        """Measure the next step, the reference's shape first (no images), and have its file written."""
        started = time.monotonic()
        n, region = self._n, self._job.region
        if images is None:
            result = self._shape = self._reference.shape(
                region.grid, self._options, seeds=region.seeds, progress=self._shower(n)
            )
        else:
            result = self._motion(n, images)
        if not result.valid.any():
            files = self._job.pairs[n].files
            raise MeasurementError(
                f"No point of step {n} ({files.cam1.name}, {files.cam2.name}) could be measured.",
                code="nothing_measured",
                remedy="Check that both cameras see the same textured surface, in this order, and the region.",
            )
        if n == 0:
            self._remove_older()
            self._doubt_noise(result)
        self._written.put(self._write, n, result, started)
        self._n += 1

    def _motion(self, n: int, images: tuple[MeasureImage, MeasureImage]) -> Field:
        """Measure a step's displacement; keep what the next one may be matched against."""
        from core.measure import Earlier

        region, update = self._job.region, self._job.reference_update
        assert self._shape is not None
        if self._sequence is None:
            self._sequence = self._reference.sequence(
                self._shape,
                region.grid,
                self._options,
                reference_update=update,
                images_of=self._images_of,
                field_of=self._field_of,
                first=self._number(0),
            )
        result = self._sequence.measure(images, self._last, seeds=region.seeds, progress=self._shower(n))
        self._last = Earlier(self._number(n), result)
        self._last_images = None if update == "never" else images
        return result

    def _index(self, number: int) -> int:
        """Which of the pairs has a number."""
        return next(k for k in range(len(self._job.pairs)) if self._number(k) == number)

    def _images_of(self, number: int) -> tuple[MeasureImage, MeasureImage]:
        if self._last is not None and self._last.step == number and self._last_images is not None:
            return self._last_images
        return self.read(self._job.pairs[self._index(number)])

    def _field_of(self, number: int) -> Field:
        """An earlier step's field as its file has it; the last one's may still be on its way to the disk."""
        if self._last is not None and self._last.step == number:
            return mark_extrapolated(self._last.field, self._volume)
        return read_measured(self._job.out / f"step_{number:04d}.nc")

    def _write(self, n: int, result: Field, started: float) -> dict[str, Any]:
        """Write the file of a step, say so, return its summary."""
        pair, measured = self._job.pairs[n], result
        result = smoothed_step(result, self._job.smoothing_window, subset_px=self._job.subset_px)
        result = mark_extrapolated(result, self._volume)
        number = self._number(n)
        name = f"step_{number:04d}.nc"
        strain = strain_of_step(result, self._job.strain, subset_px=self._job.subset_px)
        write_field(self._job.out / name, result, self._provenance(n, result), strain, measured=measured)
        summary = {
            "step": number,
            "file": name,
            "cam1": str(pair.files.cam1),
            "cam2": str(pair.files.cam2),
            "sha256": {"cam1": pair.sha256[0], "cam2": pair.sha256[1]},
            **summarise(result, rbe_px=self._rbe_px, reference=self._number(0)).document(),
            "strain": None if strain is None else summarise_strain(strain).document(),
            "seconds": round(time.monotonic() - started, 3),
        }
        rms = summary["epipolar_residual_rms_px"]
        residual = "" if rms is None else f"epipolar residual {rms:.3f} px, "
        self._progress.note(
            f"step {n} of {len(self._job.pairs) - 1}: {summary['valid']} of {summary['points']} points, "
            f"{residual}{_strain_noise(summary['strain'])}{duration(summary['seconds'])}"
        )
        self._say_choice(n, result)
        self._say_reference(n, result)
        self._say_smoothing(result, summary["strain"])
        check = summary["epipolar_check"]
        if check is not None and check["level"] != self._checked:
            self._checked = check["level"]
            self._progress.note(f"{check['level']}: step {n}: {check['reason']}")
        return summary

    def _say_smoothing(self, result: Field, strain: dict[str, Any] | None) -> None:
        """Say once what smoothing leaves to be told apart."""
        if result.smoothing is None or self._told_smoothing:
            return
        self._told_smoothing = True
        gauge = (None, None) if strain is None else (strain["gauge_px"], strain["window"])
        self._progress.note(f"note: {smoothing_note(result.smoothing, gauge[0], strain_window=gauge[1])}")

    def _number(self, n: int) -> int:
        """The n-th pair's number: in a test's folder, where an incomplete step is left out, its own."""
        number = self._job.pairs[n].files.number
        return n if number is None else number

    def _say_choice(self, n: int, result: Field) -> None:
        """Say what the patch was chosen for: of the shape, of the first step, and where it changes."""
        choice = result.patch
        if choice is None:
            return
        new = (choice.patch, choice.curved_advised)
        if (choice.asked == "auto" and n <= 1) or (new != self._chosen and (choice.asked == "auto" or new[1])):
            self._progress.note(f"{'shape' if n == 0 else f'step {n}'}: {choice.reason}")
        if n > 0:
            self._chosen = new

    def _say_reference(self, n: int, result: Field) -> None:
        """Say where another reference took over."""
        matched = self._number(0) if result.references is None else result.references.step
        if n > 1 and matched != self._matched and self._job.reference_update == "auto":
            self._progress.note(f"step {n}: step {self._matched} no longer serves as reference, step {matched} does")
        self._matched = matched

    def _shower(self, n: int) -> Any:
        count = len(self._job.pairs)

        def show(stage: str, done: int, total: int) -> None:
            share = done / total if total > 0 else 0.0
            part = _SEEDS_SHARE * share if stage == "seeds" else _SEEDS_SHARE + (1.0 - _SEEDS_SHARE) * share
            self._done = max(self._done, (n + part) / count)
            self._progress.show(f"step {n} of {count - 1}: {stage}", self._done)

        return show

    def _provenance(self, n: int, result: Field) -> Provenance:
        job, first, now = self._job, self._job.pairs[0], self._job.pairs[n]
        inputs = {
            "calibration": job.calibration.sha256,
            "reference_cam1": first.sha256[0],
            "reference_cam2": first.sha256[1],
            "cam1": now.sha256[0],
            "cam2": now.sha256[1],
        }
        if result.references is not None:
            matched = job.pairs[self._index(result.references.step)]
            inputs["matched_cam1"], inputs["matched_cam2"] = matched.sha256
        if job.mask_file is not None:
            inputs["mask"] = sha256_of(job.mask_file)
        if job.noise is not None:
            inputs["noise"] = job.noise.sha256
        return Provenance(
            settings=job.settings(),
            inputs=inputs,
            software_version=software_version(),
            step=self._number(n),
            reference=self._number(0),
            frame="target" if job.calibration.source == "calibration_json" else "camera1",
            extra={"cam1_file": str(now.files.cam1), "cam2_file": str(now.files.cam2)},
        )

    def _doubt_noise(self, shape: Field) -> None:
        """Say so where the residuals and the noise file tell different stories."""
        model = self._options.noise[0]
        image = self._reference.image1.prepared(self._options.interpolation, model, self._options.blur)
        stated = image.noise_variance
        if stated is None:
            return
        found, expected = float(np.nanmedian(shape.noise_grey)), float(np.sqrt(stated))
        if not _LEAST_OF_STATED < found / expected < _MOST_OF_STATED:
            self._progress.note(
                f"note: residuals show a noise of {found:.2f} grey levels, the noise file says {expected:.2f}; "
                "was it measured with these cameras' gain?"
            )

    def _remove_older(self) -> None:
        """Remove an earlier run's results: more steps than now, or its summary, would pass for this one's."""
        for path in self._job.out.iterdir():
            if path.name == "summary.json" or _RESULT.fullmatch(path.name):
                path.unlink()
