"""The measurement of a sequence of pairs: one file a step, a summary at the end.

While a step is measured, the next pair is read and the last result is written; no more than these are in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereorig.core.compiling import COMPILING, report_compiling
from stereorig.core.errors import Cancelled, StereorigError, StorageError
from stereorig.core.field.points.result import Field
from stereorig.core.names import CAMERAS
from stereorig.core.settings import StoredSettings
from stereorig.server.base.problem import problem_of
from stereorig.server.cli.measurement.image_lists import ImagePair
from stereorig.server.cli.measurement.image_pairs import number_of, read_pair
from stereorig.server.cli.terminal import ProgressLine, duration
from stereorig.server.compute.background_compilation import BackgroundCompilation
from stereorig.server.compute.overlap import ReadAhead, WriteBehind
from stereorig.server.compute.strain import smoothing_note
from stereorig.server.compute.tasks import StepImages
from stereorig.server.formats.calibrations.recognise import LoadedCalibration
from stereorig.server.formats.files import make_folder, sha256_of, write_bytes
from stereorig.server.formats.images import encode_png, read_mask
from stereorig.server.formats.noise_json import LoadedNoise
from stereorig.server.formats.results.folder import DENSE, results_in
from stereorig.server.formats.results.summary import SequenceSummary, region_found, to_json
from stereorig.server.formats.results.uncertainty import NOT_INCLUDED
from stereorig.server.formats.version import software_version
from stereorig.server.results.images.quality import SATURATED_SHARE, saturation_text

if TYPE_CHECKING:
    from stereorig.core.field.seeding.specimen import Specimen
    from stereorig.server.compute.sequence import Pair, SequenceMeasurement
    from stereorig.server.results.gauges.request import GaugeRequest

_MIN_OF_STATED, _MAX_OF_STATED = 0.75, 1.5  # residuals hold noise and interpolation error, never less than noise
_SEEDS_SHARE = 0.15  # of a step's time, as a rule
_RESULT = re.compile(r"step_[0-9]{4}\.nc")


def _camera_offset(motion: dict[str, Any] | None) -> str:
    """Return the finding about the cameras from the step's epipolar offset, for its line."""
    found = None if motion is None else motion["reference"] or motion["calibration"]
    if found is None:
        return ""
    since = "the reference" if found["against"] == "reference" else "the calibration"
    moved = {True: "a camera moved", False: "no camera moved", None: "not judged"}[found["camera_moved"]]
    return f"offset {found['offset_rms_px']:.3f} px since {since} ({found['sigmas']:.1f} sigma, {moved}), "


def _strain_noise(strain: dict[str, Any] | None) -> str:
    """Return the part of a step's line on its strain."""
    if strain is None:
        return ""
    if strain["points"] == 0:
        return f"no strain (no window of {strain['window']} points is whole enough), "
    floor = strain["noise_floor_microstrain"]["exx"]
    return f"strain noise {floor:.0f} microstrain over {strain['gauge_mm']:.3g} mm, "


def _uncertainty(summary: Mapping[str, Any]) -> str:
    """Return the line on a step's uncertainty: medians over its points, by cause."""
    parts = []
    for name in ("z_mm", "w_mm"):
        sigma, causes = summary["sigma_median_mm"].get(name), summary["budget_median_mm"].get(name)
        if sigma is not None and causes:
            each = ", ".join(f"{cause} {1e3 * part:.2g}" for cause, part in causes.items())
            parts.append(f"{name[0].upper()} {1e3 * sigma:.2g} um ({each})")
    lacking = "" if summary["sigma_calibration_median_mm"] else f"; {NOT_INCLUDED}"
    return f"u (k = 1) of step {summary['n']}, medians: {'; '.join(parts)}{lacking}"


@dataclass(frozen=True, kw_only=True)
class MeasureJob:
    """Everything that ``stereorig measure`` was asked to do, checked.

    ``steps`` are the checked ones, the reference first; ``failed`` has the errors of the others. ``later`` pairs, with
    their places in the series, are read and checked in their turn; ``shapes`` are the sizes that they must have.
    ``specimen`` was found if no region was given; its mask is then to be written to ``mask_file``.
    ``gauges`` are the recipe's: they are stored with the results, and the report reads them. ``carried`` is the
    calibration to be written to ``calibration_file``, if its own file does not hold all of it.
    """

    calibration: LoadedCalibration
    calibration_file: Path
    steps: list[StepImages]
    later: list[tuple[int, ImagePair]]
    shapes: tuple[tuple[int, int], tuple[int, int]]
    settings: StoredSettings
    mask_file: Path | None
    out: Path
    noise: LoadedNoise | None = None
    failed: Mapping[int, StereorigError] = field(default_factory=dict)
    specimen: Specimen | None = None
    gauges: GaugeRequest | None = None
    carried: bytes | None = None

    @property
    def last(self) -> int:
        """Number of the last step, measured or not."""
        return max(self.steps[-1].n, *(number_of(pair, k) for k, pair in self.later), *self.failed, 0)


