"""New estimate of the cameras' relative orientation from the speckle of some steps.

The points do not match with the old orientation if a camera turned by more than a few hundredths of a degree: feature
matches give a coarse orientation, the correlation at the points the final one, twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationError
from stereorig.core.field.growth.state import Image
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.seeding.search_region import box_around
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.measure import measure_shape
from stereorig.core.orientation.change import changed, pinhole_shift
from stereorig.core.orientation.coarse import coarse_change, feature_matches
from stereorig.core.orientation.consequence import Consequence, consequence_of
from stereorig.core.orientation.estimate import OrientationEstimate, estimate_change
from stereorig.core.orientation.matched import MatchedPoints, matched_points
from stereorig.core.orientation.noise import structure_left_px
from stereorig.core.progress import CancelToken, Progress, no_progress

_ROUNDS = 2
_FORWARD_OVER_TURN = 1.5
"""A turn of camera 1 turns the baseline by as much, a turn of camera 2 not at all. A refocused lens changes the
magnification, which looks like a camera that came nearer without turning.
"""


@dataclass(frozen=True, kw_only=True)
class RepairLimits:
    """Limits beyond which a repair is refused.

    Attributes
    ----------
    turn_deg
        Largest turn of one camera against the other, or of the baseline's direction.
    structure_px
        Smooth offsets that no orientation explains, root mean square.
    strain
        Standard deviation of the shape's strain from the estimate, 1 = 100 %.
    points
        Fewest points.
    """

    turn_deg: float = 5.0
    structure_px: float = 0.02
    strain: float = 1e-3
    points: int = 100


@dataclass(frozen=True, eq=False)
class RepairedPair:
    """A repaired pair.

    Attributes
    ----------
    pair
        With the new pose of camera 2; camera 1 and the baseline's length are kept.
    change
        (5,) from the old pair, :data:`stereorig.core.orientation.change.CHANGE_NAMES`.
    estimate
        The last estimate, about ``pair``, with the covariance and the response to errors of the offsets.
    points
        Points as matched.
    before_px, after_px
        Root mean square of the smooth offset, with the old pair and with the new one.
    structure_px
        Part of ``after_px`` that is larger than noise and that no orientation explains.
    length_sigma
        Standard uncertainty of the baseline's length from the bump, 1 = 100 %: a pinhole is taken to have shifted along
        the baseline, where the offsets do not show it, as far as it is seen to have shifted across.
    consequence
        Consequence of the change; its standard deviations are the repaired pair's.
    """

    pair: StereoPair
    change: Float
    estimate: OrientationEstimate
    points: MatchedPoints
    before_px: float
    after_px: float
    structure_px: float
    length_sigma: float
    consequence: Consequence


def repair_orientation(
    pair: StereoPair,
    images: Sequence[tuple[Image, Image]],
    grid: PointGrid,
    options: MeasureOptions | None = None,
    *,
    limits: RepairLimits | None = None,
    progress: Progress | None = None,
    cancel: CancelToken | None = None,
) -> RepairedPair:
    """Estimate the orientation of camera 2 relative to camera 1 again.

    Parameters
    ----------
    pair
        The cameras as calibrated.
    images
        Both cameras' images of each step, all taken after the bump.
    grid
        Points in camera 1's images.
    options
        As in :func:`stereorig.core.measure.measure_shape`.
    limits
        Defaults to ``RepairLimits()``.
    progress, cancel
        As in :func:`stereorig.core.measure.measure_shape`.

    Raises
    ------
    CalibrationError
        ``repair_no_match``, ``repair_too_few_points``, ``repair_too_large``, ``repair_structure`` or
        ``repair_uncertain``: the old calibration stays as it is, and the cameras have to be calibrated again.
    RegionError, ImageError, SeedError, Cancelled
        As :func:`stereorig.core.measure.measure_shape`.
    """
    limits, report = limits or RepairLimits(), progress or no_progress
    taken = [
        (MeasureImage(one, f"camera 1's image {k}"), MeasureImage(two, f"camera 2's image {k}"))
        for k, (one, two) in enumerate(images)
    ]
    at = grid.xy_px[grid.allowed]
    subset_px = (options or MeasureOptions()).subset_px
    found = [feature_matches(one, two, box_around(at, 16.0, one.shape), k) for k, (one, two) in enumerate(taken)]
    report("features", 1, 1)
    matches = MatchedPoints.joined([m for m, _ in found])
    change = coarse_change(pair, matches, scale=max(scale for _, scale in found))
    now = changed(pair, change)
    for _ in range(_ROUNDS):
        parts = [
            matched_points(
                now, measure_shape(now, one, two, grid, options, progress=progress, cancel=cancel), subset_px, k
            )
            for k, (one, two) in enumerate(taken)
        ]
        points = MatchedPoints.joined(parts)
        if len(points.xy1_px) < limits.points:
            raise CalibrationError(
                f"{len(points.xy1_px)} points could be matched, {limits.points} are needed.",
                code="repair_too_few_points",
                remedy="Give a larger region, more steps, or images with more texture.",
            )
        change = estimate_change(pair, points, start=change).change
        now = changed(pair, change)
    estimate = estimate_change(pair, points, start=change)
    return _checked(pair, changed(pair, estimate.change), estimate, points, limits)


def _checked(
    old: StereoPair, new: StereoPair, estimate: OrientationEstimate, points: MatchedPoints, limits: RepairLimits
) -> RepairedPair:
    change = estimate.change
    _check_size(change, limits)
    before = structure_left_px(points, old.epipolar_residual_px(points.xy1_px, points.xy2_px), order=2)
    after = structure_left_px(points, estimate.residual_px, order=2)
    structure = structure_left_px(points, estimate.residual_px, order=3)
    if structure > limits.structure_px:
        raise CalibrationError(
            f"Offsets of {structure:.3f} px across the epipolar lines are left that no orientation explains, "
            f"at most {limits.structure_px:g} px are allowed.",
            code="repair_structure",
            remedy="A lens or its focus has changed, or the calibration is another rig's: calibrate again.",
            structure_px=structure,
        )
    forward, turn = float(change[3]), float(np.linalg.norm(change[:3]))
    sigma = float(np.sqrt(estimate.covariance[3, 3]))
    if abs(forward) - 3.0 * sigma > _FORWARD_OVER_TURN * turn:
        raise CalibrationError(
            f"Only a camera that came {abs(forward) * new.baseline_mm:.2g} mm nearer or went farther, "
            "with hardly a turn, explains the offsets.",
            code="repair_structure",
            remedy="That is how a changed focus or lens shows: calibrate again.",
        )
    # about the new pair, at which the estimate is used
    estimate = estimate_change(new, points, bump_rad=estimate.bump_rad)
    consequence = consequence_of(new, points, change, estimate.covariance)
    shift, slopes = pinhole_shift(old, change)
    seen = float(shift @ shift) - float(np.trace(slopes @ estimate.covariance @ slopes.T))
    length_sigma = float(np.sqrt(0.5 * max(seen, 0.0)))
    if consequence is not None:
        consequence = _with_length(consequence, new, points, length_sigma)
    if consequence is None or consequence.strain_sigma_microstrain * 1e-6 > limits.strain:
        sigma_text = "unknown" if consequence is None else f"{consequence.strain_sigma_microstrain:.3g} microstrain"
        raise CalibrationError(
            f"The repaired orientation would leave shapes with an uncertainty of {sigma_text}, at most "
            f"{limits.strain * 1e6:g} are allowed: the view is too narrow to show it, or a pinhole shifted.",
            code="repair_uncertain",
            remedy="Give a larger region and steps at other depths and tilts, or calibrate again.",
        )
    return RepairedPair(new, change, estimate, points, before, after, structure, length_sigma, consequence)


def _with_length(found: Consequence, pair: StereoPair, points: MatchedPoints, length_sigma: float) -> Consequence:
    """Add the uncertainty of the common scale to the change's."""
    xyz = pair.triangulate(points.xy1_px, points.xy2_px).xyz_mm
    depth = pair.cam1.cam_from_sys.apply(xyz)[:, 2]
    size = float(np.sqrt(np.nanmean(((xyz - np.nanmean(xyz, axis=0)) ** 2).sum(axis=1))))
    far = float(np.sqrt(np.nanmean(depth**2)))
    um = 1e3 * length_sigma
    return replace(
        found,
        shape_sigma_um=float(np.hypot(found.shape_sigma_um, um * size)),
        z_sigma_um=float(np.hypot(found.z_sigma_um, um * far)),
        displacement_sigma_um=float(np.hypot(found.displacement_sigma_um, um * far)),
        strain_sigma_microstrain=float(np.hypot(found.strain_sigma_microstrain, 1e6 * length_sigma)),
    )


def _check_size(change: Float, limits: RepairLimits) -> None:
    turn = float(np.degrees(max(np.linalg.norm(change[:3]), np.linalg.norm(change[3:]))))
    if turn > limits.turn_deg:
        raise CalibrationError(
            f"The cameras turned by {turn:.2f} degrees against each other, {limits.turn_deg:g} are allowed.",
            code="repair_too_large",
            remedy="Calibrate again, or check that calibration and images belong together.",
        )
