"""Reading result files back, see :mod:`stereorig.server.formats.results.writing`."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.common.factor import Causes
from stereorig.core.errors import FileFormatError
from stereorig.core.field.points.patch import PatchChoice
from stereorig.core.field.points.result import Field, References
from stereorig.core.field.points.smoothing_record import DenseRecord, Smoothing
from stereorig.core.field.region.cuts import Cuts, from_arrays
from stereorig.core.names import ALL_CAUSES, CameraName
from stereorig.core.status import PointStatus
from stereorig.server.formats.results.layout import ENTRIES, FORMAT_VERSION, PROPAGATED_FROM, unpacked
from stereorig.server.formats.results.netcdf import opened
from stereorig.server.formats.results.variables import CURVATURE, MOTION, SHAPE, Of


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    with opened(path) as dataset:
        version = int(getattr(dataset, "format_version", 0))
        if version == 0:
            raise FileFormatError(f"{path} is no result of this program: it states no format.", code="file_unreadable")
        if version != FORMAT_VERSION:
            raise FileFormatError(
                f"{path} has the result format {version}; this program reads {FORMAT_VERSION}.",
                code="format_too_old" if version < FORMAT_VERSION else "format_too_new",
                remedy="Read it with the program's version that wrote it, or measure the images again.",
            )
        yield dataset


def read_field(path: str | Path) -> Field:
    """Read one result file back.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable`` (not such a file, a variable missing), ``format_too_old`` or
        ``format_too_new``.
    """
    path = Path(path)
    with _opened(path) as dataset:
        variables = dataset.variables
        shape = (dataset.dimensions["row"].size, dataset.dimensions["col"].size)
        curved = CURVATURE if CURVATURE[0].name in variables else ()
        wanted = SHAPE + (MOTION if dataset.kind == "displacement" else ()) + curved
        names = [v.name for v in wanted] + ["status", "iterations", "zncc", "covariance"]
        missing = [name for name in names if name not in variables]
        if missing:
            raise FileFormatError(f"{path} lacks the variables {', '.join(missing)}.")
        arrays: dict[str, Any] = {}
        for v in wanted:
            values = np.asarray(variables[v.name][...], dtype=np.float64)
            at = v.values
            assert isinstance(at, Of)
            if at.component is None:
                arrays[at.attribute] = values
            else:
                tail = len(CURVATURE) if v in CURVATURE else 3
                arrays.setdefault(at.attribute, np.full((*shape, tail), np.nan))[..., at.component] = values
        total = np.asarray(variables["covariance"][...], dtype=np.float64)
        if total.ndim == 3:  # packed
            total = unpacked(total, 6)
        common, causes = None, None
        if "common_factor" in variables:
            common = np.asarray(variables["common_factor"][...], dtype=np.float64)
            total = total - common @ np.swapaxes(common, -1, -2)
            causes = causes_of(variables, common.shape[-1])
        choice, smoothing, dense = (getattr(dataset, name, None) for name in ("patch_choice", "smoothing", "dense"))
        return Field(
            **arrays,
            status=np.asarray(variables["status"][...], dtype=np.int8),
            iterations=np.asarray(variables["iterations"][...], dtype=np.int32),
            zncc=np.asarray(variables["zncc"][...], dtype=np.float64),
            covariance=total,
            common=common,
            causes=causes,
            frozen=_frozen_of(variables),
            smoothing=None if smoothing is None else Smoothing.from_document(json.loads(smoothing)),
            patch=None if choice is None else PatchChoice.from_document(json.loads(choice)),
            cuts=_cuts_of(variables),
            dense=None if dense is None else DenseRecord.from_document(json.loads(dense)),
            references=_references_of(dataset),
            patch_degree=(
                np.asarray(variables["patch_degree"][...], dtype=np.int8) if "patch_degree" in variables else None
            ),
        )


def read_measured(path: str | Path) -> Field:
    """Read a result file back as it was measured: before smoothing, and before points outside the volume were marked.

    Raises
    ------
    FileFormatError
        As :func:`read_field`.
    """
    field = read_field(path)
    with _opened(Path(path)) as dataset:
        read = {
            name: np.asarray(v[...], dtype=np.float64)
            for name, v in dataset.variables.items()
            if name.startswith("measured_")
        }
    if field.smoothing is not None:
        if "measured_u_mm" not in read:
            raise FileFormatError(f"{path} holds a smoothed displacement only; later steps cannot continue from it.")
        uvw = np.stack([read[f"measured_{name}_mm"] for name in ("u", "v", "w")], axis=-1)
        field = replace(field, uvw_mm=uvw, smoothing=None)
    covariance = read.get("measured_covariance", field.covariance)
    if "measured_current_covariance" in read:  # later steps start from it, exactly: the other parts are as they are
        now, both = unpacked(read["measured_current_covariance"], 3), covariance[..., :3, 3:]
        covariance = covariance.copy()
        covariance[..., 3:, 3:] = now - (covariance[..., :3, :3] + (both + np.swapaxes(both, -1, -2)))
    status = np.where(field.status == PointStatus.EXTRAPOLATED, PointStatus.OK, field.status).astype(np.int8)
    return replace(field, covariance=covariance, common=None, causes=None, frozen=None, status=status)


@dataclass(frozen=True)
class ResultHead:
    """Head of a result file: its attributes.

    Attributes
    ----------
    step, kind, label, load_n
        The step's number, kind (``shape`` or ``displacement``), label and load in N.
    frame, created, software_version
        As written.
    reference_step
        The step that this one was matched against; None for a shape.
    settings, inputs_sha256
        As written.
    attributes
        All global attributes, as they are stored.
    """

    step: int
    kind: str
    label: str
    load_n: float | None
    frame: str
    created: str
    software_version: str
    reference_step: int | None
    settings: dict[str, Any]
    inputs_sha256: dict[str, str]
    attributes: Mapping[str, object]

    def image_file(self, cam: CameraName) -> str:
        """Path of the step's image; empty where the file does not state it."""
        return str(self.attributes.get(f"{cam}_file", ""))


