"""A result file compared with a model's file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, StateError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.align import align_3_2_1, align_given
from stereorig.core.model.compare import compare_with_model
from stereorig.core.model.placement import Placement, place_by_fit, place_by_markers, place_given, place_in_frame
from stereorig.core.model.regions import ChiSquare
from stereorig.core.model.result import MODEL_STATUS_MEANINGS, Compared, CompareOptions, ModelComparison, ModelStatus
from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.models.read import ModelFile, read_model
from stereorig.server.formats.results.folder import file_of_step, number_of
from stereorig.server.formats.results.reading import ResultHead, read_field, read_head
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.uncertainty import read_included
from stereorig.server.formats.version import software_version
from stereorig.server.results.gauges.differences import finite
from stereorig.server.results.models.document import (
    ChiSquareReply,
    ComparedNumber,
    FactorReply,
    FieldVerdict,
    ModelComparisonReply,
    ModelReply,
    PlacementReply,
    RegionReply,
    ShapeReply,
)
from stereorig.server.results.models.request import (
    BestFitPlacement,
    CompareRequest,
    GivenPlacement,
    MarkersPlacement,
    Start,
)
from stereorig.server.results.reader import FileVariable
from stereorig.server.results.steps import StepResult

_DISPLACEMENT, _STRAIN = ("u_mm", "v_mm", "w_mm"), ("exx", "eyy", "exy")
_GRID = ("row", "col")


@dataclass(frozen=True, eq=False)
class ComparedStep:
    """A step compared with a model.

    Attributes
    ----------
    comparison
        As computed.
    document
        The comparison's document for API, command line and report.
    """

    comparison: ModelComparison
    document: ModelComparisonReply

    def added_to(self, step: StepResult) -> StepResult:
        """Return a step's result with the model, the difference, its uncertainty, z and regions at its points."""
        return replace(step, variables={**step.variables, **_variables(self.comparison)})


def compare_files(
    files: Sequence[Path],
    model: Path,
    request: CompareRequest,
    *,
    read: ModelFile | None = None,
    model_name: str | None = None,
) -> ComparedStep:
    """Compare one of the result files of a measurement with a model.

    Parameters
    ----------
    files
        Result files.
    model
        The model's file.
    request
        The step, the reading options of the model and its placement.
    read
        The model, if it was read already.
    model_name
        Name to state; None: the file's.

    Raises
    ------
    StateError
        ``no_results`` without files.
    InputError
        ``step_missing``, ``comparison_needs_motion``, ``settings_missing``, ``model_no_overlap``,
        ``model_geometry_differs``; errors of reading a model.
    MeasurementError
        ``too_few_points`` for a marker or a position of 3-2-1.
    """
    path = _chosen(files, request.step)
    head, field = read_head(path), read_field(path)
    subset = head.settings.get("subset_px")
    if not isinstance(subset, int | float):
        raise InputError(
            f"{path.name} does not state its subset.",
            code="settings_missing",
            remedy="Measure again with this program.",
        )
    shared = SharedPixels.of(field, float(subset))
    read = read or read_model(model, unit=request.unit, displacement=request.displacement, time=request.time)
    asked = request.align
    start = _start(asked.start if isinstance(asked, BestFitPlacement) else asked, field, shared)
    towards = field.normal_sys[field.valid].mean(axis=0) if field.valid.any() else np.array([0.0, 0.0, 1.0])
    surface = read.surface(start.rotation.T @ towards)
    placement = place_by_fit(field, surface, start, shared=shared) if isinstance(asked, BestFitPlacement) else start
    strain = read_strain(path)
    found = compare_with_model(
        field,
        surface,
        placement,
        subset_px=round(subset),
        options=CompareOptions(
            tile_px=request.tile_px,
            confidence=request.confidence,
            remove_rigid=request.remove_rigid,
            load_uncertainty=request.load_uncertainty,
            systematic_mm=_interpolation(head) if request.interpolation else (0.0, 0.0, 0.0),
        ),
        strain=None if strain is None else strain.options,
    )
    about = ModelReply(
        file=model_name or model.name,
        sha256=sha256_of(model),
        unit=read.unit,
        displacement_unit=read.displacement_unit,
        displacement=read.displacement_name,
        nodes=len(read.nodes_mm),
        triangles=len(surface.triangles),
        time=read.mesh.time,
        corners_only=read.mesh.corners_only,
    )
    return ComparedStep(found, _document(found, field, head, path, about, request))


