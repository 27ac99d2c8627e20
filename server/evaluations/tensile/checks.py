"""Whether the numbers can be believed: a late clock, cross-talk, scatter beyond the budget, swapped channels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.stats import chi2, spearmanr

from stereorig.core.arrays import Float
from stereorig.server.evaluations.cards import Mark
from stereorig.server.evaluations.tensile.curve import AXIAL, LATERAL, STRESS, Curve
from stereorig.server.evaluations.tensile.events import Course
from stereorig.server.evaluations.tensile.numbers import Plan
from stereorig.server.evaluations.tensile.profiles import UNITS, Profile
from stereorig.server.evaluations.tensile.propagate import Uncertain

ALL = tuple(UNITS)
_OF_STRESS = tuple(key for key in ALL if key not in ("poisson", "r"))
_ON_LINE = ("proof", "n", "k", "uniform", "strain_at_strength", "strain_at_break", "elongation")
_BEYOND = 4.0
_CHANCE = 1e-3  # share of sound tests whose scatter is called too large
_CURVED = 0.8  # share of the scatter that a parabola explains
_ALIKE = 4.5  # standard deviations of a correlation that chance does not exceed
_FEWEST = 24  # steps from which a correlation is known well enough
_CLIP = 10.0  # standard deviations: a knee between two steps is no noise
_FEWEST_RANKED, _RANKED = 8, 0.7
_FOLLOWS = 0.95  # correlation with the strain that a load has at least


def doubts_of_load(curve: Curve, course: Course) -> list[Mark]:
    """Return what makes the load doubtful, whatever is found with it."""
    return [*_follows(curve, course), *_cross_talk(curve, course), *_after_failure(curve, course)]


def doubts(
    curve: Curve, plan: Plan, profile: Profile, found: Mapping[str, Uncertain], expected: Float | None
) -> list[Mark]:
    """Return what makes numbers doubtful.

    Parameters
    ----------
    expected
        (2,) MPa between which the modulus is known to lie; None: not known.
    """
    modulus = found["modulus"].value
    marks = [*_direction(curve, plan), *_scatter(curve, plan, profile, modulus), *_clock(curve, plan, profile, found)]
    if expected is not None and not expected[0] <= modulus <= expected[1]:
        text = (
            f"The modulus is {modulus:.5g} MPa, expected are {expected[0]:g} to {expected[1]:g}: is it the right load?"
        )
        marks.append(Mark("channel_swapped", text, spoils=ALL))
    return marks


def _follows(curve: Curve, course: Course) -> list[Mark]:
    """Return a mark if the load does not rise with the strain up to a half of its largest."""
    at = course.loading
    stress = curve.values[STRESS, at]
    rising = at[: int(np.argmax(stress)) + 1]
    low = rising[curve.values[STRESS, rising] <= 0.5 * stress.max()]
    if len(low) < _FEWEST_RANKED:
        # a load that is large from the start
        low = at[: max(len(at) // 2, _FEWEST_RANKED)] if len(at) >= 2 * _FEWEST_RANKED else low
    if len(low) < _FEWEST_RANKED:
        return []
    rank = float(spearmanr(curve.values[AXIAL, low], curve.values[STRESS, low]).statistic)
    if rank >= _RANKED:
        return []
    text = f"The load does not rise with the strain (rank correlation {rank:.2f}): is it the right channel?"
    return [Mark("channel_swapped", text, spoils=ALL)]


def _direction(curve: Curve, plan: Plan) -> list[Mark]:
    """Return a mark if the lateral strain is larger than the axial one."""
    if not curve.has_lateral:
        return []
    axial, lateral = (float(np.ptp(curve.values[row, plan.window])) for row in (AXIAL, LATERAL))
    if lateral <= axial:
        return []
    text = f"In the modulus' window the lateral strain changes by {lateral:.3g} and the axial one by {axial:.3g}."
    return [Mark("direction_swapped", text, spoils=ALL)]


def _scatter(curve: Curve, plan: Plan, profile: Profile, modulus: float) -> list[Mark]:
    """Return a mark if the window's steps are farther from their line than their uncertainties allow."""
    at = plan.window
    axial, stress = curve.values[AXIAL, at], curve.values[STRESS, at]
    away = stress - stress.mean() - modulus * (axial - axial.mean())
    follows = float(np.corrcoef(axial, stress)[0, 1])
    if follows < _FOLLOWS:
        text = f"In the modulus' window the load hardly follows the strain (correlation {follows:.2f})."
        return [Mark("channel_swapped", text, spoils=ALL)]
    size = np.hypot(curve.own[STRESS, at], modulus * curve.own[AXIAL, at])
    if not (size > 0.0).all():
        return []
    sum_of_squares = float(np.sum((away / size) ** 2))
    if chi2.sf(sum_of_squares, len(at) - 2) > _CHANCE:
        return []
    excess = float(np.sqrt(sum_of_squares / (len(at) - 2)))
    bent = np.polynomial.polynomial.polyfit(axial - axial.mean(), away, 2)
    left = away - np.polynomial.polynomial.polyval(axial - axial.mean(), bent)
    if float(left @ left) < (1.0 - _CURVED) * float(away @ away):
        # a standard that states the strains takes the mean slope between them, straight or not
        spoils = () if profile.by == "strain" else _OF_STRESS
        text = f"The curve is bent in the modulus' window: {excess:.1f} times the scatter that the budget allows."
        return [Mark("window_curved", text, spoils=spoils)]
    text = f"The steps scatter {excess:.1f} times as much about the modulus' line as the budget allows."
    return [Mark("scatter", text, spoils=ALL)]


