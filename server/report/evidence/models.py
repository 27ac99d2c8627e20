"""The models that are kept with a test, compared with the last step: verdict, map of z, regions refuted."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stereorig.core.errors import StereorigError
from stereorig.server.report.items import UM, UM_PER_M
from stereorig.server.report.page import PNG, PagePicture
from stereorig.server.report.pictures import field_map
from stereorig.server.report.source import Source
from stereorig.server.results.models.compare import compare_files
from stereorig.server.results.models.document import FieldVerdict, ModelComparisonReply, RegionReply
from stereorig.server.results.models.request import CompareRequest
from stereorig.server.store.durable import known_json
from stereorig.server.store.models import FOLDER, check_file_name

_MOST = 3  # models, the newest
_SHOWN = 20  # refuted regions
_NAMES = (("u_mm", "U"), ("v_mm", "V"), ("w_mm", "W"), ("exx", "exx"), ("eyy", "eyy"), ("exy", "exy"))


@dataclass(frozen=True)
class QuantityRow:
    """A quantity's row: its name, verdict, probability, root mean squares with units."""

    name: str
    accepted: bool
    probability: float | None
    text: str


@dataclass(frozen=True)
class ModelPart:
    """A model compared with a step.

    Attributes
    ----------
    name
        Name of its file.
    problem
        Reason why it could not be compared; empty if it was.
    found
        The comparison's document.
    rows
        By quantity.
    regions
        The refuted ones: rectangle, quantity, the largest deviation.
    pictures
        Maps of z.
    """

    name: str
    problem: str = ""
    found: ModelComparisonReply | None = None
    rows: list[QuantityRow] = field(default_factory=list)
    regions: list[tuple[str, str, str]] = field(default_factory=list)
    pictures: list[PagePicture] = field(default_factory=list)


def compared_models(source: Source) -> list[ModelPart]:
    """Return a part for each model that is kept with the test; none for results alone or a shape."""
    if source.test is None or not any(head.kind == "displacement" for head in source.heads.values()):
        return []
    folders = sorted(path.parent for path in (source.test / FOLDER).glob("m*/model.json"))
    return [_part(source, folder) for folder in folders[-_MOST:]]


def _part(source: Source, folder: Path) -> ModelPart:
    record = known_json(folder / "model.json")
    name = str(record.get("name", folder.name))
    stored = source.stored or source.files
    try:
        request = CompareRequest.model_validate(record.get("reading", {}))
        model = folder / check_file_name(str(record.get("file")))
        step = compare_files(list(stored.values()), model, request, model_name=name)
    except (StereorigError, ValueError) as error:
        return ModelPart(name, problem=str(error))
    found, differences = step.document, step.comparison
    component = max(range(3), key=lambda k: _extent(differences.displacement.model[..., k]))
    label = "UVW"[component]
    z = differences.displacement.z[..., component]
    caption = f"{name}: measured less model, {label} over its standard uncertainty, step {found.step}"
    picture = field_map(step.comparison.at_points.field, z, f"z_{label.lower()}", caption, unit=(1.0, "1"))
    return ModelPart(
        name,
        found=found,
        rows=_rows(found),
        regions=[_refuted(found.regions[k]) for k in found.refuted[:_SHOWN]],
        pictures=[PagePicture(picture, PNG, f"Map of z of {label}", caption)],
    )


def _extent(values: np.ndarray) -> float:
    held = values[np.isfinite(values)]
    return float(np.ptp(held)) if held.size else 0.0


def _rows(found: ModelComparisonReply) -> list[QuantityRow]:
    out = [_row("displacement", found.displacement, 1e3, "\u00b5m")]
    if found.strain is not None:
        out.append(_row("strain", found.strain, 1e6, UM_PER_M))
    return out


def _row(name: str, one: FieldVerdict, scale: float, unit: str) -> QuantityRow:
    parts = [
        f"{label} {scale * rms:.3g} {unit} ({z:.2f})"
        for key, label in _NAMES
        if (rms := one.rms.get(key)) is not None and (z := one.rms_z.get(key)) is not None
    ]
    return QuantityRow(name, one.accepted, one.overall.probability, ", ".join(parts))


def _refuted(region: RegionReply) -> tuple[str, str, str]:
    x0, y0, x1, y1 = region.rectangle_px
    worst, text = 0.0, ""
    for key, label in _NAMES:
        number = region.difference.get(key)
        if number is None or number.value is None or not number.sigma:
            continue
        z = abs(number.value) / number.sigma
        if z > worst:
            scale, unit = (1e3, UM) if number.units == "mm" else (1e6, UM_PER_M)
            worst = z
            text = f"{label} off by {scale * number.value:.3g} \u00b1 {scale * number.sigma:.2g} {unit}"
    return f"{x0:g}, {y0:g} to {x1:g}, {y1:g} px", " and ".join(region.refuted), text
