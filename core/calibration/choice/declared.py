"""Declared quantities as held unknowns: pitch, stages' scales, aspect ratio, positions read back, a target at rest.

A rig with a stage measures a millimetre twice, by the target's pitch and by the stage's travel, and obliquity ties the
aspect ratio to both. Contradictions between these are absorbed by a lens with enough terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.adjust import Adjustment
from stereorig.core.calibration.fit.layout import Layout
from stereorig.core.calibration.fit.model import Linearised
from stereorig.core.calibration.fit.observations import ViewRows

SCALE, SCALES, ASPECT, ASPECTS = "stage over pitch", "stages over pitch", "aspect ratio", "aspect ratios"
POSITIONS, MOVED, AXES = "positions", "moved target", "stage axes"
#: a stage's pitch, yaw and roll, in proportion to its travel
TURNS = "stage turns"
#: the contradiction of two measures of a millimetre; one number explains any of these nearly as well
SCALE_GROUPS = (SCALE, ASPECT, SCALES, ASPECTS)
DECLARED = (*SCALE_GROUPS, AXES, TURNS, POSITIONS, MOVED)


@dataclass(frozen=True)
class DeclaredTerms:
    """Terms of declared quantities.

    Attributes
    ----------
    groups
        Name, terms and columns of each group that can be asked for.
    columns, values
        For each view the places of its terms and the derivatives (n, 2, q) of its image.
    count
        Number of terms.
    """

    groups: tuple[tuple[str, tuple[str, ...], NDArray[np.intp]], ...]
    columns: tuple[NDArray[np.intp], ...]
    values: tuple[Float, ...]
    count: int


def declared_terms(
    adjustment: Adjustment, views: Sequence[ViewRows], lins: Sequence[Linearised], nominal_nodes_mm: Float, first: int
) -> DeclaredTerms:
    """Return the terms of a stage's views; of free poses alone there are none.

    Parameters
    ----------
    adjustment
        The minimum.
    views, lins, nominal_nodes_mm
        Its views, their derivatives there, and nominal points (n, 3).
    first
        Place of the first term.
    """
    layout = adjustment.layout
    if not layout.steps:
        none = np.zeros(0, dtype=np.intp)
        return DeclaredTerms((), (none,) * len(views), tuple(np.zeros((len(v.found), 2, 0)) for v in views), 0)
    positions = [sorted({v.dz_mm for v in views if v.camera == c and v.dz_mm is not None}) for c in range(2)]
    axes = sorted({axis for axis, _ in layout.steps})
    # a turn about each axis of the target displaces its points by these
    arms = np.stack([np.cross(axis, nominal_nodes_mm) for axis in np.eye(3)], axis=-1)
    arms /= max(abs(dz) for _, dz in layout.steps) or 1.0
    rows = [_of_view(layout, view, lin, positions, arms) for view, lin in zip(views, lins, strict=True)]
    groups: list[tuple[str, tuple[str, ...]]] = [(SCALE, ("pitch",))]
    # an aspect ratio that the views are free to find contradicts nothing
    if not layout.frames:
        groups.append((ASPECT, ("aspect",)))
        groups.append((ASPECTS, ("aspect 1", "aspect 2")))
    if len(axes) > 1:
        groups.append((SCALES, tuple(f"stage {axis + 1}" for axis in axes)))
    if layout.moves == "cameras":
        groups.append((AXES, tuple(f"{way} tilt {c + 1}" for c in range(2) for way in "xy")))
    groups.append((TURNS, tuple(f"turn {way} {axis + 1}" for axis in axes for way in "XYZ")))
    groups.append((POSITIONS, tuple(position_name(*step) for step in layout.steps)))
    if len(positions[0]) == len(positions[1]):
        groups.append((MOVED, tuple(f"{way} {k}" for k in range(1, len(positions[0])) for way in "XY")))
    names = [name for _, own in groups for name in own]
    place = {name: first + k for k, name in enumerate(names)}
    columns, values = [], []
    for view, row in zip(views, rows, strict=True):
        own = {name: value for name, value in row.items() if name in place}
        stacked = np.stack(list(own.values()), axis=-1)
        stacked[~view.found] = 0.0
        columns.append(np.array([place[name] for name in own], dtype=np.intp))
        values.append(stacked)
    return DeclaredTerms(
        tuple((name, own, np.array([place[k] for k in own], dtype=np.intp)) for name, own in groups),
        tuple(columns),
        tuple(values),
        len(names),
    )


def position_name(axis: int, dz_mm: float) -> str:
    """Name of the error of a position read back."""
    return f"axis {axis + 1} at {dz_mm:+.3f} mm"


def _of_view(
    layout: Layout, view: ViewRows, lin: Linearised, positions: Sequence[Sequence[float]], arms: Float
) -> dict[str, Float]:
    """Return derivatives (n, 2) of a view's image over the terms that it feels, by their names."""
    at = {int(k): lin.by_unknown[..., j] for j, k in enumerate(lin.columns)}
    aspect = at[layout.lens(view.camera).stop - 1]
    out = {"pitch": at[layout.pitch_scale], "aspect": aspect, f"aspect {view.camera + 1}": aspect}
    if view.dz_mm is None:
        return out
    axis = layout.axis_of(view.camera)
    out[f"stage {axis + 1}"] = at[layout.stage_scale(axis)]
    if layout.moves == "cameras":
        first = layout.tilt(view.camera).start
        out.update({f"{way} tilt {view.camera + 1}": at[first + k] for k, way in enumerate("xy")})
    turned = view.dz_mm * (lin.by_node @ arms)
    out.update({f"turn {way} {axis + 1}": turned[..., k] for k, way in enumerate("XYZ")})
    step = layout.step(axis, view.dz_mm)
    if step is not None:
        out[position_name(axis, view.dz_mm)] = at[step]
    k = positions[view.camera].index(view.dz_mm)
    if k:
        out[f"X {k}"], out[f"Y {k}"] = lin.by_node[..., 0], lin.by_node[..., 1]
    return out