def read_head(path: str | Path) -> ResultHead:
    """Read a result file's attributes.

    Raises
    ------
    FileFormatError
        As :func:`read_field`.
    """
    path = Path(path)
    with _opened(path) as dataset:
        recorded: dict[str, Any] = {name: dataset.getncattr(name) for name in dataset.ncattrs()}
    return ResultHead(
        step=int(recorded.get("step", 0)),
        kind=str(recorded.get("kind", "")),
        label=str(recorded.get("label", "")),
        load_n=_number(recorded.get("load_n")),
        frame=str(recorded.get("frame", "")),
        created=str(recorded.get("created", "")),
        software_version=str(recorded.get("software_version", "")),
        reference_step=int(recorded["reference_step"]) if "reference_step" in recorded else None,
        settings=json.loads(recorded.get("settings", "{}")),
        inputs_sha256=json.loads(recorded.get("inputs_sha256", "{}")),
        attributes=recorded,
    )


def _number(text: object) -> float | None:
    try:
        return float(str(text))
    except ValueError:
        return None


def _references_of(dataset: Any) -> References | None:
    variables = dataset.variables
    if "reference_step" not in variables:
        return None
    steps = np.asarray(variables["reference_step"][...], dtype=np.int32)
    values: dict[str, NDArray[np.float64]] = {}
    for origin in PROPAGATED_FROM:
        values[origin] = np.full((*steps.shape, 2, 2), np.nan)
        for name, (i, j) in ENTRIES.items():
            read = np.asarray(variables[f"propagated_{origin}_{name}_px2"][...], dtype=np.float64)
            values[origin][..., i, j] = values[origin][..., j, i] = read
    return References(int(dataset.reference_step), steps, values["noise"], values["pattern"])


def causes_of(variables: Any, count: int) -> Causes:
    """Return the causes of the columns of an open result file's common factor, which has so many."""
    if "cause" not in variables:  # a field whose common part was not split by cause
        return Causes.unseparated(count)
    names = [str(name) for name in variables["cause"][...]]
    told = str(getattr(variables["common_factor"], "causes", "calibration")).split()
    columns = [cause for name in names for cause in ALL_CAUSES if cause == name]
    if len(columns) != count:
        raise FileFormatError(f"The causes {', '.join(names)} of a result file are not known to this program.")
    return Causes(tuple(columns), tuple(cause for cause in ALL_CAUSES if cause in told))


def _frozen_of(variables: Any) -> NDArray[np.float64] | None:
    if "reference_covariance" not in variables:
        return None
    return unpacked(np.asarray(variables["reference_covariance"][...], dtype=np.float64), 3)


def _cuts_of(variables: Any) -> Cuts | None:
    if "cut_line" not in variables:
        return None
    points = np.stack([np.asarray(variables[name][...], dtype=np.float64) for name in ("cut_x_px", "cut_y_px")], axis=1)
    return from_arrays(points, np.asarray(variables["cut_line"][...], dtype=np.int32))
