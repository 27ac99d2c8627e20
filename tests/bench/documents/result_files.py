"""The page of result files: variables as the writer declares them, status numbers, summary.json and calibration.json."""

from __future__ import annotations

import ast
import inspect
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import netCDF4
import numpy as np

from core.field.points.result import Field, References, Rejected
from core.field.points.smoothing_record import Smoothing
from core.status import STATUS_MEANINGS, PointStatus
from core.strain import STRAIN_STATUS_MEANINGS, StrainOptions, surface_strain
from server.formats.calibrations import native
from server.formats.results.summary import SequenceSummary, StepSummary
from server.formats.results.writing import Provenance, write_field
from tests.bench.documents.prose import cell
from tests.support.export_results import cuts, moved
from tests.support.gauge_field import SUBSET, make_field

REMEDIES = {
    PointStatus.OK: "",
    PointStatus.NOT_SEEDED: "Give a seed there; look for texture that repeats itself, for an island cut off by failed points.",
    PointStatus.MASKED: "Expected outside the region; within it, draw cracks and masks closer to the edge.",
    PointStatus.OUTSIDE_IMAGE: "Move the region away from the border, or use a smaller subset; with a prefilter, a narrower one.",
    PointStatus.LOW_TEXTURE: "Larger subset, better light or focus, finer speckle.",
    PointStatus.NOT_CONVERGED: "More load steps between the two states, a larger subset, or a seed nearby.",
    PointStatus.LOW_CORRELATION: "Look at the images there: glare, flaked paint, blur, an undrawn crack. A later reference may find it.",
    PointStatus.EPIPOLAR_MISMATCH: "At single points: a wrong match, nothing to do. Everywhere: the cameras moved; calibrate again.",
    PointStatus.NEIGHBOUR_MISMATCH: "A wrong match, or an isolated point; draw cracks that are not drawn.",
    PointStatus.SINGULAR: "Larger subset; texture that varies in one direction only cannot be matched.",
    PointStatus.EXTRAPOLATED: "Has numbers. Calibrate over a wider volume, or read its uncertainty, which is larger.",
}
#: what calibration.json holds, by the key at its top level
CALIBRATION = {
    "format": "`stereorig calibration`",
    "format_version": "number of the format",
    "cam1": "camera 1's eleven parameters: `phd_px` pinhole distance (focal length in column pitches), `cx_px`, `cy_px` principal point, "
    "`kappa_per_px2` distortion, `aspect`, `alpha_rad`, `beta_rad`, `gamma_rad` angles of Eq. (1), `x0_mm`, `y0_mm`, `z0_mm`; with OpenCV's lens "
    "`fx_px`, `fy_px`, `cx_px`, `cy_px`, `skew_px`, `k1` to `k6`, `p1`, `p2` in place of the first five",
    "cam2": "the same of camera 2",
    "image_size_px": "width and height by camera",
    "lens": "`model` (`paper`, `opencv5`, `opencv8`), `reasons` why it was taken, `structure` that its residuals hold: `name`, `camera` (null: the "
    "target), `terms` with `value` and `sigma`, `probability` by chance, `rms_px`",
    "stage": "`moves`; `direction_sys` of a single stage and its `direction_sigma_rad`; `scale` and `scale_sigma` of each axis; `steps` read back, "
    "with the error found",
    "pitch_scale": "relative error of the target's pitch: `value`, `sigma`; zero where it was held",
    "covariance": "`names` of the estimated parameters (with the paper's lens 20: all but the aspects) and their `matrix`, in the units of the "
    "names, squared",
    "covariance_by_cause": "parts of the covariance's matrix that add up to it: `calibration` (noise of the views, and all else), `stage` "
    "(what was known of steps, scale, tilt), `target` (of pitch, nodes)",
    "sigma": "standard uncertainty of each parameter, by its name",
    "noise_px": "standard deviation of a coordinate of a point of the target, from the residuals, by camera",
    "redundancy": "observations beyond the unknowns, by camera",
    "axis_tilt_rad": "angle between stage axis and optical axis, by camera and direction; zero where it was held",
    "axis_tilt_sigma_rad": "its standard uncertainty",
    "checks": "`fitted` and `held_out` positions: `rbe_px` (mean reprojection error), `raz_mm`, `nsce` of Eqs. (15) to (17), `points`, "
    "`per_camera`, `against_nominal_grid`; `made`: each check by name, with its outcome",
    "verdict": "`level`: `good`, `warning` or `failed`, by the held-out reprojection error; `reasons` in sentences",
    "uncertainty": "of a shape, from the covariance: `shape_rms_mm` over the target's volume, `scale` (relative), `centre_z_mm`, `corner_z_mm`; "
    "`predicted_shape_rms_mm` was expected before the fit",
    "views": "each image: `name`, `camera`, `dz_mm` or the free pose's number `frame`, `held_out`, `rbe_px`, `raz_mm`, `nsce`, "
    "`cam_from_target` (`rotation_vector_rad`, `translation_mm`)",
    "dropped": "free poses that were left out: `name`, `camera`, `frame`, `reason`",
    "target": "the target, as in the target file, with its `kind`",
    "node_corrections_mm": "corrections of the target's points that the fit found, X and Y, with free poses Z; null for an exact target",
    "node_sigma_mm": "their standard uncertainty",
    "nominal": "the nominal cameras that the fit started from",
    "settings": "settings of the fit",
    "provenance": "software version, localiser, hashes of the views, identity of the cameras",
}
#: what `calibration repair` adds to it
REPAIRED = {
    "repair": "of a repaired calibration alone: the change of camera 2's orientation (`change_deg`, its covariance), images and old file with "
    "their SHA-256, offset before and after, consequence, limits"
}
_HEAD = """# Result files

A measurement writes one folder: `step_0000.nc` (shape of the reference step), `step_0001.nc` and so on (displacement since
then), and `summary.json`. The files are NetCDF-4 (which is HDF5), one a load step, dimensions `row`, `col`: the grid of
points. A value that is not known is NaN in the file and `null` in JSON, never zero. Beside each file lies its checksum
(`sha256sum -c`). Written by `make reference`.

```python
import xarray

step = xarray.open_dataset("result/step_0001.nc")
step["w_mm"].where(step["status"] == 0).plot()
```

```matlab
w = ncread('result/step_0001.nc', 'w_mm');    % col by row in MATLAB
```

`covariance` is the total: of the point's own matching, and of the calibration as F F' (`common_factor`, unit causes). Two points
or steps share the second part, so that

```python
total = np.zeros((*covariance.shape[:2], 6, 6))  # packed: the upper triangle, row by row
i, j = np.triu_indices(6)
total[..., i, j] = total[..., j, i] = covariance
own_a, own_b = total[a] - F[a] @ F[a].T, total[b] - F[b] @ F[b].T
variance_of_b_minus_a = own_a + own_b + (F[b] - F[a]) @ (F[b] - F[a]).T  # apart by a subset or more
```

Between two steps of a test the columns of F that have the same `cause`, counted from the first of that cause, are the same; where a
step has fewer, they are zero. There take `reference_covariance` (of U, V, W) of both steps from `own_a + own_b`.

Without `common_factor` the calibration's covariance is not known, and its part not included (attribute `includes`).

For ParaView: `stereorig export result --format vtu --out out`, then open the `.pvd`. Other forms: [exports](exports.md).

## Axes

Positions and displacements are in the system frame: origin in the centre of the calibration grid, X_sys to the right and down
in the image, Y_sys to the left and down, Z_sys away from the cameras. The attribute `frame` says so; with a calibration of
another program the frame is camera 1's own. Axis 1 of strain (`exx`) is X_sys projected on the reference surface, axis 2 (`eyy`)
completes it with the normal that points away from camera 1; `exy` is the tensor's shear, half of the engineering shear. For other
axes: `stereorig gauge --align ... --field-out DIR` ([gauges](gauges.md)).
"""


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


