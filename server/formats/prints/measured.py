"""The measured ruler of a print becomes the scale of its pitch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stereorig.core.boards.board import BoardTarget
from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.target import GridTarget
from stereorig.server.formats.calibrations.target_toml import target_of
from stereorig.server.formats.prints.targets import target_text

_MOST_OFF = 0.1  # a page fitted to another paper is off by less
_MOST_SIGMA = 0.05  # what a rig file takes


@dataclass(frozen=True)
class MeasuredPrint:
    """A printed target by its measured rulers.

    Attributes
    ----------
    target
        Its description, in measured millimetres.
    scale, sigma
        Measured over nominal length, and its standard uncertainty.
    stretch
        Half the difference of both directions' scales; None if one direction was measured.
    text
        New content of its file.
    """

    target: GridTarget | BoardTarget
    scale: float
    sigma: float
    stretch: float | None
    text: str


def measured_print(
    content: Mapping[str, Any], where: str, printed_mm: Sequence[float], measured_mm: Sequence[float], u_mm: float
) -> MeasuredPrint:
    """Bring the measured scale into a printed target's description.

    Lengths of one ruler, or of the ruler across and the one down. Readings with one instrument may err alike, so that
    two of them are not taken to be better than one. Two directions of different scales leave an error of position that
    the pitch cannot have: it is added to the tolerance.

    Parameters
    ----------
    content
        Content of its ``target.toml``; a scale brought in before is replaced.
    where
        Name of the file in messages.
    printed_mm, measured_mm
        Length by the ruler's numbers, and as measured; one or two.
    u_mm
        Standard uncertainty of a measured length.

    Raises
    ------
    InputError
        ``ruler_implausible``, for lengths that no print has.
    FileFormatError
        As :func:`stereorig.server.formats.calibrations.target_toml.read_target`; ``field_invalid`` also for a file that
        describes more than a target.
    """
    found, before, added = _described(content, where)
    scales, sigma = _scales(printed_mm, measured_mm, u_mm)
    scale = float(np.mean(scales))
    stretch = 0.5 * abs(scales[0] - scales[1]) if len(scales) == 2 else None
    target = _scaled(found, scale / before, sigma)
    tolerance = max(found.node_tolerance_mm - added, 0.0)
    flatness = tolerance if stretch and found.flatness_mm is None else found.flatness_mm
    nodes = target.all_points_mm() if isinstance(target, GridTarget) else target.points_mm()
    added = (stretch or 0.0) * float(np.abs(nodes).max())
    target = replace(target, node_tolerance_mm=tolerance + added, flatness_mm=flatness)
    return MeasuredPrint(target, scale, sigma, stretch, target_text(target, scale=scale, stretch_mm=added))


def _described(content: Mapping[str, Any], where: str) -> tuple[GridTarget | BoardTarget, float, float]:
    """Return the target of a file, and scale and tolerance that were brought in before."""
    table = content.get("target", content)
    own = content.get("print", {"scale": 1.0, "stretch_mm": 0.0})
    wrong = [name for name, value in content.items() if isinstance(value, dict) and name not in ("target", "print")]
    if not isinstance(table, dict):
        wrong.append("target")
    before, added = (_stated(own, key) for key in ("scale", "stretch_mm"))
    if wrong or not (abs(before - 1.0) <= _MOST_OFF and added >= 0.0):
        field = (*wrong, "print")[0]
        raise FileFormatError(
            f"{where}: {field} is no part of a printed target's description.",
            code="field_invalid",
            remedy="Name the target.toml that was written beside the print; copy its values to the rig file.",
            field=field,
        )
    return target_of(table, where), before, added


def _stated(table: object, key: str) -> float:
    value = table.get(key) if isinstance(table, dict) else None
    return value if isinstance(value, float) else np.nan


def _scales(printed_mm: Sequence[float], measured_mm: Sequence[float], u_mm: float) -> tuple[list[float], float]:
    if len(printed_mm) != len(measured_mm) or len(measured_mm) not in (1, 2):
        raise InputError(
            f"{len(printed_mm)} printed and {len(measured_mm)} measured lengths are given.",
            code="ruler_implausible",
            remedy="Give one of each, or two: of the ruler across and of the one down.",
        )
    scales = [m / p if p > 0.0 else np.nan for m, p in zip(measured_mm, printed_mm, strict=True)]
    sigma = float(np.mean([u_mm / p if p > 0.0 else np.nan for p in printed_mm]))
    for printed, measured, scale in zip(printed_mm, measured_mm, scales, strict=True):
        if not (abs(scale - 1.0) <= _MOST_OFF and 0.0 < sigma <= _MOST_SIGMA):
            raise InputError(
                f"{printed:g} mm of the ruler were measured as {measured:g} +- {u_mm:g} mm.",
                code="ruler_implausible",
                remedy="Measure between two marks of the ruler, in mm; print again at 100 % if it is off by over 10 %.",
            )
    return scales, sigma


def _scaled(target: GridTarget | BoardTarget, by: float, sigma: float) -> GridTarget | BoardTarget:
    pitch = target.pitch_mm * by
    if isinstance(target, GridTarget):
        return replace(target, pitch_mm=pitch, line_width_mm=target.line_width_mm * by, pitch_scale_sigma=sigma)
    marker, dot = (None if one is None else one * by for one in (target.marker_mm, target.dot_diameter_mm))
    return replace(target, pitch_mm=pitch, marker_mm=marker, dot_diameter_mm=dot, pitch_scale_sigma=sigma)
