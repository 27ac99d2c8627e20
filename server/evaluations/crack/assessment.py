"""From the points of a step to the crack's numbers, each with its uncertainty by cause, and what is doubtful."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.common.budget import budget_of
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.robust import chi_square_tail
from stereorig.server.evaluations.cards import Lack, Mark
from stereorig.server.evaluations.crack.domain import Opening, RingIntegral, j_of_series, opening, ring_integral, rings
from stereorig.server.evaluations.crack.drawn import DrawnCrack
from stereorig.server.evaluations.crack.points import Points, Spread, points_about
from stereorig.server.evaluations.crack.series import LEAST_ORDER, SeriesFit, chosen_fit, fitted, held
from stereorig.server.evaluations.crack.settings import CrackSettings, Elastic

ROOT_M = float(np.sqrt(1e3))  # sqrt(mm) of a sqrt(m)
_RECENTRED = 3
_OFF_CENTRE = 0.1  # share of the inner radius by which the tip may be off the ring's middle
_BEYOND = 4.0  # standard deviations that noise does not exceed
_MISFIT = 2.0  # times the noise' variance that the residuals may have before the numbers are doubtful
_APART = 0.02  # share by which J and K may differ
_PATHS = 0.01  # share by which J may differ from ring to ring
_CHANCE = 1e-3
_BUCKLED = 0.05  # share of the strain in the plane that the slope out of it may make
_PARTS, _OPENINGS = 3, 12  # rings on which J is compared, and places where the opening is read


@dataclass(frozen=True, eq=False)
class Number:
    """A number: value, derivatives (n, 2) over the displacements, variance from the noise' own square.

    And ``stated``: standard uncertainties from what is stated, by cause.
    """

    value: float
    gain: Float
    square: float = 0.0
    stated: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Assessed:
    """What a step shows of a crack.

    Attributes
    ----------
    numbers, spread
        The numbers by their keys, and their joint uncertainty from the points.
    paths
        J over each ring, the whole last: inner and outer radius, the integral and its standard uncertainty.
    opening_u
        Standard uncertainties (m, 2) of the faces' opening.
    """

    points: Points
    fit: SeriesFit
    numbers: dict[str, Number]
    spread: Spread
    paths: list[tuple[float, float, RingIntegral, float]]
    opening: Opening
    opening_u: Float
    doubts: list[Mark]


@dataclass(frozen=True, eq=False)
class Problem:
    """What is the same in all steps."""

    shared: SharedPixels
    crack: DrawnCrack
    elastic: Elastic
    asked: CrackSettings
    direction_u: float
    """Standard uncertainty of the crack's direction, rad."""


#: symbols and units of the numbers by their keys
NUMBERS = {
    "k1": ("K_I", "MPa m^0.5"),
    "k2": ("K_II", "MPa m^0.5"),
    "t_stress": ("T", "MPa"),
    "tip_x": ("tip x", "mm"),
    "tip_y": ("tip y", "mm"),
    "j": ("J", "N/mm"),
    "j_of_k": ("J of K", "N/mm"),
    "ctod": ("CTOD", "mm"),
}
_OF_STRESS = ("k1", "k2", "t_stress", "j", "j_of_k")


def assessed(step: Field, of: Problem, start_mm: Float) -> Assessed | Lack:
    """Return the numbers of a step, or why there are none; the tip starts at ``start_mm`` (2,)."""
    found = _fit_about(step, of, start_mm)
    if isinstance(found, Lack):
        return found
    points, fit = found
    edges = rings(of.crack.inner_mm, of.crack.outer_mm, points.spacing_mm, _PARTS)
    whole = [(a, b, ring_integral(points, fit, of.elastic, a, b)) for a, b in edges]
    total = whole[-1][2] if whole and all(one is not None for _, _, one in whole) else None
    numbers = _numbers(points, fit, of.elastic, total)
    spots = np.linspace(edges[0][0], of.crack.outer_mm, _OPENINGS) if edges else np.zeros(0)
    at_tip = of.asked.ctod_mm if of.asked.ctod_mm is not None else float(spots.min(initial=of.crack.outer_mm))
    parting = opening(points, fit, of.elastic, np.unique([at_tip, *spots]))
    for place in np.flatnonzero(parting.behind_mm == at_tip):
        numbers["ctod"] = Number(float(parting.value[place, 1]), parting.gains[place, 1])
    _add_stated(numbers, points, fit, of, edges[-1] if total is not None else None)
    each = points.spread(parting.gains.reshape(-1, len(points.at), 2)).whole(fit.excess)
    result = Assessed(
        points,
        fit,
        numbers,
        points.spread(np.stack([one.gain for one in numbers.values()])),
        [(a, b, one, _u_of(points, one.gain, one.square, fit.excess)) for a, b, one in whole if one is not None],
        parting,
        np.sqrt(np.diag(each)).reshape(-1, 2),
        [],
    )
    result.doubts.extend(_doubts(result, of, total))
    return result


