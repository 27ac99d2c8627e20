"""Gauges over the result files of a measurement: one function behind the command line and the API."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, MeasurementError, StateError
from stereorig.core.field.common import notes_of
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.align import Alignment, aligned
from stereorig.core.gauge.area import points_within
from stereorig.core.gauge.locate import positions_from_mm
from stereorig.core.gauge.rigid import rigid_motion, without_rigid_motion
from stereorig.core.gauge.sampling import positions_along
from stereorig.server.formats.calibrations.in_test import calibration_id_in
from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.gauges.readings import GaugeReadings, RigidMotionReading, StepProblem, StepReadings
from stereorig.server.formats.gauges.table import stated
from stereorig.server.formats.results.folder import home_of, number_of
from stereorig.server.formats.results.layout import COVARIANCE_NAMES
from stereorig.server.formats.results.reading import ResultHead, read_field, read_head
from stereorig.server.formats.results.uncertainty import Included, Statement, read_included
from stereorig.server.formats.version import software_version
from stereorig.server.results.channels import recorded_with
from stereorig.server.results.gauges.differences import KeptReading, frame_reading, motion_reading, with_differences
from stereorig.server.results.gauges.fields import FieldWriter
from stereorig.server.results.gauges.frames import lay, text_of
from stereorig.server.results.gauges.request import ExtensometerGauge, GaugeRequest, LineGauge, PointGauge
from stereorig.server.results.gauges.values import of_area, of_extensometer, of_line, of_point
from stereorig.server.results.gauges.variables import Variables
from stereorig.server.results.images.projected_pattern import check_gauges
from stereorig.server.results.reader import read_variable
from stereorig.server.results.staleness import stale_results
from stereorig.server.store.durable import known_json

_Positions = dict[str | None, list[tuple[float, float]]]
MAX_NUMBERS = 3_000_000


@dataclass(frozen=True, eq=False)
class _Step:
    """One result file, read; its field in the frame and without the motion that was asked for."""

    path: Path
    sha256: str
    head: ResultHead
    field: Field
    shared: SharedPixels
    included: Included

    def reading(self, **found: Any) -> StepReadings:
        head = self.head
        recorded = recorded_with(home_of(self.path), head.step, head.reference_step)
        return StepReadings(
            n=head.step,
            kind=head.kind,
            label=head.label,
            load_n=head.load_n if recorded.load_n is None else recorded.load_n,
            time_s=recorded.time_s,
            channels=recorded.channels,
            channel_units=recorded.units,
            channel_u=recorded.u,
            **found,
        )


def read_gauges(
    files: Sequence[Path],
    request: GaugeRequest,
    fields: FieldWriter | None = None,
    *,
    only: Collection[int] | None = None,
    laid_through: Path | None = None,
) -> GaugeReadings:
    """Read a set of gauges in every step.

    Parameters
    ----------
    files
        Result files of one measurement.
    request
        The gauges.
    fields
        Takes each step's field in the frame and without the motion that was asked for.
    only
        Steps to be read of those that are asked for, as of a page; None: all. The first of those that are asked for is
        read in any case: it defines the frame, and positions in mm are found on it.
    laid_through
        Result file that defines the frame, if that is none of `files`.

    Raises
    ------
    StateError
        ``no_results`` without files.
    InputError
        ``step_missing``, ``steps_mixed``, ``gauge_outside``, ``gauge_unusable``, ``gauge_too_large``.
    NotFoundError
        ``field_missing`` for a variable that a file lacks.
    MeasurementError
        ``too_few_points`` to align.
    """
    chosen = steps_asked(files, request)
    if only is not None:
        needed = {*only, request.difference_from, number_of(chosen[0])}
        chosen = [path for path in chosen if number_of(path) in needed]
    alignment: Alignment | None = None
    if request.align is not None and laid_through is not None:
        base = _read(laid_through)
        alignment = lay(request.align, base.field, base.shared)
    first: ResultHead | None = None
    grid: tuple[Float, Float] | None = None
    hashes, steps, heads, included = {}, [], [], []
    moved_by: set[str] = set()
    found: set[str] = set()
    positions: _Positions = {}
    kept: list[list[KeptReading]] = []
    numbers = 0
    for path in chosen:
        step = _read(path)
        first = step.head if first is None else first
        check_gauges(request, step.head.settings)
        grid = (step.field.x_px, step.field.y_px) if grid is None else grid
        _check_same(step, first, grid, path, moved_by)
        hashes[path.name] = step.sha256
        if request.align is not None and alignment is None:
            alignment = lay(request.align, step.field, step.shared)
        if first is step.head:
            positions = _positions_of(step.field if alignment is None else aligned(step.field, alignment), request)
        numbers += _count(step.field, request.lines, len(request.variables or COVARIANCE_NAMES))
        if numbers > MAX_NUMBERS:
            raise InputError(
                f"The lines hold more than {MAX_NUMBERS:,} numbers.",
                code="gauge_too_large",
                remedy="Ask for fewer positions, variables or steps.",
            )
        heads.append(step.head)
        included.append(step.included)
        kept.append([])
        steps.append(_read_step(step, alignment, request, positions, found, kept[-1], fields))
    for name in request.variables or ():
        if name not in found and any(s.problem is None for s in steps):
            read_variable(chosen[-1], name)  # the error names those that there are
    if request.difference_from is not None:
        steps = with_differences(steps, kept, request.difference_from)
    steps = [
        stated(step, Statement(one, request))
        for step, one in zip(steps, included, strict=True)
        if (request.steps is None or step.n in request.steps) and (only is None or step.n in only)
    ]
    assert first is not None
    stale = stale_results(chosen, heads)
    frame = first.frame
    if request.align is not None:
        frame = f"{text_of(request.align)}; before: {frame}"
    statement = Statement(Included.in_all(included), request)
    laid = None if alignment is None else frame_reading(alignment)
    return GaugeReadings(
        software_version=software_version(),
        settings=request.model_dump(mode="json"),
        calibration=_calibration(chosen[-1], first),
        inputs_sha256=hashes,
        stale=bool(stale),
        stale_reasons=stale,
        frame=frame,
        subset_px=first.settings["subset_px"],
        smoothing_window=first.settings.get("smoothing_window"),
        alignment=None if laid is None else replace(laid, not_included=statement.included.lacking),
        statement=statement,
        steps=steps,
    )


def _calibration(path: Path, head: ResultHead) -> dict[str, str | None]:
    """Return id and checksum of the calibration that a file was measured with."""
    sha256 = head.inputs_sha256.get("calibration")
    test = known_json(path.absolute().parent.parent.parent / "test.json")
    return {"id": calibration_id_in(test, sha256), "sha256": sha256}


def steps_asked(files: Sequence[Path], request: GaugeRequest) -> list[Path]:
    """Return the result files that a request names, including the one of `difference_from`, ascending.

    Raises
    ------
    StateError
        ``no_results`` without files.
    InputError
        ``step_missing``.
    """
    wanted, base = request.steps, request.difference_from
    if not files:
        raise StateError(
            "There is no result file yet.",
            code="no_results",
            remedy="Measure first; a step's result can be read once the step is finished.",
        )
    there = {number_of(path): path for path in files}
    numbers = sorted({*(there if wanted is None else wanted), *(() if base is None else (base,))})
    missing = [n for n in numbers if n not in there]
    if missing:
        raise InputError(
            f"There is no result of step {missing[0]}; there are {_listed(sorted(there))}.",
            code="step_missing",
            remedy="Ask for steps that were measured.",
        )
    return [there[n] for n in numbers]


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers)) if len(numbers) <= 8 else f"{numbers[0]} ... {numbers[-1]}"


def _read(path: Path) -> _Step:
    head, field = read_head(path), read_field(path)
    subset = head.settings.get("subset_px")
    if not isinstance(subset, int | float):
        raise InputError(
            f"{path.name} does not state its subset.",
            code="settings_missing",
            remedy="Measure again with this program.",
        )
    return _Step(path, sha256_of(path), head, field, SharedPixels.of(field, float(subset)), read_included(path))


def _check_same(step: _Step, first: ResultHead, grid: tuple[Float, Float], path: Path, refs: set[str]) -> None:
    """Raise an error for files of different measurements: other points, calibration, subset or reference."""
    inputs, others = step.head.inputs_sha256, first.inputs_sha256
    field = step.field
    if step.field.has_motion:
        refs.add(str(inputs.get("reference_cam1")))
    differs = (
        "points"
        if field.shape != grid[0].shape or (field.x_px != grid[0]).any() or (field.y_px != grid[1]).any()
        else "calibration"
        if inputs.get("calibration") != others.get("calibration")
        else "subset"
        if step.head.settings.get("subset_px") != first.settings.get("subset_px")
        else "smoothing"
        if field.has_motion and first.settings.get("smoothing_window") != step.head.settings.get("smoothing_window")
        else "reference"
        if len(refs) > 1 or (refs and str(others.get("reference_cam1")) not in refs)
        else ""
    )
    if differs:
        raise InputError(
            f"{path.name} has another {differs} than the first step that was read.",
            code="steps_mixed",
            remedy="Give the result files of one measurement.",
        )


def _count(field: Field, lines: Sequence[LineGauge], variables: int) -> int:
    return variables * sum(len(positions_along(field, line.vertices_px, line.count)[1]) for line in lines)


def _positions_of(field: Field, request: GaugeRequest) -> _Positions:
    """Return the pixels of each named point and extensometer; those given in mm are found on the first step's shape."""
    positions: _Positions = {}
    gauges: list[PointGauge | ExtensometerGauge] = [*request.points, *request.extensometers]
    for gauge in gauges:
        given, in_mm = gauge.positions()
        xy = positions_from_mm(field, given) if in_mm else given
        positions[gauge.name] = [(float(x), float(y)) for x, y in xy]
    return positions