def measure_sequence(job: MeasureJob, progress: ProgressLine) -> dict[str, Any]:
    """Measure every step that can be; write the results and ``summary.json``; return the summary.

    A step that fails does not take the others with it: its problem is in the summary, and the next step is measured
    from the last good one.

    Raises
    ------
    StereorigError
        The reference's, and then nothing is written; one that ends the whole measurement, such as a full disk; and the
        first step's if none but the reference could be measured. Results of finished steps stay, and the summary
        has the error that stopped the others.
    """
    started = time.monotonic()

    def on_compiling() -> None:
        progress.note(f"{COMPILING} ...")
        if job.later or len(job.steps) > 1:
            compilation.start()

    with (
        _output_folder(job.out),
        BackgroundCompilation(job.settings.patch) as compilation,
        report_compiling(on_compiling),
    ):
        written: list[dict[str, Any]] = []
        runner = _Runner(job, progress)
        try:
            written = _measure_all(runner, job, compilation)
            error = runner.nothing_measured()
            if error is not None and not runner.begun:
                raise error  # an earlier run's results stay as they are
        except (StereorigError, KeyboardInterrupt) as stopped:
            if runner.begun:
                with contextlib.suppress(StorageError):
                    _write_summary(runner, time.monotonic() - started, stopped)
            raise
        seconds = round(time.monotonic() - started, 3)
        summary = _write_summary(runner, seconds, error)
    failed = f", {len(runner.failed)} failed" if runner.failed else ""
    if written and written[-1]["valid"]:
        progress.note(_uncertainty(written[-1]))
    progress.note(f"{len(written)} steps in {duration(seconds)}{failed}: {job.out / 'summary.json'}")
    if error is not None:
        raise error
    return summary


def _measure_all(runner: _Runner, job: MeasureJob, compilation: BackgroundCompilation) -> list[dict[str, Any]]:
    """Measure the steps in order; return the summaries of those that are written."""
    with WriteBehind[dict[str, Any]]() as writer:
        runner.writer = writer
        if job.settings.pattern == "projected":
            for step in job.steps:
                runner.measure(step)
        else:
            runner.begin(job.steps[0])
            with ReadAhead(runner.read, job.later) as read:
                runner.measure(job.steps[0])
                compilation.wait()
                for k, pair in job.later:
                    runner.measure_later(k, pair, read)
        return writer.finish()