def parts_of(found: Assessed, key: str) -> dict[str, float]:
    """Return the standard uncertainties of a number by cause."""
    k, spread, points = list(found.numbers).index(key), found.spread, found.points
    square = found.numbers[key].square
    own = max(found.fit.excess**2 * float(spread.own[k, k]) - square, square)
    frozen = None if spread.frozen is None else float(spread.frozen[k, k])
    parts = budget_of(own, frozen, None if spread.common is None else spread.common[k], points.causes).document()
    return {cause: u for cause, u in {**parts, **found.numbers[key].stated}.items() if u > 0.0}


def _fit_about(step: Field, of: Problem, start_mm: Float) -> tuple[Points, SeriesFit] | Lack:
    """Fit the series to the points about the tip, the ring's middle being the tip."""
    centre = np.asarray(start_mm, dtype=np.float64)
    inner = of.crack.inner_mm
    for _ in range(_RECENTRED):
        points = points_about(step, of.shared, of.crack, centre)
        lack = _few(points, centre)
        if lack is not None:
            return lack
        k1, u = held(points.few, of.elastic, centre, inner)
        if not k1 > _BEYOND * u:
            text = f"At the tip K_I would be {k1 / ROOT_M:.3g}, its standard uncertainty {u / ROOT_M:.2g} MPa m^0.5: "
            return Lack("crack_closed", text + "the faces do not open.")
        fit = chosen_fit(points.few, of.elastic, centre, inner, of.asked.max_order, of.asked.criterion)
        off = float(np.linalg.norm(fit.tip_mm - centre))
        if not fit.settled or off > of.crack.outer_mm:
            break
        if off <= _OFF_CENTRE * inner:
            return points, fit
        centre = fit.tip_mm
    return Lack("tip_not_found", "The displacements about the drawn tip determine no tip: is it drawn where it is?")


def _few(points: Points, centre: Float) -> Lack | None:
    """Return a reason if there are too few points, or on one side alone."""
    away = points.few.xy_mm - centre
    quarters = np.bincount((away[:, 0] > 0.0) * 2 + (away[:, 1] > 0.0), minlength=4)
    needed = 2 * (2 * LEAST_ORDER + 4)
    if len(away) >= needed and quarters.min() >= needed // 8:
        return None
    text = f"{len(away)} points are in the ring about the tip, {quarters.min()} in the quarter with the fewest; "
    return Lack("too_few_points", text + f"{needed} and {needed // 8} are needed.")


def _numbers(points: Points, fit: SeriesFit, elastic: Elastic, total: RingIntegral | None) -> dict[str, Number]:
    gains = points.of_few(fit.gains)
    scale = float(np.sqrt(2.0 * np.pi)) * elastic.two_g
    k1, k2 = scale * float(fit.terms[2]), -scale * float(fit.terms[3])
    of_k1, of_k2 = scale * gains[2], -scale * gains[3]
    found = {
        "k1": Number(k1 / ROOT_M, of_k1 / ROOT_M),
        "k2": Number(k2 / ROOT_M, of_k2 / ROOT_M),
        "t_stress": Number(4.0 * elastic.two_g * float(fit.terms[4]), 4.0 * elastic.two_g * gains[4]),
        "tip_x": Number(float(fit.tip_mm[0]), gains[-2]),
        "tip_y": Number(float(fit.tip_mm[1]), gains[-1]),
        "j_of_k": Number(j_of_series(fit, elastic), 2.0 * (k1 * of_k1 + k2 * of_k2) / elastic.effective[0]),
    }
    if total is not None:
        found["j"] = Number(total.value, total.gain, total.square)
    return found


