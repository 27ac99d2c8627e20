"""Which steps each number uses, and why there are too few of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.server.evaluations.cards import Lack, Mark
from stereorig.server.evaluations.tensile.curve import AXIAL, STRESS, Curve, Indices
from stereorig.server.evaluations.tensile.events import Course
from stereorig.server.evaluations.tensile.numbers import PROOF, Local, Plan, numbers_of
from stereorig.server.evaluations.tensile.profiles import Profile

_BEYOND = 4.0  # standard deviations that noise does not exceed
_FIRST = (0.05, 0.3)  # shares of the largest stress from which the window is first guessed
_ROUNDS = 3
_COVERED = 0.6  # share of the modulus' window that its steps must span
_ABOUT_PROOF = 4e-4  # strain to both sides of the proof stress in which steps are used
_MIN_SIDE = 3  # steps to each side of it
_MOST = 40
_PLATEAU = 0.99  # share of the largest stress that belongs to its plateau
_YIELDS_BY = 0.05  # strain at which yielding is over


@dataclass(frozen=True, eq=False)
class Planned:
    """The steps that numbers use.

    Attributes
    ----------
    plan
        The steps; None if there is no modulus, without which there is nothing.
    lacks
        By key, why there is no number.
    sampling
        By key, the standard uncertainty from what may have happened between two steps.
    marks
        What is doubtful.
    """

    plan: Plan | None
    lacks: dict[str, Lack]
    sampling: dict[str, float] = field(default_factory=dict)
    marks: tuple[Mark, ...] = ()


@dataclass(frozen=True)
class Asked:
    """What may be chosen.

    Attributes
    ----------
    min_steps
        Fewest steps in a window.
    share
        Largest part of a number that may be due to what happened between two steps.
    r_window, n_window
        Plastic strains between which the anisotropy and the strain hardening exponent are taken.
    """

    min_steps: int
    share: float
    r_window: tuple[float, float]
    n_window: tuple[float, float]


def planned(curve: Curve, course: Course, profile: Profile, asked: Asked) -> Planned:
    """Choose the steps."""
    window, lack = _window(curve, course.loading, profile, asked)
    if lack is not None:
        return Planned(None, dict.fromkeys(profile.numbers, lack))
    plan = Plan(window, _ratio(curve, window), _first(curve, course.loading, window))
    nominal = numbers_of(curve.values, plan)
    if not nominal["modulus"] > 0.0:
        text = f"Stress and strain have opposite signs: the modulus would be {float(nominal['modulus']):.4g} MPa."
        return Planned(None, dict.fromkeys(profile.numbers, Lack("channel_swapped", text)))
    chooser = _Chooser(curve, course, asked, plan, float(nominal["modulus"]), float(nominal["toe"]))
    chooser.proof()
    chooser.strength()
    chooser.yield_points()
    chooser.last()
    chooser.large_strains()
    if not curve.has_lateral:
        text = "No lateral strain is asked for."
        chooser.lacks |= dict.fromkeys(("poisson", "r"), Lack("no_lateral_strain", text))
    return Planned(chooser.plan, chooser.lacks, chooser.sampling, tuple(chooser.marks))


def _window(curve: Curve, loading: Indices, profile: Profile, asked: Asked) -> tuple[Indices, Lack | None]:
    """Return the steps of the modulus, and why they are too few."""
    axial, stress = curve.values[AXIAL], curve.values[STRESS]
    rising = loading[loading <= loading[np.argmax(stress[loading])]] if len(loading) else loading
    top = float(stress[rising].max()) if len(rising) else 0.0
    chosen = rising[(stress[rising] >= _FIRST[0] * top) & (stress[rising] <= _FIRST[1] * top)]
    if profile.by == "strain":
        chosen = rising[(axial[rising] >= profile.lower) & (axial[rising] <= profile.upper)]
    low, high, what = profile.lower, profile.upper, "strain"
    of = axial
    for _ in range(_ROUNDS):
        if len(chosen) < 2 or np.ptp(axial[chosen]) == 0.0:
            break
        line = numbers_of(curve.values, Plan(chosen, _ratio(curve, chosen), chosen[:0]), only_line=True)
        if profile.by == "strain":
            of = axial - float(line["toe"])
        else:
            proof = _crossing(axial, stress, rising, float(line["modulus"]), float(line["toe"]))
            # a specimen that breaks before it yields has its strength in place of the proof stress
            level = top if proof is None else proof
            of, low, high, what = stress, profile.lower * level, profile.upper * level, "stress in MPa"
        chosen = rising[(of[rising] >= low) & (of[rising] <= high)]
    where = f"between a {what} of {low:.4g} and {high:.4g}"
    if len(chosen) < asked.min_steps:
        return chosen, Lack("too_few_steps", f"{len(chosen)} steps are {where}; {asked.min_steps} are needed.")
    if np.ptp(of[chosen]) < _COVERED * (high - low):
        text = f"The steps cover {np.ptp(of[chosen]) / (high - low):.0%} of the window {where}."
        return chosen, Lack("window_not_covered", text)
    return chosen, None


def _ratio(curve: Curve, at: Indices) -> float:
    strain, stress = (float(np.mean(curve.own[row, at] ** 2)) for row in (AXIAL, STRESS))
    return stress / strain if strain > 0.0 else float("inf")


def _crossing(axial: Float, stress: Float, at: Indices, modulus: float, toe: float) -> float | None:
    """Return the stress between the two steps where the plastic strain passes the proof strain; None if none does."""
    k = _passes(axial[at] - stress[at] / modulus - toe)
    return None if k is None else float(0.5 * (stress[at[k - 1]] + stress[at[k]]))


def _passes(plastic: Float) -> int | None:
    """Return the first index from which the plastic strain is beyond the proof strain, and stays so for a step."""
    beyond = plastic >= PROOF
    both = np.flatnonzero(beyond[1:] & np.append(beyond[2:], True))
    return int(both[0]) + 1 if len(both) else None


def _first(curve: Curve, loading: Indices, window: Indices) -> Indices:
    """Return the first steps, in which the specimen is not stretched yet."""
    held = []
    for i in loading[: max(1, int(np.searchsorted(loading, window[0])))]:
        same = [
            abs(curve.values[row, i] - curve.values[row, loading[0]])
            <= _BEYOND * float(np.hypot(curve.own[row, i], curve.own[row, loading[0]]))
            for row in (AXIAL, STRESS)
        ]
        if not all(same):
            break
        held.append(i)
    return np.asarray(held, dtype=np.intp)


@dataclass(eq=False)
class _Chooser:
    """Chooses the steps of the numbers that stand on the modulus."""

    curve: Curve
    course: Course
    asked: Asked
    plan: Plan
    modulus: float
    toe: float
    lacks: dict[str, Lack] = field(default_factory=dict)
    sampling: dict[str, float] = field(default_factory=dict)
    marks: list[Mark] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.at = self.course.loading
        self.axial, self.stress = (self.curve.values[row, self.at] for row in (AXIAL, STRESS))
        self.plastic = self.axial - self.stress / self.modulus - self.toe
        self.top = int(np.argmax(self.stress))

    def _between(self, keys: tuple[str, ...], left: float, value: float, what: str) -> None:
        """Count what may have happened between two steps, or refuse the numbers for it."""
        if left <= self.asked.share * abs(value):
            self.sampling |= {key: left / np.sqrt(3.0) for key in keys}
            return
        text = f"{what} may be off by {left:.3g} between two steps, {left / abs(value):.1%} of it."
        self.lacks |= dict.fromkeys(keys, Lack("sampled_too_coarsely", text))

    def proof(self) -> None:
        k = _passes(self.plastic)
        if k is None:
            text = f"The plastic strain reaches {self.plastic.max():.4g}; the proof stress is at {PROOF:g}."
            self.lacks["proof"] = Lack("not_reached", text)
            return
        near = slice(max(0, k - _MIN_SIDE), k + _MIN_SIDE)
        share = (PROOF - self.plastic[k - 1]) / (self.plastic[k] - self.plastic[k - 1])
        middle = self.axial[k - 1] + share * (self.axial[k] - self.axial[k - 1])
        used = np.abs(self.axial - middle) <= _ABOUT_PROOF
        used[near] = True
        used[: max(0, k - _MOST // 2)] = used[k + _MOST // 2 :] = False
        if min(int(used[:k].sum()), int(used[k:].sum())) < _MIN_SIDE:
            text = f"{int(used[:k].sum())} steps are before the proof stress and {int(used[k:].sum())} after it."
            self.lacks["proof"] = Lack("too_few_steps", text)
            return
        local = Local.through(self.at[used], self.axial[used] - middle)
        self.plan = replace(self.plan, proof=local)
        straight = self.stress[k - 1] + share * (self.stress[k] - self.stress[k - 1])
        found = float(numbers_of(self.curve.values, self.plan)["proof"])
        # what a straight line misses, a parabola has; what a parabola misses is less
        noise = float(np.hypot(self.modulus * self.curve.own[AXIAL, self.at[k]], self.curve.own[STRESS, self.at[k]]))
        left = max(0.0, abs(found - straight) - 2.0 * noise)
        if left > self.asked.share * found:
            self.plan = replace(self.plan, proof=None)
            text = f"A line and a parabola between the steps differ by {left:.3g} MPa, {left / found:.1%}."
            self.lacks["proof"] = Lack("sampled_too_coarsely", text)

    def strength(self) -> None:
        keys = ("strength", "strain_at_strength", "uniform")
        end, failed = len(self.at) - 1, self.course.failure is not None
        if self.top == end and not failed:
            text = "The load still rises at the last step."
            self.lacks |= dict.fromkeys(keys, Lack("not_reached", text))
            return
        near = np.arange(max(0, self.top - 2), min(end, self.top + 2) + 1)
        if self.top == end:
            near = near[-1:]
            self._between(("strength",), float(self.stress[end] - self.stress[end - 1]), self.stress[end], "Strength")
            self._between(keys[1:], float(self.axial[end] - self.axial[end - 1]), self.axial[end], "Strain")
            self.plan = replace(self.plan, peak=Local.through(self.at[near], np.zeros(1)))
            return
        places = self.axial - self.axial[self.top]
        local = Local.through(self.at[near], places[near])
        bend = local.coefficients(self.curve.values[STRESS])
        place = float(-bend[1] / (2.0 * bend[2])) if bend[2] < 0.0 else 0.0
        place = min(max(place, float(places[near[0]])), float(places[near[-1]]))
        self.plan = replace(self.plan, peak=replace(local, place=place))
        level = np.flatnonzero(self.stress >= _PLATEAU * self.stress[self.top])
        plateau = np.arange(min(level[0], near[0]), max(level[-1], near[-1]) + 1)
        around = Local.through(self.at[plateau], places[plateau], degree=3)
        if len(plateau) >= self.asked.min_steps and around.coefficients(self.curve.values[STRESS])[2] < 0.0:
            self.plan = replace(self.plan, around_peak=around)
        else:
            text = f"{len(plateau)} steps are on the plateau of the largest load; {self.asked.min_steps} are needed."
            self.lacks |= dict.fromkeys(keys[1:], Lack("too_few_steps", text))

    def yield_points(self) -> None:
        keys = ("upper_yield", "lower_yield")
        own = self.curve.own[STRESS, self.at]
        until = np.flatnonzero(self.plastic <= _YIELDS_BY)
        top = -1
        for i in until[:-1].tolist():
            top = i if top < 0 or self.stress[i] > self.stress[top] else top
            fell = self.stress[top] - self.stress[i + 1] > _BEYOND * float(np.hypot(own[top], own[i + 1]))
            if fell and self.axial[i + 1] > self.axial[top]:
                break
        else:
            self.lacks |= dict.fromkeys(
                keys, Lack("no_yield_point", "The load does not fall while the specimen yields.")
            )
            return
        later = np.flatnonzero((self.stress >= self.stress[top]) & (np.arange(len(self.at)) > top))
        end = min(int(later[0]) if len(later) else len(self.at), int(until[-1]) + 1)
        after = np.arange(top + 1, end)
        # the first drop swings through: a low step right after it does not count
        lower = after[1:] if len(after) > 2 and self.stress[after[0]] < self.stress[after[1]] else after
        self.plan = replace(self.plan, upper=int(self.at[top]))
        self._between(keys[:1], float(self.stress[top] - self.stress[max(0, top - 1)]), self.stress[top], "The peak")
        if len(after) < _MIN_SIDE:
            self.lacks["lower_yield"] = Lack("too_few_steps", f"{len(after)} steps are in the yielding.")
            return
        self.plan = replace(self.plan, lower=int(self.at[lower[np.argmin(self.stress[lower])]]))

    def last(self) -> None:
        keys = ("strain_at_break", "elongation")
        if self.course.failure is None:
            self.lacks |= dict.fromkeys(keys, Lack("not_reached", "The specimen did not break before the last step."))
            return
        self.plan = replace(self.plan, last=int(self.at[-1]))
        self._between(keys, float(self.axial[-1] - self.axial[-2]), float(self.axial[-1]), "The strain at break")

    def large_strains(self) -> None:
        # true strains hold as long as the gauge is stretched alike: up to the largest load
        for key, keys, (low, high) in (("r", ("r",), self.asked.r_window), ("n", ("n", "k"), self.asked.n_window)):
            inside = (self.plastic >= low) & (self.plastic <= high)
            inside[self.top + 1 :] = False
            count, reach = int(inside.sum()), float(self.plastic[: self.top + 1].max())
            if reach < high - 0.1 * (high - low):
                text = f"Uniform plastic strain ends at {reach:.4g}; the window is {low:g} to {high:g}."
                self.lacks |= dict.fromkeys(keys, Lack("not_reached", text))
            elif count < self.asked.min_steps:
                text = f"{count} steps have a plastic strain of {low:g} to {high:g}; {self.asked.min_steps} are needed."
                self.lacks |= dict.fromkeys(keys, Lack("too_few_steps", text))
            else:
                self.plan = replace(self.plan, **{key: self.at[inside]})
