"""The sources of a report: result files, their records, the calibration, the metadata."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pydantic import ValidationError

from stereorig.core.errors import InputError, StereorigError
from stereorig.core.names import CameraName
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.steps import RigRecord, StepRecord
from stereorig.server.documents.tests import AnalysisRecord, CameraMotion, StepOutcome, SummaryRecord, TestRecord
from stereorig.server.formats.calibrations.in_test import calibration_id_in, calibration_in
from stereorig.server.formats.calibrations.kept_checks import read_checks, with_checks
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration
from stereorig.server.formats.images import read_image
from stereorig.server.formats.manifest import DamagedError, is_there, known_sha256
from stereorig.server.formats.results.folder import number_of, results_in
from stereorig.server.formats.results.reading import ResultHead, read_head
from stereorig.server.report.records import ReportedSettings
from stereorig.server.results.gauges.request import GaugeRequest
from stereorig.server.results.metadata import TestMetadata, parse_metadata
from stereorig.server.results.staleness import stale_results
from stereorig.server.results.warnings.analysis import ResultWarning, analysis_warnings
from stereorig.server.store.durable import known_json, known_record


@dataclass(frozen=True)
class Source:
    """Everything that a report is made from.

    Attributes
    ----------
    files
        Result files by step, ascending.
    heads
        Attributes of the files.
    test
        The test's folder, None for results outside a test; ``test_record`` is its ``test.json``.
    analysis
        ``analysis.json`` of the service; without one, as with results of ``stereorig measure``, its id is empty.
    steps
        ``step.json`` of every file's step; empty without a test.
    calibration, calibration_file
        None if it was not found or is not the measurement's.
    metadata
        Metadata stated by the operator.
    stale
        Inputs that are gone or were replaced since the results were written.
    doubts
        Warnings about inputs that were not found, and steps that failed.
    warnings
        Failed checks and other warnings to know before the results are used.
    camera_motion
        Findings about the cameras, of the steps that have one.
    stored
        Result files in the system frame, by step, if ``files`` are in another one.
    """

    files: dict[int, Path]
    heads: dict[int, ResultHead]
    test: Path | None
    test_record: TestRecord
    analysis: AnalysisRecord
    steps: dict[int, StepRecord]
    calibration: LoadedCalibration | None
    calibration_file: Path | None
    metadata: TestMetadata
    stale: list[str]
    doubts: list[str] = field(default_factory=list)
    warnings: list[ResultWarning] = field(default_factory=list)
    camera_motion: dict[int, CameraMotion] = field(default_factory=dict)
    stored: Mapping[int, Path] = field(default_factory=dict)

    def in_frame(self, files: Mapping[int, Path]) -> Source:
        """Return the source with its result files in another frame, by step."""
        heads = {n: read_head(path) for n, path in sorted(files.items())}
        return replace(self, files=dict(sorted(files.items())), heads=heads, stored=self.files)

    @property
    def reference(self) -> int:
        """Number of the reference step; of shapes alone, of the first."""
        shapes = [n for n, head in self.heads.items() if head.kind == "shape"]
        return min(shapes) if shapes else self.settings.reference

    @property
    def reference_step(self) -> StepRecord:
        """The record of the reference."""
        return self.steps.get(self.reference, StepRecord(n=self.reference))

    @property
    def rig(self) -> RigRecord:
        """The rig at the reference."""
        return self.reference_step.rig or RigRecord()

    @property
    def settings(self) -> ReportedSettings:
        """Settings of the analysis, from the files themselves."""
        return ReportedSettings.model_validate(self.heads[max(self.heads)].settings)

    @property
    def title(self) -> str:
        """Name of the test; without one, of the folder."""
        return self.test_record.name or self.files[min(self.files)].absolute().parent.name

    def reference_image(self, cam: CameraName) -> NDArray[Any] | None:
        """Image of the reference; None if it is gone or was replaced since the measurement."""
        n = self.reference
        head = self.heads.get(n, self.heads[max(self.heads)])
        inputs = head.inputs_sha256
        sha256 = inputs.get(f"reference_{cam}") or inputs.get(cam)
        candidates = [] if self.test is None else [self.test / "steps" / f"{n:04d}" / f"{cam}.tif"]
        if n in self.heads and self.heads[n].image_file(cam):
            named = Path(self.heads[n].image_file(cam))
            candidates += [named, self.files[n].parent / named.name]
        for path in candidates:
            try:
                if is_there(path) and (sha256 is None or known_sha256(path) == sha256):
                    return read_image(path)
            except DamagedError:
                raise
            except (OSError, StereorigError):
                continue
        return None


def find_source(
    origin: Path,
    *,
    test: str | None = None,
    analysis: str | None = None,
    calibration: Path | None = None,
    metadata: TestMetadata | None = None,
) -> Source:
    """Find everything about one measurement.

    Parameters
    ----------
    origin
        A data folder, a test's folder, an analysis' folder, or the output of ``stereorig measure --out``.
    test, analysis
        One of a data folder's tests, and of a test's analyses; left out: the only test, the newest analysis with
        results.
    calibration
        Its file, if it is not in the results' folder.
    metadata
        Metadata stated by the operator; left out: those kept with the test.

    Raises
    ------
    InputError
        ``results_missing``, ``test_unclear``.
    NotFoundError
        No such test or analysis.
    FileFormatError
        A result file that cannot be read, metadata that cannot be.
    """
    folder = _results_folder(origin, test, analysis)
    files = {number_of(path): path for path in results_in(folder)}
    if not files:
        raise InputError(
            f"There is no step_0000.nc or another step's result in {folder}.",
            code="results_missing",
            remedy="Measure first, or give the folder that stereorig measure --out wrote.",
        )
    folder = folder.absolute()
    heads = {n: read_head(path) for n, path in sorted(files.items())}
    home = folder.parent.parent if (folder.parent.parent / "steps").is_dir() else None
    test_record, steps = TestRecord(id=""), {n: StepRecord(n=n) for n in heads}
    if home is not None:
        test_record = known_record(TestRecord, home / "test.json", id="")
        steps = {n: known_record(StepRecord, home / "steps" / f"{n:04d}" / "step.json", n=n) for n in heads}
    summary = known_record(SummaryRecord, folder / "summary.json")
    doubts = [f"Step {n} could not be measured: {one.code}: {one.detail}" for n, one in summary.steps_failed.items()]
    unknown = [str(n) for n, step in steps.items() if step.dz_mm is not None and None in step.dz_mm.values()]
    if unknown:
        doubts.append(f"Position unknown of the stage, which did not answer, at step {', '.join(unknown)}.")
    if any("stage" in (s.simulated or ()) and not (s.rig and s.rig.simulated) for s in steps.values()):
        doubts.append("The stage was simulated but the cameras are real: nothing was at its positions.")
    loaded, file = _calibration(calibration, home, summary, heads, doubts)
    stated = parse_metadata(test_record.metadata, name="the metadata of the test") if metadata is None else metadata
    if loaded is not None and file is not None:
        loaded = _with_kept_checks(loaded, file, home, test_record)
    return Source(
        files=dict(sorted(files.items())),
        heads=heads,
        test=home,
        test_record=test_record,
        analysis=known_record(AnalysisRecord, folder / "analysis.json", id="", test_id=""),
        steps=steps,
        calibration=loaded,
        calibration_file=file,
        metadata=_with_drawn_gauges(stated, folder, home, doubts),
        stale=stale_results(list(files.values()), list(heads.values())),
        doubts=doubts,
        warnings=[one for one in analysis_warnings(folder) if one.code != "steps_failed"],  # they are among the doubts
        camera_motion=_camera_motion(folder, list(heads), summary),
    )


def _with_drawn_gauges(stated: TestMetadata, folder: Path, home: Path | None, doubts: list[str]) -> TestMetadata:
    """Add the gauges of the recipe, or those drawn over the test's results, where the metadata name none."""
    drawn = known_json(folder / "summary.json").get("gauges")  # written by stereorig measure --recipe
    if drawn is None and home is not None:
        drawn = known_json(home / "workspace.json").get("gauges")
    if stated.gauges is not None or drawn is None:
        return stated
    try:
        return stated.model_copy(update={"gauges": GaugeRequest.model_validate(drawn)})
    except ValidationError as error:
        doubts.append(f"The gauges that were drawn cannot be read: {error.errors()[0]['msg']}.")
        return stated