def _read_step(
    step: _Step,
    alignment: Alignment | None,
    request: GaugeRequest,
    positions: _Positions,
    found: set[str],
    kept: list[KeptReading],
    fields: FieldWriter | None,
) -> StepReadings:
    field = measured = step.field if alignment is None else aligned(step.field, alignment)
    taken_out: RigidMotionReading | None = None
    if request.remove_rigid is not None and field.has_motion:
        removal = request.remove_rigid
        inside = points_within(field, removal.corners())
        try:
            motion = rigid_motion(field, shared=step.shared, chosen=inside, robust=removal.robust)
        except MeasurementError as error:
            return step.reading(problem=StepProblem(error.code, error.cause, error.remedy))
        field = without_rigid_motion(field, motion, shared=step.shared)
        taken_out = motion_reading(motion)
    if fields is not None:
        frame = None if alignment is None else frame_reading(alignment)
        fields(step.path, step.sha256, step.head, field, frame, taken_out)
    variables = Variables(step.path, field, step.shared, measured=measured, turned=alignment is not None)
    names = variables.known(request.variables or COVARIANCE_NAMES)
    found.update(names)
    return step.reading(
        rigid_motion=taken_out,
        points=[of_point(variables, kept, names, p.name, *positions[p.name]) for p in request.points],
        extensometers=[of_extensometer(variables, kept, e.name, *positions[e.name]) for e in request.extensometers],
        lines=[of_line(variables, names, line) for line in request.lines],
        areas=[of_area(variables, kept, names, a.name, a.corners()) for a in request.areas],
        not_told=notes_of(field),
    )