def _summary() -> list[str]:
    lines = ["| key | meaning |", "| --- | --- |"]
    for names, meaning in _attributes(SequenceSummary).items():
        lines.append(f"| {', '.join(f'`{name}`' for name in names.split(', '))} | {_sentence(meaning)} |")
    lines += ["", "An entry of `steps`; `n` is the number of the load step:", "", "| key | meaning |", "| --- | --- |"]
    for names, meaning in _attributes(StepSummary).items():
        lines.append(f"| {', '.join(f'`{name}`' for name in names.split(', '))} | {_sentence(meaning)} |")
    return lines


def _sentence(text: str) -> str:
    return cell(re.sub(r":class:`core\.settings\.\w+`", "the [analysis settings](settings.md)", text))


def written_keys() -> set[str]:
    """Return the keys at the top of calibration.json, as its writer has them."""
    function = ast.parse(inspect.getsource(native.calibration_content)).body[0]
    document = next(n.value for n in ast.walk(function) if isinstance(n, ast.Return) and isinstance(n.value, ast.Dict))
    return {str(key.value) for key in document.keys if isinstance(key, ast.Constant)}


def pages() -> dict[str, str]:
    """Return the page by its path below docs/reference."""
    lines = [
        _HEAD,
        "## Variables of `step_*.nc`",
        "",
        "| variable | dimensions | unit | meaning |",
        "| --- | --- | --- | --- |",
    ]
    units = {"pixel": "px", "pixel2": "px^2", "mm2": "mm^2", "mm-1": "1/mm", "count": "grey levels"}
    lines += [f"| `{n}` | {d} | {units.get(u, u)} | {cell(meaning)} |" for n, d, u, meaning in variables()]
    lines += [
        "",
        "Smoothed displacements replace `u_mm`, `v_mm`, `w_mm`; `measured_*` hold them as measured, only where that differs. Attributes of",
        "the file: `kind` (`shape` or `displacement`), `step`, `reference_step`, `frame`, `settings` (JSON), `inputs_sha256`, `patch`,",
        "`patch_reason`, `systematic` (as in `summary.json`, JSON), `software_version`, `environment` (versions, hash of the "
        "code, processor, JSON), `created`, `format_version`. A [dense field](../how_to/fields/dense_fields.md) has `method`, `dense`",
        "(JSON) and `neighbours` besides.",
        "",
        "## Point status",
        "",
        "| status | name | meaning | remedy |",
        "| --- | --- | --- | --- |",
    ]
    lines += [f"| {s.value} | `{s.name.lower()}` | {cell(STATUS_MEANINGS[s])} | {REMEDIES[s]} |" for s in PointStatus]
    lines += ["", "Points with status 0 and 10 have numbers; all others are NaN.", "", "### Strain status", ""]
    lines += ["| status | name | meaning |", "| --- | --- | --- |"]
    lines += [f"| {s.value} | `{s.name.lower()}` | {cell(text)} |" for s, text in STRAIN_STATUS_MEANINGS.items()]
    lines += ["", "## `summary.json`", "", *_summary()]
    lines += ["", "## `calibration.json`", "", "| key | content |", "| --- | --- |"]
    lines += [f"| `{key}` | {cell(text)} |" for key, text in (CALIBRATION | REPAIRED).items()]
    lines += [
        "",
        "A file with `cam1` and `cam2` alone is enough to measure with. The verdict goes by the held-out reprojection error: `good` to 0.1 px,",
        "`warning` to 0.3 px, else `failed` ([method](../explanation/method.md#calibration)).",
    ]
    return {"result_files.md": "\n".join(lines) + "\n"}