def _camera_motion(folder: Path, numbers: list[int], summary: SummaryRecord) -> dict[int, CameraMotion]:
    """Read the findings about the cameras: of a finished measurement, or of the steps there are so far."""
    steps = summary.steps or [known_record(StepOutcome, folder / f"step_{n:04d}.json", n=n) for n in numbers]
    return {s.n: s.camera_motion for s in steps if s.n in numbers and s.camera_motion is not None}


def _with_kept_checks(
    loaded: LoadedCalibration, file: Path, home: Path | None, test_record: TestRecord
) -> LoadedCalibration:
    """Add the later checks of a calibration, from its own folder, or from the original of a test's copy."""
    kept = read_checks(file, loaded.sha256)
    name = calibration_id_in(test_record.model_dump(), loaded.sha256)
    if home is not None and name:
        folder = home.parent.parent / "calibrations" / Path(name).name
        kept = {**read_checks(folder / "calibration.json", loaded.sha256), **kept}
    return replace(loaded, details=with_checks(loaded.details, kept)) if kept else loaded


def _results_folder(origin: Path, test: str | None, analysis: str | None) -> Path:
    if not origin.is_dir():
        raise InputError(f"{origin} is no folder.", code="results_missing", remedy="Give a folder with results.")
    if (origin / "tests").is_dir():
        origin = _one_test(origin / "tests", test)
    elif test is not None:
        raise InputError(
            f"{origin} is no data folder, so it has no test {test}.",
            code="option_conflict",
            remedy="Give the data folder, or leave the test out.",
        )
    if (origin / "steps").is_dir():
        return _one_analysis(origin, analysis)
    if analysis is not None and origin.name != analysis:
        raise InputError(
            f"{origin} is no test's folder, so it has no analysis {analysis}.",
            code="option_conflict",
            remedy="Give the test's folder, or leave the analysis out.",
        )
    return origin