def _cross_talk(curve: Curve, course: Course) -> list[Mark]:
    """Return a mark for each channel whose quick changes are in the load."""
    at = course.loading
    if len(at) < _FEWEST:
        return []
    axial, stress = curve.values[AXIAL, at], curve.values[STRESS, at]
    span = axial[4:] - axial[:-4]
    slope = (stress[4:] - stress[:-4]) / np.where(span > 0.0, span, np.inf)
    size = np.hypot(curve.own[STRESS, at[2:-2]], slope * curve.own[AXIAL, at[2:-2]])
    away = np.clip((_quick(stress) - slope * _quick(axial)) / np.where(size > 0.0, size, 1.0), -_CLIP, _CLIP)
    marks = []
    for name, other in curve.others.items():
        quick = _quick(other[at])
        if not np.isfinite(quick).all() or np.linalg.norm(quick) == 0.0:
            continue
        alike = float(quick @ away / max(np.linalg.norm(quick) * np.linalg.norm(away), 1e-300))
        if alike**2 * len(away) > _ALIKE**2:
            text = f"The load changes quickly as the channel {name} does (correlation {alike:.2f}): cross-talk."
            marks.append(Mark("cross_talk", text, spoils=_OF_STRESS))
    return marks


def _quick(y: Float) -> Float:
    """Return how far each inner value is from the cubic through its four neighbours."""
    return np.asarray(y[2:-2] - (4.0 * (y[1:-3] + y[3:-1]) - y[:-4] - y[4:]) / 6.0)


def _clock(curve: Curve, plan: Plan, profile: Profile, found: Mapping[str, Uncertain]) -> list[Mark]:
    """Return a mark if the modulus' line goes past the first steps."""
    miss = found["miss"]
    if not len(plan.first) or abs(miss.value) <= _BEYOND * miss.u:
        return []
    # a curve that bends from the start passes above its mean slope: with stated strains that is no fault
    if profile.by == "strain" and miss.value < 0.0:
        return []
    late = f"the strain is {miss.value / found['modulus'].value:.2g} ahead"
    if curve.time_s is not None and len(plan.window) > 1:
        rate = np.polynomial.polynomial.polyfit(curve.time_s[plan.window], curve.values[STRESS, plan.window], 1)[1]
        late = f"the load would be {miss.value / rate:.3g} s late"
    text = (
        f"The modulus' line passes the first steps at {-miss.value:.3g} MPa: {late}, or the specimen was bent at first."
    )
    return [Mark("load_late", text, spoils=_ON_LINE)]


def _after_failure(curve: Curve, course: Course) -> list[Mark]:
    """Return a mark if there is a load on a broken specimen."""
    if course.failure is None:
        return []
    left = curve.values[STRESS, course.failure :]
    own = curve.own[STRESS, course.failure :]
    offset = np.sqrt(
        sum(float(np.sum(one[:, STRESS, 0] ** 2)) for c, one in curve.shared.items() if c == "load_offset")
    )
    mean, u = float(np.median(left)), float(np.hypot(np.median(own), offset))
    if abs(mean) <= _BEYOND * u:
        return []
    text = f"The load is {mean:.3g} MPa after failure, with a standard uncertainty of {u:.2g}: offset or cross-talk."
    return [Mark("load_not_zero", text, spoils=_OF_STRESS)]