def _chosen(files: Sequence[Path], step: int | None) -> Path:
    if not files:
        raise StateError("There is no result file yet.", code="no_results", remedy="Measure first.")
    there = {number_of(path): path for path in files}
    return file_of_step(there, max(there) if step is None else step)


def _start(asked: Start, field: Field, shared: SharedPixels) -> Placement:
    if isinstance(asked, GivenPlacement):
        frame = align_given(asked.rotation, asked.origin_mm)
        return place_given(
            frame.rotation,
            frame.origin_mm,
            field,
            sigma_rad=float(np.radians(asked.sigma_deg)),
            sigma_mm=asked.sigma_mm,
        )
    if isinstance(asked, MarkersPlacement):
        return place_by_markers(
            field,
            [m.xy_px for m in asked.markers],
            [m.model_mm for m in asked.markers],
            shared=shared,
            sigma_mm=asked.sigma_mm,
        )
    return place_in_frame(align_3_2_1(field, asked.positions_px, shared=shared), asked.model_mm)


def _interpolation(head: ResultHead) -> tuple[float, float, float]:
    """Estimated size of interpolation's bias of U, V, W, mm; zero where noise hides it or the file has none."""
    try:
        terms = json.loads(str(head.attributes.get("systematic", "{}")))
        figures = terms["interpolation"]["figures"]
    except (ValueError, KeyError, TypeError):
        return 0.0, 0.0, 0.0
    u, v, w = (1e-3 * float((figures.get(name) or {}).get("rms") or 0.0) for name in ("u_um", "v_um", "w_um"))
    return u, v, w


def _document(
    found: ModelComparison, field: Field, head: ResultHead, path: Path, about: ModelReply, request: CompareRequest
) -> ModelComparisonReply:
    place, rigid = found.placement, found.rigid
    return ModelComparisonReply(
        step=head.step,
        accepted=found.accepted,
        model=about,
        settings=request.model_dump(mode="json"),
        align=PlacementReply(
            kind=place.kind,
            rotation=place.rotation.tolist(),
            shift_mm=place.shift_mm.tolist(),
            centre_mm=place.centre_mm.tolist(),
            covariance=place.covariance.tolist(),
            points=place.points,
            residual_rms_mm=place.residual_rms_mm,
            held=list(place.held),
        ),
        points={"measured": int(field.valid.sum()), "compared": int((found.status == ModelStatus.COMPARED).sum())},
        shape=ShapeReply(rms_mm=found.shape_rms_mm, ratio=found.shape_ratio),
        displacement=_field_verdict(found.displacement, _DISPLACEMENT),
        strain=None if found.strain is None else _field_verdict(found.strain, _STRAIN),
        factor=FactorReply(value=finite(found.factor), sigma=finite(found.factor_sigma)),
        rigid=None if rigid is None else {"rotation_rad": rigid[:3].tolist(), "shift_mm": rigid[3:].tolist()},
        regions=_regions(found, field),
        refuted=[k for k in range(found.tiles.count) if _refuted(found, k)],
        left_out=None if found.left_out is None else _DISPLACEMENT[found.left_out],
        not_included=read_included(path).lacking,
        inputs_sha256={path.name: sha256_of(path)},
        software_version=software_version(),
    )


def _verdict(one: ChiSquare | None) -> ChiSquareReply | None:
    if one is None:
        return None
    return ChiSquareReply(chi_square=finite(one.chi_square), degrees=one.degrees, probability=finite(one.probability))


