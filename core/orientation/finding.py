"""Judgement of offsets across epipolar lines: if a camera moved, with what certainty, and the resulting error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration import COVARIANCE_NAMES
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.orientation.consequence import Consequence
from stereorig.core.orientation.estimate import estimate_change
from stereorig.core.orientation.matched import MatchedPoints
from stereorig.core.orientation.offsets import StepOffsets
from stereorig.core.robust import f_tail, two_sided_sigmas

Against = Literal["calibration", "reference", "last_step"]
Pattern = Literal["mean", "slope", "curvature"]

MIN_POINTS = 30
CHANCE = 1e-4
"""Probability below which offsets are not called noise: of a test of a hundred steps, one in a hundred is wrong."""
#: smooth errors of the correlation and of the lenses, a standard deviation of each term; a part of them cancels between
#: two steps. Offsets of three times that are not called a motion, however small their noise
_FLOOR_PX: dict[Against, float] = {"calibration": 0.004, "reference": 0.002, "last_step": 0.002}
_NO_NUMBER = 1e-300
_PARTS: dict[Pattern, slice] = {"mean": slice(0, 1), "slope": slice(1, 3), "curvature": slice(3, 6)}


@dataclass(frozen=True)
class OffsetJudgement:
    """Judgement of the cameras from the offsets of a step.

    Attributes
    ----------
    against
        The offsets are compared with the calibration's, the reference's or those in the step before.
    camera_moved
        None if an error of the calibration's own is possible and not known.
    points
        Number of points.
    offset_mean_px, offset_rms_px
        Mean and rms of the smooth part of the offsets, over the points; against a step: of its difference.
    expected_px
        Root mean square expected from noise, systematic errors and the calibration's own uncertainty.
    pattern_px
        The root mean squares of its mean, its slope and its curvature over the image, which add up in squares.
    carried_by
        The largest of these.
    chi_square, p_value, sigmas
        Test of the smooth part against the expected one, six terms; the probability of as large a value, allowing for
        the uncertainty of the points' own noise; the same in standard deviations of a normal distribution.
    change_deg, change_sigma_deg
        :data:`stereorig.core.orientation.change.CHANGE_NAMES` that explain it.
    determined
        Number of these five that the offsets themselves determine.
    consequence
        Consequence of that change; None with too few points.
    text
        All of it in a sentence.
    """

    against: Against
    camera_moved: bool | None
    points: int
    offset_mean_px: float
    offset_rms_px: float
    expected_px: float
    pattern_px: dict[Pattern, float]
    carried_by: Pattern
    chi_square: float
    p_value: float
    sigmas: float
    change_deg: tuple[float, ...]
    change_sigma_deg: tuple[float, ...]
    determined: float
    consequence: Consequence | None
    text: str

    def document(self) -> dict[str, Any]:
        """Return it as plain numbers, lists and texts."""
        consequence = None if self.consequence is None else self.consequence.document()
        lists = {name: list(getattr(self, name)) for name in ("change_deg", "change_sigma_deg")}
        return {**vars(self), **lists, "pattern_px": dict(self.pattern_px), "consequence": consequence}


def judge_offsets(
    pair: StereoPair,
    points: MatchedPoints | StepOffsets,
    *,
    before: tuple[MatchedPoints, Float] | StepOffsets | None = None,
    against: Against = "calibration",
    covariance: Float | None = None,
    names: Sequence[str] = COVARIANCE_NAMES,
    own_px: float | None = None,
    imported: bool = False,
) -> OffsetJudgement | None:
    """Judge the offsets of one step.

    Parameters
    ----------
    pair
        The calibrated cameras.
    points
        The step's points as matched; as :class:`stereorig.core.orientation.offsets.StepOffsets`, with the same
        parameters' names, if they are judged more than once.
    before
        Points of the reference or of another step, and their offsets (m,), or both as
        :class:`stereorig.core.orientation.offsets.StepOffsets`; the part of the calibration's own error that is the
        same at both depths then cancels.
    against
        The offsets' reference: calibration, reference step or the step before.
    covariance, names
        (n, n) of the cameras' parameters, and their names.
    own_px
        The calibration's own offset at most, if it is known. Against a step: of a calibration of unknown error, whose
        offsets' change up to this size is not called a motion.
    imported
        True for another program's calibration, whose own error is not known.

    Returns
    -------
    OffsetFinding or None
        None with fewer than :data:`MIN_POINTS` points.
    """
    step = (points if isinstance(points, StepOffsets) else StepOffsets(pair, points, names)).finite
    held = StepOffsets(pair, before[0], names, before[1]) if isinstance(before, tuple) else before
    if len(step.offset_px) < MIN_POINTS or (held is not None and len(held.offset_px) < MIN_POINTS):
        return None
    offset, smooth, earlier = step.offset_px, step.smooth, None if held is None else _earlier(step, held)
    if earlier is not None:
        offset = offset - earlier.offset_px
        smooth = step.smooth_part(offset)
    C = smooth.covariance + _FLOOR_PX[against] ** 2 * np.eye(6)
    J = np.zeros((6, len(names))) if covariance is None else smooth.projector @ step.by_parameters
    if earlier is not None and held is not None:
        C = C + earlier.covariance
        if covariance is not None:
            # a motion in depth brings another part of the calibration's error to the same place of the image
            J = J - earlier.projector @ held.by_parameters
    known = against != "calibration" or covariance is not None
    if covariance is not None:
        C = C + J @ covariance @ J.T
    c = smooth.coefficients
    chi_square = float(c @ np.linalg.solve(C, c))
    parts_of_noise = [(smooth.covariance, smooth.degrees)]
    if earlier is not None:
        parts_of_noise.append((earlier.covariance, earlier.degrees))
    p_value = f_tail(chi_square / 6, 6, _degrees(C, parts_of_noise))
    expected = float(np.sqrt(np.trace(C)))
    rms = float(np.sqrt(max(c @ c - np.trace(smooth.covariance), 0.0)))
    moved: bool | None = p_value < CHANCE and rms > 3.0 * _FLOOR_PX[against]
    if against == "calibration":
        if own_px is not None:
            # the calibration's residuals limit the error of its model, independent of its covariance
            moved, known = moved and rms > own_px, True
        if imported or not known:
            moved = None
    elif moved and own_px is not None and rms <= own_px:
        # a specimen that deforms or moves brings other parts of an unknown error to its points
        moved = None
    estimate = estimate_change(pair, step.points, offset, slopes=step.change_slopes, shared=step.shared)
    cost = step.consequences
    parts = {name: float(np.sqrt(np.sum(c[part] ** 2))) for name, part in _PARTS.items()}
    finding = OffsetJudgement(
        against=against,
        camera_moved=moved,
        points=len(offset),
        offset_mean_px=float((smooth.terms @ c).mean()),
        offset_rms_px=rms,
        expected_px=expected,
        pattern_px=parts,
        carried_by=max(parts, key=lambda name: parts[name]),
        chi_square=chi_square,
        p_value=p_value,
        sigmas=two_sided_sigmas(p_value) if p_value > _NO_NUMBER else float(np.sqrt(chi_square)),
        change_deg=tuple(float(v) for v in np.degrees(estimate.change)),
        change_sigma_deg=tuple(float(v) for v in np.degrees(np.sqrt(np.diag(estimate.covariance)))),
        determined=estimate.determined,
        consequence=None if cost is None else cost.by(estimate.change, estimate.covariance),
        text="",
    )
    return _with_text(finding)


@dataclass(frozen=True, eq=False)
class _Earlier:
    """The smooth part of earlier offsets at the same place of the image.

    ``offset_px`` (n,) at the points; ``covariance`` (6, 6) of its coefficients over the points' terms, ``projector``
    (6, m) that makes them of the earlier offsets, and ``degrees`` of freedom behind the covariance.
    """

    offset_px: Float
    covariance: Float
    projector: Float
    degrees: float


def _degrees(whole: Float, parts: Sequence[tuple[Float, float]]) -> float:
    """Degrees of freedom (Welch and Satterthwaite) of a covariance from its parts' degrees of freedom."""
    return float(np.trace(whole)) ** 2 / sum(float(np.trace(part)) ** 2 / degrees for part, degrees in parts)