def _write_summary(runner: _Runner, seconds: float, error: BaseException | None) -> dict[str, Any]:
    """Write ``summary.json`` with the measured and the failed steps."""
    job = runner.job
    summary = SequenceSummary(
        state=_state_after(error),
        software_version=software_version(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        calibration={
            "file": str(job.calibration_file),
            "sha256": job.calibration.sha256,
            "source": job.calibration.source,
        },
        settings=job.settings.model_dump(),
        seconds=round(seconds, 3),
        steps=runner.summaries,
        steps_failed={str(n): problem_of(runner.failed[n]).plain() for n in sorted(runner.failed)},
        region_found=None if job.specimen is None else region_found(job.specimen),
    ).document()
    if job.gauges is not None:
        summary["gauges"] = job.gauges.model_dump(mode="json", exclude_none=True)
    summary["problem"] = problem_of(error).plain() if isinstance(error, StereorigError) else None
    write_bytes(job.out / "summary.json", to_json(summary))
    return summary


def _state_after(error: BaseException | None) -> str:
    if error is None:
        return "succeeded"
    if isinstance(error, Cancelled):
        return "cancelled"
    return "failed" if isinstance(error, StereorigError) else "interrupted"


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
    """Measures the steps in order, and prints a line for each on the terminal."""

    def __init__(self, job: MeasureJob, progress: ProgressLine) -> None:
        self.job = job
        #: errors by step, of the files too
        self.failed: dict[int, StereorigError] = dict(job.failed)
        #: of the steps that are written, in their order
        self.summaries: list[dict[str, Any]] = []
        #: True once the reference is measured, and the folder holds this run's results
        self.begun = False
        self.writer: WriteBehind[dict[str, Any]]
        self.sequence: SequenceMeasurement
        self._progress = progress
        self._previous: int | None = None  # the last good step after the reference
        self._matched = job.steps[0].n
        self._chosen: tuple[str, bool] | None = None
        self._checked = "ok"
        self._moved: bool | None = False
        self._clipped: set[str] = set()
        self._smoothing_noted = False
        self._done = 0.0
        for n in sorted(self.failed):
            self._record_failure(n)

    def begin(self, reference: StepImages) -> None:
        """Begin a sequence at a reference."""
        self.sequence = self._sequence(reference)

    def _sequence(self, reference: StepImages) -> SequenceMeasurement:
        # the kernels' modules take seconds to load: after the input was checked is early enough
        from stereorig.server.compute.sequence import SequenceMeasurement

        job = self.job
        mask, inputs = None, {}
        if job.specimen is not None:
            mask, inputs = job.specimen.mask, {"mask": hashlib.sha256(encode_png(job.specimen.mask)).hexdigest()}
        elif job.mask_file is not None:
            mask, inputs = read_mask(job.mask_file), {"mask": sha256_of(job.mask_file)}
        return SequenceMeasurement(
            calibration=job.calibration,
            settings=job.settings,
            mask=mask,
            reference=reference,
            folder=job.out,
            noise=job.noise,
            inputs=inputs,
        )

    def read(self, later: tuple[int, ImagePair]) -> tuple[StepImages, Pair]:
        """Read and check a later step's images."""
        k, pair = later
        step, pixels = read_pair(pair, k, self.job.shapes)
        return step, self.sequence.prepared(step, pixels)

    def measure(self, step: StepImages) -> None:
        """Measure the reference's shape; under a projected pattern every step is its own reference."""

        def begun() -> tuple[StepImages, None]:
            if self.job.settings.pattern == "projected":
                self.begin(step)
            return step, None

        self._measure(step.n, step.files, begun)

    def measure_later(self, k: int, pair: ImagePair, read: Iterator[tuple[StepImages, Pair]]) -> None:
        """Measure the k-th step, which :meth:`read` gives next."""
        self._measure(number_of(pair, k), (pair.cam1, pair.cam2), lambda: next(read))

    def _measure(self, n: int, files: tuple[Path, Path], images: Callable[[], tuple[StepImages, Pair | None]]) -> None:
        """Measure a step, and have its file written.

        An error of the step's own is kept; an error of the reference, or one that ends the whole measurement, is
        raised.
        """
        started = time.monotonic()
        alone = self.job.settings.pattern == "projected"
        try:
            step, pair = images()
            result = self.sequence.measure(step, pair, previous=self._previous, progress=self._shower(n))
        except StereorigError as error:
            own = alone or self.begun
            if not own or isinstance(error, Cancelled | StorageError):
                raise
            error.context |= dict(zip(("cam1", "cam2"), map(str, files), strict=True))
            self.failed[n] = error
            self._record_failure(n)
            return
        compute_s = round(time.monotonic() - started, 3)
        if not self.begun:
            self._remove_older()
            if self.job.specimen is not None and self.job.mask_file is not None:
                write_bytes(self.job.mask_file, encode_png(self.job.specimen.mask))
            if self.job.carried is not None:
                write_bytes(self.job.calibration_file, self.job.carried)
            self._doubt_noise(result)
            self.begun = True
        elif not alone:
            self._previous = step.n
        self.writer.put(self._write, self.sequence, step, result, started, compute_s)

    def nothing_measured(self) -> StereorigError | None:
        """Return the first step's error if steps failed and none was measured but the reference."""
        needed = 1 if self.job.settings.pattern == "projected" else 2
        if not self.failed or len(self.summaries) >= needed:
            return None
        return self.failed[min(self.failed)]

    def _record_failure(self, n: int) -> None:
        self._progress.note(f"step {n} of {self.job.last}: failed: {self.failed[n]}")

    def _write(
        self, sequence: SequenceMeasurement, step: StepImages, result: Field, started: float, compute_s: float
    ) -> dict[str, Any]:
        """Write the file of a step, print its line, return its summary."""
        k = step.n
        one, two = step.files
        about = {"cam1_file": str(one), "cam2_file": str(two)}
        finished = sequence.finish(step, result, about=about, in_service=False)
        seconds = round(time.monotonic() - started, 3)
        summary = {
            **finished.summary,
            "cam1": str(one),
            "cam2": str(two),
            "sha256": dict(zip(("cam1", "cam2"), step.sha256, strict=True)),
            "compute_s": compute_s,
            "wall_s": seconds,
            "seconds": seconds,
        }
        shares = dict(zip(CAMERAS, step.saturated or (0.0, 0.0), strict=True))
        clipped = {cam: share for cam, share in shares.items() if share > SATURATED_SHARE}
        if clipped:
            of_each = {cam: {"saturated_share": round(share, 5)} for cam, share in shares.items()}
            summary["quality"] = {"code": "saturated", **of_each}
        rms = summary["epipolar_residual_rms_px"]
        residual = "" if rms is None else f"epipolar residual {rms:.3f} px, "
        self._progress.note(
            f"step {k} of {self.job.last}: {summary['valid']} of {summary['points']} points, "
            f"{residual}{_camera_offset(summary['camera_motion'])}{_strain_noise(summary['strain'])}{duration(seconds)}"
        )
        for cam in clipped.keys() - self._clipped:
            self._progress.note(f"warning: step {k}: {cam}: {saturation_text(clipped[cam])}.")
        self._clipped = set(clipped)
        self._note_dense(k, summary.get("dense"))
        self._note_patch(k, finished.field)
        self._note_reference(k, finished.field)
        self._note_smoothing(finished.field, summary["strain"])
        check = summary["epipolar_check"]
        if check is not None and check["level"] != self._checked:
            self._checked = check["level"]
            self._progress.note(f"{check['level']}: step {k}: {check['reason']}")
        motion = summary["camera_motion"]
        if motion is not None and motion["camera_moved"] is not self._moved:
            self._moved = motion["camera_moved"]
            self._progress.note(f"{'warning' if self._moved else 'note'}: step {k}: {motion['text']}")
        self.summaries.append(summary)
        return summary

    def _note_smoothing(self, result: Field, strain: dict[str, Any] | None) -> None:
        """Print once the smallest detail that smoothing leaves distinguishable."""
        if result.smoothing is None or self._smoothing_noted:
            return
        self._smoothing_noted = True
        gauge = (None, None) if strain is None else (strain["gauge_px"], strain["window"])
        self._progress.note(f"note: {smoothing_note(result.smoothing, gauge[0], strain_window=gauge[1])}")

    def _note_dense(self, n: int, dense: dict[str, Any] | None) -> None:
        """Print how many vectors a step's dense field has, or why it has none."""
        if dense is None:
            return
        if dense["file"] is None:
            self._progress.note(f"step {n}: no dense field: {dense['reason']}")
            return
        self._progress.note(
            f"step {n}: dense field of {dense['valid']} of {dense['vectors']} vectors, {dense['step_px']} px apart: "
            f"{dense['file']}"
        )

    def _note_patch(self, n: int, result: Field) -> None:
        """Print the reason for the patch: for the shape, for the first step, and at each change."""
        choice = result.patch
        if choice is None:
            return
        new = (choice.patch, choice.quadratic_advised)
        if (choice.asked == "auto" and n <= 1) or (new != self._chosen and (choice.asked == "auto" or new[1])):
            self._progress.note(f"{'shape' if n == 0 else f'step {n}'}: {choice.reason}")
        if n > 0:
            self._chosen = new

    def _note_reference(self, n: int, result: Field) -> None:
        """Print where another reference took over."""
        matched = self.job.steps[0].n if result.references is None else result.references.step
        if n > 1 and matched != self._matched and self.job.settings.reference_update == "auto":
            self._progress.note(f"step {n}: step {self._matched} no longer serves as reference, step {matched} does")
        self._matched = matched

    def _shower(self, n: int) -> Any:
        count = self.job.last + 1

        def show(phase: str, done: int, total: int) -> None:
            share = done / total if total > 0 else 0.0
            part = _SEEDS_SHARE * share if phase == "seeds" else _SEEDS_SHARE + (1.0 - _SEEDS_SHARE) * share
            self._done = max(self._done, (n + part) / count)
            self._progress.show(f"step {n} of {self.job.last}: {phase}", self._done)

        return show

    def _doubt_noise(self, shape: Field) -> None:
        """Print a note where residuals and noise file disagree."""
        options = self.sequence.options
        image = self.sequence.pair.image1.prepared(options.interpolation, None, options.blur)
        stated = image.noise_variance
        if stated is None:
            return
        found, expected = float(np.nanmedian(shape.noise_grey)), float(np.sqrt(stated))
        if not _MIN_OF_STATED < found / expected < _MAX_OF_STATED:
            self._progress.note(
                f"note: residuals show a noise of {found:.2f} grey levels, the noise file states {expected:.2f}; "
                "was it measured with these cameras' gain?"
            )

    def _remove_older(self) -> None:
        """Remove an earlier run's results: a surplus step or its summary would be taken for the present run's."""
        for path in (*self.job.out.iterdir(), *results_in(self.job.out / DENSE)):
            if path.name == "summary.json" or _RESULT.fullmatch(path.name):
                path.unlink()