def _field_verdict(one: Compared, names: tuple[str, ...]) -> FieldVerdict:
    def rms(values: Float) -> dict[str, float | None]:
        out = {}
        for k, name in enumerate(names):
            held = values[..., k][np.isfinite(values[..., k])]
            out[name] = finite(float(np.sqrt(np.mean(held**2)))) if held.size else None
        return out

    overall = _verdict(one.overall)
    assert overall is not None
    return FieldVerdict(
        accepted=one.accepted,
        overall=overall,
        scale=_verdict(one.scale),
        pattern=_verdict(one.pattern),
        local=_verdict(one.local),
        rms=rms(one.difference),
        rms_z=rms(one.z),
    )


def _refuted(found: ModelComparison, k: int) -> list[str]:
    parts: Mapping[str, Compared | None] = {"displacement": found.displacement, "strain": found.strain}
    return [name for name, part in parts.items() if part is not None and part.refuted[k]]


def _regions(found: ModelComparison, field: Field) -> list[RegionReply]:
    out = []
    for k in range(found.tiles.count):
        inside = found.tiles.number == k
        x, y = field.x_px[inside], field.y_px[inside]
        difference = _numbers(found.displacement, _DISPLACEMENT, k, "mm")
        if found.strain is not None:
            difference |= _numbers(found.strain, _STRAIN, k, "1")
        displacement = _verdict(found.displacement.verdicts[k])
        assert displacement is not None
        cx, cy, cz = field.xyz_mm[inside].mean(axis=0).tolist()
        out.append(
            RegionReply(
                number=k,
                points=int(inside.sum()),
                rectangle_px=(float(x.min()), float(y.min()), float(x.max()), float(y.max())),
                centre_mm=(cx, cy, cz),
                difference=difference,
                displacement=displacement,
                strain=None if found.strain is None else _verdict(found.strain.verdicts[k]),
                refuted=_refuted(found, k),
            )
        )
    return out


def _numbers(one: Compared, names: tuple[str, ...], k: int, units: str) -> dict[str, ComparedNumber]:
    return {
        name: ComparedNumber(value=finite(one.tile_difference[k, c]), sigma=finite(one.tile_sigma[k, c]), units=units)
        for c, name in enumerate(names)
    }


def _variables(found: ModelComparison) -> dict[str, FileVariable]:
    """Return the comparison's variables over the grid, as result files name theirs."""
    out: dict[str, FileVariable] = {}

    def add(name: str, values: Float, units: str, text: str) -> None:
        out[name] = FileVariable(np.asarray(values), units, text, _GRID)

    parts = ((found.displacement, _DISPLACEMENT, "mm"), (found.strain, _STRAIN, "1"))
    for one, names, units in parts:
        for c, name in enumerate(names if one is not None else ()):
            assert one is not None
            add(f"model_{name}", one.model[..., c], units, f"{name} of the model, filtered as the measurement")
            add(f"difference_{name}", one.difference[..., c], units, f"{name}, measured less model")
            add(f"sigma_difference_{name}", one.sigma[..., c], units, "its standard uncertainty, common part included")
            add(f"z_{name.removesuffix('_mm')}", one.z[..., c], "1", f"difference_{name} over its standard uncertainty")
    add("model_distance_mm", found.at_points.distance_mm, "mm", "height of the point above the model's surface")
    flags = {int(state): state.name.lower() for state in MODEL_STATUS_MEANINGS}
    out["model_status"] = FileVariable(found.status, "1", "status of the point in the comparison", _GRID, flags)
    out["region"] = FileVariable(found.tiles.number, "1", "region of the verdict, -1 without", _GRID)
    bad = np.array([bool(_refuted(found, k)) for k in range(found.tiles.count)] + [False])
    out["region_refuted"] = FileVariable(
        bad[found.tiles.number].astype(np.int8), "1", "1 where the model is refuted in the region", _GRID
    )
    return out