def _earlier(step: StepOffsets, held: StepOffsets) -> _Earlier:
    """At the same place, since an error of the calibration belongs to the image, not to the point of the specimen."""
    fit, count = held.smooth, len(held.offset_px)
    # the earlier terms at the points, through the plain polynomial of all positions together
    both = smooth_terms(np.concatenate([held.points.xy1_px, step.points.xy1_px]))
    there, here = both[:count], both[count:]
    turn = np.linalg.lstsq(there, fit.terms, rcond=None)[0]
    terms = here @ turn
    onto = step.terms.T / len(step.offset_px) @ terms
    return _Earlier(terms @ fit.coefficients, onto @ fit.covariance @ onto.T, onto @ fit.projector, fit.degrees)


_SAYS = {
    "calibration": "off its epipolar lines by",
    "reference": "against the reference off by",
    "last_step": "against the step before off by",
}


def _with_text(finding: OffsetJudgement) -> OffsetJudgement:
    text = (
        f"camera 2 sees the points {_SAYS[finding.against]} {finding.offset_rms_px:.3f} px "
        f"({finding.carried_by}; expected {finding.expected_px:.3f} px, {finding.sigmas:.1f} sigma)"
    )
    cost = finding.consequence
    if finding.camera_moved is None:
        text += "; the calibration's own error is not known, so that this does not show that a camera moved"
    elif finding.camera_moved:
        text += "; a camera moved" + ("" if finding.against != "calibration" else " since the calibration")
    else:
        text += "; no camera is seen to have moved"
    if cost is not None and finding.camera_moved is not False:
        text += (
            f": {cost.shape_um:.2g} +- {cost.shape_sigma_um:.2g} um in shape, {cost.z_um:.2g} um in Z, "
            f"{cost.strain_microstrain:.2g} +- {cost.strain_sigma_microstrain:.2g} microstrain between before and after"
        )
    return OffsetJudgement(**{**vars(finding), "text": text})