def _add_stated(
    numbers: dict[str, Number], points: Points, fit: SeriesFit, of: Problem, edges: tuple[float, float] | None
) -> None:
    """Add what the stated modulus, Poisson's ratio and direction make uncertain."""
    poisson = replace(of.elastic, poisson=min(of.elastic.poisson + (of.asked.poisson_u or 0.0), 0.4999))
    changes = {}
    if poisson != of.elastic:
        changes["poisson"] = points, poisson
    if of.direction_u > 0.0:
        changes["direction"] = points.turned(of.direction_u), of.elastic
    for cause, (seen, elastic) in changes.items():
        again = fitted(seen.few, elastic, fit.order, fit.tip_mm, of.crack.inner_mm)
        total = None if edges is None else ring_integral(seen, again, elastic, *edges)
        for key, one in _numbers(seen, again, elastic, total).items():
            if key in numbers:
                numbers[key].stated[cause] = abs(one.value - numbers[key].value)
    for key in numbers.keys() & _OF_STRESS:
        numbers[key].stated["modulus"] = abs(numbers[key].value) * (of.asked.modulus_u or 0.0)


def _u_of(points: Points, gain: Float, square: float, excess: float) -> float:
    # noise is in the derivatives of a square too, and adds twice its own variance to the linear part
    return float(np.sqrt(max(points.spread(gain[None]).whole(excess)[0, 0] - square, square)))


def _doubts(found: Assessed, of: Problem, total: RingIntegral | None) -> list[Mark]:
    fit, numbers, every = found.fit, found.numbers, tuple(NUMBERS)
    out = []
    if fit.excess > 1.0:
        text = f"The points are {fit.excess:.2g} times as far from the series as their noise explains; the intervals "
        text += "are that much wider. Is the crack straight, the sheet elastic?"
        out.append(Mark("misfit", text, spoils=every if fit.excess**2 > _MISFIT else ()))
    if np.linalg.norm(fit.tip_mm) > of.crack.inner_mm:
        out.append(Mark("tip_moved", f"The tip is {np.linalg.norm(fit.tip_mm):.3g} mm from the drawn one."))
    if total is None:
        return [*out, Mark("ring_not_measured", "Points are missing where J is integrated.", spoils=("j",))]
    away = numbers["j"].value - numbers["j_of_k"].value
    u = _u_of(found.points, numbers["j"].gain - numbers["j_of_k"].gain, total.square, fit.excess)
    if abs(away) > max(_BEYOND * u, _APART * abs(numbers["j_of_k"].value)):
        text = f"J is {numbers['j'].value:.4g} N/mm by the integral and {numbers['j_of_k'].value:.4g} by K, with a "
        out.append(Mark("j_differs", text + f"standard uncertainty of the difference of {u:.2g}.", spoils=every))
    out += _paths(found)
    if len(found.opening_u):
        across, u_across = found.opening.value[:, 1], found.opening_u[:, 1]
        worst = int(np.argmin(across / np.maximum(u_across, 1e-300)))
        if across[worst] < -_BEYOND * u_across[worst]:
            out.append(Mark("faces_closed", f"The faces overlap by {-across[worst]:.3g} mm.", spoils=every))
    share = 0.5 * total.slope**2 / max(total.strain, 1e-300)
    if share > _BUCKLED:
        text = f"The surface's slope out of its plane, {total.slope:.3g}, makes {share:.0%} of the strain: it buckled."
        out.append(Mark("buckled", text, spoils=every))
    return out


def _paths(found: Assessed) -> list[Mark]:
    """Return a doubt if J depends on the ring by more than its uncertainty."""
    parts = [one for _, _, one, _ in found.paths[:-1]]
    values = np.array([one.value for one in parts])
    mean = values.mean()
    gains = np.stack([one.gain for one in parts])
    spread = found.points.spread((gains - gains.mean(axis=0))[1:])
    away = (values - mean)[1:]
    chance = chi_square_tail(float(away @ np.linalg.solve(spread.whole(found.fit.excess), away)), len(away))
    if chance > _CHANCE or np.ptp(values) <= _PATHS * abs(mean):
        return []
    text = f"J differs from ring to ring by {np.ptp(values) / abs(mean):.1%}, beyond its uncertainty."
    return [Mark("path_dependent", text, spoils=("j", "j_of_k", "k1", "k2"))]
