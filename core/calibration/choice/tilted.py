"""Stages off the optical axes, tilted sensors, thin prisms: alike in the views of a stage, and not in the shape.

To first order a tilted sensor is a camera whose stage is off its axis, and a prism is one that is decentred, too. With
distortion they lead to shapes that differ by the square of the tilt. If the views show some tilt, a lens with a tilt
and stages with open axes fit in all cases, and their covariance contains the directions that the views do not separate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.choice.declared import AXES, SCALE_GROUPS
from stereorig.core.calibration.choice.screening import Screened
from stereorig.core.calibration.choice.structure import Group, Structure
from stereorig.core.calibration.fit.layout import camera_of
from stereorig.core.calibration.fit.lens_form import LensName
from stereorig.core.calibration.fit.named import named_covariance, parameter_names
from stereorig.core.calibration.fit.problem import FitData
from stereorig.core.calibration.uncertainty import point_derivatives, shape_of
from stereorig.core.cameras.opencv_full import OpenCVFullLens
from stereorig.core.cameras.stereo import StereoPair

#: the lens that contains a possible tilt, by the model chosen from the views
TILTED: dict[LensName, LensName] = {
    "paper": "opencv5_tilted",
    "opencv5": "opencv5_tilted",
    "opencv5_prism": "opencv5_tilted",
    "opencv8": "opencv14",
    "opencv12": "opencv14",
}
#: the same lenses without the tilt
UNTILTED: dict[LensName, LensName] = {"opencv5_tilted": "opencv5", "opencv14": "opencv12"}
#: structure that a tilted sensor may leave under a lens without one
LIKE_A_TILT = {"decentring", "radial", "higher radial", "thin prism", "aspect", "skew", "unequal pitch", "smooth"}
_BY_HAND_RAD = 0.02  # a stage put up by eye is within about a degree of the optical axis
_MOUNTED_RAD = 0.01  # makers of cameras state half a degree for a sensor in its mount
_ALIGNED_RAD = 4e-3  # four standard deviations of a careful alignment, independent of the declared one
_AS_GOOD = 13.28  # gain in the sum of squares: chance reaches this with four unknowns once in a hundred


def has_own_stages(found: Screened) -> bool:
    """Return True if each camera travels on a stage of its own."""
    layout = found.adjustment.layout
    return layout.moves == "cameras" and bool(layout.steps)


def may_be_tilted(found: Screened, contradicted: Sequence[tuple[Structure, Group]]) -> bool:
    """Return True if stages off the axes, tilts or prisms were found that the views of a stage may have confused."""
    layout = found.adjustment.layout
    names = [group.name for _, group in contradicted]
    if not has_own_stages(found) or any(name in SCALE_GROUPS for name in names):
        return False
    tilts = [found.adjustment.state.x[layout.tilt(c)] for c in range(2)]
    off = max(float(np.linalg.norm(t)) for t in tilts)
    bent = {"s1", "tau_x_rad"} & set(layout.form.distortion_names)
    return AXES in names or bool(bent) or off > _ALIGNED_RAD


def as_tilts(tilted: Screened, scaled: Screened) -> str:
    """Return the tilts that explain no less than other scales do, as a sentence; empty if they explain less.

    Parameters
    ----------
    tilted
        The fit with tilted sensors, of stages of their own.
    scaled
        That without, and with open scales.
    """
    one = tilted.adjustment
    if _leaves_more(tilted, scaled):
        return ""
    sizes: list[str] = []
    for c in range(2):
        lens = camera_of(one.layout, one.state.x, c).lens
        assert isinstance(lens, OpenCVFullLens)
        sizes.append(f"{1e3 * float(np.hypot(lens.tau_x_rad, lens.tau_y_rad)):.1f}")
    return f"Sensors tilted by {' and '.join(sizes)} mrad would leave them, too."


def _leaves_more(tilted: Screened, other: Screened) -> bool:
    """Return True if a fit with tilted sensors leaves a larger sum of squares than another, beyond chance."""
    one, two = tilted.adjustment, other.adjustment
    squares = two.redundancy * (one.noise_px / two.noise_px) ** 2
    return float(squares.sum() - two.redundancy.sum()) > _AS_GOOD


def with_open_axes(problem: FitData, found: Screened) -> FitData:
    """Return the problem with a prior on the stages' axes as wide as an alignment by eye."""
    off = max(float(np.abs(found.adjustment.state.x[found.adjustment.layout.tilt(c)]).max()) for c in range(2))
    sigma = max(problem.options.axis_tilt_sigma_rad, _BY_HAND_RAD, off)
    options = replace(problem.options, axis_tilt_sigma_rad=sigma)
    return replace(problem, options=options, sensor_tilt_sigma_rad=_MOUNTED_RAD)


def moved_by_tilt(found: Screened, tilted: Screened) -> float | None:
    """Return the shape's change by a tilted sensor, mm rms; None if it explains less or moves less than reported.

    Parameters
    ----------
    found
        The minimum without it.
    tilted
        The minimum with a tilted sensor and open axes.
    """
    one, two = found.adjustment, tilted.adjustment
    if _leaves_more(tilted, found):
        return None
    pairs = [StereoPair(*(camera_of(a.layout, a.state.x, c) for c in range(2))) for a in (one, two)]
    nodes = found.problem.flat_nodes_mm
    depth = np.array([0.0, 0.0, 0.25 * float(np.abs(nodes).max())])
    points = np.concatenate([nodes - depth, nodes, nodes + depth])
    images: list[Float] = [c.project(points).xy for c in (pairs[0].cam1, pairs[0].cam2)]
    moved = shape_of(points, (pairs[1].triangulate(*images).xyz_mm - points).reshape(-1, 1))
    names = parameter_names(one.layout, one.priors)
    own = named_covariance(one.layout, one.priors, one.state.x, one.covariance)
    shape = shape_of(points, point_derivatives(pairs[0], points, names).reshape(-1, len(names)))
    reported = float(np.einsum("ip,pq,iq->", shape, own, shape, optimize=True)) / len(shape)
    size = float(np.sqrt(np.mean(moved**2)))
    return size if size**2 > reported else None
