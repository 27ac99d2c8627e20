"""The lists of result files: variables as the writer declares them, status numbers, keys of the summary."""

from __future__ import annotations

import ast
import inspect
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import netCDF4
import numpy as np

from docs.built.tables import cell, table
from stereorig.core.field.points.result import Field, References, Rejected
from stereorig.core.field.points.smoothing_record import Smoothing
from stereorig.core.status import STATUS_MEANINGS, PointStatus
from stereorig.core.strain import STRAIN_STATUS_MEANINGS, StrainOptions, surface_strain
from stereorig.server.formats.calibrations import native
from stereorig.server.formats.results.summary import SequenceSummary, StepSummary
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.export_results import cuts, moved
from tests.support.gauge_field import SUBSET, make_field

REMEDIES = {
    PointStatus.OK: "",
    PointStatus.NOT_SEEDED: "Give a seed there; look for texture that repeats itself, for an island cut off by failed points.",
    PointStatus.MASKED: "Expected outside the region; within it, draw cracks and masks closer to the edge.",
    PointStatus.OUTSIDE_IMAGE: "Move the region away from the border, or use a smaller subset; with a prefilter, a narrower one. In a step: the surface left the view.",
    PointStatus.LOW_TEXTURE: "Larger subset, better light or focus, finer speckle.",
    PointStatus.NOT_CONVERGED: "More load steps between the two states, a larger subset, or a seed nearby.",
    PointStatus.LOW_CORRELATION: "Look at the images there: glare, flaked paint, blur, an undrawn crack. A later reference may find it.",
    PointStatus.EPIPOLAR_MISMATCH: "At single points: a wrong match, nothing to do. Everywhere: the cameras moved; calibrate again.",
    PointStatus.NEIGHBOUR_MISMATCH: "A wrong match, or an isolated point; draw cracks that are not drawn.",
    PointStatus.SINGULAR: "Larger subset; texture that varies in one direction only cannot be matched.",
    PointStatus.SIGMA_TOO_LARGE: "Focus and exposure of the blurred or saturated camera, or a larger subset; `max_sigma_px` keeps more.",
    PointStatus.EXTRAPOLATED: "Has numbers. Calibrate over a wider volume, or read its uncertainty, which is larger.",
}


def _everything() -> tuple[Field, Field]:
    """Return a displacement field that has all that a field can have, and the same as measured before smoothing."""
    field = make_field(moved(1.0), cuts=cuts())
    some = np.zeros((*field.shape, 2, 2))
    references = References(1, np.ones(field.shape, np.int32), some, some)
    smoothing = Smoothing(
        window=5,
        spacing_px=7.0,
        subset_px=float(SUBSET),
        resolution_px=49.0,
        resolution_mm=None,
        whole=1,
        reduced=0,
        raw=0,
    )
    common, frozen = np.zeros((*field.shape, 6, 1)), np.zeros((*field.shape, 3, 3))
    rejected = Rejected(field.xyz_mm, field.uvw_mm, field.zncc, field.epipolar_px)
    field = replace(
        field,
        curvature_per_mm=np.zeros((*field.shape, 2)),
        patch_degree=np.ones(field.shape, np.int8),
        references=references,
        common=common,
        frozen=frozen,
        rejected=rejected,
    )
    return replace(field, smoothing=smoothing, covariance=2.0 * field.covariance), field


def variables() -> list[tuple[str, str, str, str]]:
    """Return name, dimensions, unit and meaning of every variable that a result file can hold."""
    shown, measured = _everything()
    strain = surface_strain(measured, StrainOptions(), subset_px=SUBSET)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step_0001.nc"
        provenance = Provenance(settings={}, inputs={}, software_version="0", step=1)
        write_field(path, shown, provenance, strain, measured=measured)
        with netCDF4.Dataset(path) as dataset:
            return [
                (name, ", ".join(v.dimensions), v.units, v.long_name.removesuffix(", smoothed"))
                for name, v in dataset.variables.items()
            ]


def _attributes(model: type) -> dict[str, str]:
    """Return the documented attributes of a class: their names, and their description in its docstring."""
    text = inspect.getdoc(model) or ""
    found = {}
    for names, meaning in re.findall(
        r"^(\w[\w, ]*)\n((?:    .*\n?)+)", text.partition("----------\n")[2], re.MULTILINE
    ):
        found[names] = " ".join(meaning.split()).replace("``", "`")
    return found


def variables_table() -> str:
    """Return the variables of a step's file, as the writer declares them."""
    units = {"pixel": "px", "pixel2": "px^2", "mm2": "mm^2", "mm-1": "1/mm", "count": "grey levels"}
    rows = [(f"`{name}`", dimensions, units.get(u, u), cell(text)) for name, dimensions, u, text in variables()]
    return table(("variable", "dimensions", "unit", "meaning"), rows)


def point_status() -> str:
    """Return the status numbers of points, with remedies."""
    rows = [(f"{s.value}", f"`{s.name.lower()}`", cell(STATUS_MEANINGS[s]), REMEDIES[s]) for s in PointStatus]
    return table(("status", "name", "meaning", "remedy"), rows)


def strain_status() -> str:
    """Return those of strain."""
    rows = [(f"{s.value}", f"`{s.name.lower()}`", cell(text)) for s, text in STRAIN_STATUS_MEANINGS.items()]
    return table(("status", "name", "meaning"), rows)


def summary() -> str:
    """Return the keys of summary.json, then those of its steps."""
    steps = "An entry of `steps`; `n` is the number of the load step:"
    return "\n\n".join([_documented(SequenceSummary), steps, _documented(StepSummary)])


def _documented(model: type) -> str:
    rows = [
        (", ".join(f"`{name}`" for name in names.split(", ")), _sentence(text))
        for names, text in _attributes(model).items()
    ]
    return table(("key", "meaning"), rows)


def _sentence(text: str) -> str:
    return cell(re.sub(r":class:`core\.settings\.\w+`", "the [analysis settings](settings.md)", text))


def written_keys() -> set[str]:
    """Return the keys at the top of calibration.json, as its writer has them."""
    function = ast.parse(inspect.getsource(native.calibration_content)).body[0]
    document = next(n.value for n in ast.walk(function) if isinstance(n, ast.Return) and isinstance(n.value, ast.Dict))
    return {str(key.value) for key in document.keys if isinstance(key, ast.Constant)}