def _one_test(tests: Path, wanted: str | None) -> Path:
    there = {path.parent.name: path.parent for path in sorted(tests.glob("*/test.json"))}
    if wanted is not None:
        if wanted not in there:
            raise NotFoundError(f"There is no test {wanted[:40]!r} in {tests.parent}.", kind="test")
        return there[wanted]
    if len(there) != 1:
        raise InputError(
            f"{tests.parent} holds {len(there)} tests.",
            code="test_unclear",
            remedy="Name one with --test, or give the test's own folder.",
            tests=list(there),
        )
    return next(iter(there.values()))


def _one_analysis(test: Path, wanted: str | None) -> Path:
    there = {path.parent.name: path.parent for path in sorted(test.glob("analyses/*/analysis.json"))}
    if wanted is not None:
        if wanted not in there:
            raise NotFoundError(f"There is no analysis {wanted[:40]!r} in {test}.", kind="analysis")
        return there[wanted]
    finished = [path for path in there.values() if results_in(path)]
    # `stereorig measure` writes its results next to the analyses
    return finished[-1] if finished else test / "exports" / "measure"


def _calibration(
    given: Path | None, test: Path | None, summary: SummaryRecord, heads: Mapping[int, ResultHead], doubts: list[str]
) -> tuple[LoadedCalibration | None, Path | None]:
    """Find the calibration that the results were measured with, by its checksum."""
    inputs = heads[max(heads)].inputs_sha256
    sha256 = inputs.get("calibration")
    candidates = [] if given is None else [given]
    if given is None:
        candidates += [] if test is None else [calibration_in(test, sha256)]
        named = summary.calibration.get("file")  # by stereorig measure
        candidates += [Path(named)] if isinstance(named, str) else []
    for path in candidates:
        if not path.is_file():
            continue
        loaded = load_calibration(path)
        if sha256 is None or loaded.sha256 == sha256:
            return loaded, path
        if given is not None:
            raise InputError(
                f"{given} is not the calibration that the results were measured with.",
                code="calibration_changed",
                remedy="Give the calibration that was measured with.",
            )
        doubts.append(f"{path.name} is not the calibration that was measured with; nothing is reported from it.")
    if given is not None:
        load_calibration(given)  # raises the error that names the defect
    return None, None
