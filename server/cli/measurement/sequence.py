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
from typing import TYPE_CHECKING, Any

import numpy as np

from core.compiling import COMPILING, report_compiling
from core.errors import MeasurementError
from core.field.points.result import Field
from core.settings import StoredSettings
from server.cli.terminal import ProgressLine, duration
from server.compute.background_compilation import BackgroundCompilation
from server.compute.overlap import ReadAhead, WriteBehind
from server.compute.strain import smoothing_note
from server.formats.calibrations.recognise import LoadedCalibration
from server.formats.files import make_folder, sha256_of, write_bytes
from server.formats.images import read_mask
from server.formats.noise_json import LoadedNoise
from server.formats.results.summary import SequenceSummary, to_json
from server.formats.version import software_version
from server.worker.tasks import StepImages

if TYPE_CHECKING:
    from server.compute.sequence import Pair, SequenceMeasurement

_MIN_OF_STATED, _MAX_OF_STATED = 0.75, 1.5  # residuals hold interpolation error besides noise, never less
_SEEDS_SHARE = 0.15  # of a step's time, as a rule
_RESULT = re.compile(r"step_\d{4}\.nc")


def _camera_offset(motion: dict[str, Any] | None) -> str:
    """Return what the step's epipolar offset says about the cameras, for its line."""
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


@dataclass(frozen=True, kw_only=True)
class MeasureJob:
    """Everything that ``stereorig measure`` was asked to do, checked."""

    calibration: LoadedCalibration
    calibration_file: Path
    steps: list[StepImages]
    settings: StoredSettings
    mask_file: Path | None
    out: Path
    noise: LoadedNoise | None = None


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
        if len(job.steps) > 1:
            compilation.start()

    with (
        _output_folder(job.out),
        BackgroundCompilation(job.settings.patch) as compilation,
        report_compiling(on_compiling),
        WriteBehind[dict[str, Any]]() as written,
    ):
        runner = _Runner(job, progress, written)
        if job.settings.pattern == "projected":
            for _ in job.steps:
                runner.measure(None)
        else:
            with ReadAhead(runner.sequence.read, job.steps[1:]) as pairs:
                runner.measure(None)
                compilation.wait()
                for images in pairs:
                    runner.measure(images)
        steps = written.finish()
    seconds = round(time.monotonic() - started, 3)
    summary = SequenceSummary(
        state="succeeded",
        software_version=software_version(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        calibration={
            "file": str(job.calibration_file),
            "sha256": job.calibration.sha256,
            "source": job.calibration.source,
        },
        settings=job.settings.model_dump(),
        seconds=seconds,
        steps=steps,
    ).document()
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
    """Measures the steps in order, and prints a line for each on the terminal."""

    def __init__(self, job: MeasureJob, progress: ProgressLine, written: WriteBehind[dict[str, Any]]) -> None:
        self._job = job
        self._progress = progress
        self._written = written
        self.sequence = self._sequence(job.steps[0])
        self._index = 0
        self._matched = job.steps[0].n
        self._chosen: tuple[str, bool] | None = None
        self._checked = "ok"
        self._moved: bool | None = False
        self._smoothing_noted = False
        self._done = 0.0

    def _sequence(self, reference: StepImages) -> SequenceMeasurement:
        # the kernels' modules take seconds to load: after the input was checked is early enough
        from server.compute.sequence import SequenceMeasurement

        job = self._job
        return SequenceMeasurement(
            calibration=job.calibration,
            settings=job.settings,
            mask=None if job.mask_file is None else read_mask(job.mask_file),
            reference=reference,
            folder=job.out,
            noise=job.noise,
            inputs={} if job.mask_file is None else {"mask": sha256_of(job.mask_file)},
        )

    def measure(self, images: Pair | None) -> None:
        """Measure the next step, the reference's shape first (no images), and have its file written.

        Under a projected pattern every step is its own reference.
        """
        started, k, steps = time.monotonic(), self._index, self._job.steps
        if k > 0 and self._job.settings.pattern == "projected":
            self.sequence = self._sequence(steps[k])
        previous = steps[k - 1].n if k > 1 else None
        result = self.sequence.measure(steps[k], images, previous=previous, progress=self._shower(k))
        compute_s = round(time.monotonic() - started, 3)
        if not result.valid.any():
            one, two = steps[k].files
            raise MeasurementError(
                f"No point of step {k} ({one.name}, {two.name}) could be measured.",
                code="nothing_measured",
                remedy="Check that both cameras see the same textured surface, in this order, and the region.",
            )
        if k == 0:
            self._remove_older()
            self._doubt_noise(result)
        self._written.put(self._write, self.sequence, k, result, started, compute_s)
        self._index += 1

    def _write(
        self, sequence: SequenceMeasurement, k: int, result: Field, started: float, compute_s: float
    ) -> dict[str, Any]:
        """Write the file of a step, print its line, return its summary."""
        step = self._job.steps[k]
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
        rms = summary["epipolar_residual_rms_px"]
        residual = "" if rms is None else f"epipolar residual {rms:.3f} px, "
        self._progress.note(
            f"step {k} of {len(self._job.steps) - 1}: {summary['valid']} of {summary['points']} points, "
            f"{residual}{_camera_offset(summary['camera_motion'])}{_strain_noise(summary['strain'])}{duration(seconds)}"
        )
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
        return summary

    def _note_smoothing(self, result: Field, strain: dict[str, Any] | None) -> None:
        """Print once what smoothing leaves distinguishable."""
        if result.smoothing is None or self._smoothing_noted:
            return
        self._smoothing_noted = True
        gauge = (None, None) if strain is None else (strain["gauge_px"], strain["window"])
        self._progress.note(f"note: {smoothing_note(result.smoothing, gauge[0], strain_window=gauge[1])}")

    def _note_patch(self, n: int, result: Field) -> None:
        """Print the reason for the patch: of the shape, of the first step, and where it changes."""
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
        matched = self._job.steps[0].n if result.references is None else result.references.step
        if n > 1 and matched != self._matched and self._job.settings.reference_update == "auto":
            self._progress.note(f"step {n}: step {self._matched} no longer serves as reference, step {matched} does")
        self._matched = matched

    def _shower(self, n: int) -> Any:
        count = len(self._job.steps)

        def show(phase: str, done: int, total: int) -> None:
            share = done / total if total > 0 else 0.0
            part = _SEEDS_SHARE * share if phase == "seeds" else _SEEDS_SHARE + (1.0 - _SEEDS_SHARE) * share
            self._done = max(self._done, (n + part) / count)
            self._progress.show(f"step {n} of {count - 1}: {phase}", self._done)

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
        """Remove an earlier run's results: more steps than now, or its summary, would pass for this one's."""
        for path in self._job.out.iterdir():
            if path.name == "summary.json" or _RESULT.fullmatch(path.name):
                path.unlink()
