"""The lens model: the one asked for, or the simplest whose residuals hold no structure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stereorig.core.calibration.choice.contradictions import (
    FAILED_LEVEL,
    bow_of,
    contradicted,
    in_words,
    scale_seen,
    unseen,
    with_open_scales,
    with_open_steps,
)
from stereorig.core.calibration.choice.declared import AXES, POSITIONS, SCALE_GROUPS
from stereorig.core.calibration.choice.held_out import HeldOutView, held_out_views, leave_out_in_turn, staged_views
from stereorig.core.calibration.choice.pairs import apart_pairs
from stereorig.core.calibration.choice.screening import Screened, fit_screened, not_of_one_pose, points_mm
from stereorig.core.calibration.choice.structure import (
    LENS_TERMS,
    UNEQUAL_PITCH,
    Group,
    Score,
    Structure,
    Unseen,
    find_structure,
    lens_share_px,
    lens_significance,
    no_target,
    scored,
)
from stereorig.core.calibration.choice.target_errors import check_flatness, find_target_errors
from stereorig.core.calibration.choice.target_shape import with_smooth_errors
from stereorig.core.calibration.choice.tilted import (
    LIKE_A_TILT,
    TILTED,
    UNTILTED,
    as_tilts,
    has_own_stages,
    may_be_tilted,
    moved_by_tilt,
    with_open_axes,
)
from stereorig.core.calibration.fit.layout import Layout, State
from stereorig.core.calibration.fit.lens_form import LensName
from stereorig.core.calibration.fit.problem import FitData, converted, started, unfolded
from stereorig.core.calibration.inputs import CalibrationView
from stereorig.core.errors import CalibrationError

# by chance a right lens is given more terms once in so many calibrations; they cost a little noise, while terms that
# are missing bias the shape before their own significance is beyond doubt
LENS_LEVELS: tuple[tuple[LensName, float], ...] = (("opencv5", 0.01), ("opencv8", 1e-3))
_RICHER: dict[LensName, tuple[LensName, float]] = {
    "paper": LENS_LEVELS[0],
    "opencv5": LENS_LEVELS[1],
    "opencv5_prism": ("opencv12", LENS_LEVELS[1][1]),
    "opencv5_tilted": ("opencv14", LENS_LEVELS[1][1]),
    "opencv5_prism_tilted": ("opencv14", LENS_LEVELS[1][1]),
}
_PRISM, _HIGHER, _TILT, _BENT_LEVEL = "thin prism", "higher prism", "tilted sensor", 1e-3
#: the next models by the structure that makes a lens asymmetric beyond decentring
_BENT: dict[LensName, dict[str, LensName]] = {
    "paper": {_PRISM: "opencv5_prism", _TILT: "opencv5_tilted"},
    "opencv5": {_PRISM: "opencv5_prism", _TILT: "opencv5_tilted"},
    "opencv8": {_PRISM: "opencv12", _TILT: "opencv14"},
    "opencv5_prism": {_TILT: "opencv5_prism_tilted", _HIGHER: "opencv12"},
    "opencv5_prism_tilted": {_HIGHER: "opencv14"},
    "opencv5_tilted": {_PRISM: "opencv5_prism_tilted"},
    "opencv12": {_TILT: "opencv14"},
}
_ITERATIONS = 300
_WORSE = 1.02  # held-out RBE over the simpler lens's beyond which more terms are refused


@dataclass(frozen=True)
class Chosen:
    """The fit under the lens model taken.

    Attributes
    ----------
    screened
        The minimum over the views that hold.
    held_out
        Views that the fit did not use.
    structure
        Structure of the residuals beyond noise.
    reasons
        Why this lens, as sentences.
    stage_over_pitch, unseen
        See :func:`stereorig.core.calibration.choice.contradictions.scale_seen` and
        :func:`stereorig.core.calibration.choice.contradictions.unseen`.
    """

    screened: Screened
    held_out: tuple[HeldOutView, ...]
    structure: tuple[Structure, ...]
    reasons: tuple[str, ...]
    stage_over_pitch: tuple[float, float] | None
    unseen: tuple[Unseen, ...]

    @property
    def model(self) -> LensName:
        """Name of the lens model."""
        return self.screened.adjustment.layout.form.model


def choose_lens(problem: FitData, held: Sequence[CalibrationView]) -> Chosen:
    """Fit under the lens model that the options ask for, or find the simplest that leaves no structure.

    If all views agree that points of a target declared exact are displaced, the lens is chosen again with these errors
    as unknowns, with a prior from the residuals. With free poses they are corrected, too. Errors of the positions read
    back become unknowns of the chosen lens's fit in the same way.

    Parameters
    ----------
    problem
        The views to fit.
    held
        Views kept for the check, at stage positions or free.

    Raises
    ------
    CalibrationInputError, CalibrationError
        Views that do not give a calibration; ``target_not_flat``.
    """
    problem, start, odd = started(problem)
    apart = apart_pairs(problem, start, odd, held)
    lost = not_of_one_pose(held, apart)
    begun = _FitStart(start, apart, tuple(v for v in held if v.frame is None or v.frame not in apart))
    chosen = _corrected(problem, begun)
    fit = chosen.screened
    if any(found.name == POSITIONS for found in chosen.structure):
        with suppress(CalibrationError):
            fit = with_open_steps(fit, *_Candidate(fit, ()).asked)
            open_steps = [replace(s, freed=None) if s.name == POSITIONS else s for s in chosen.structure]
            chosen = replace(chosen, structure=tuple(open_steps))
    fit = replace(fit, adjustment=with_smooth_errors(fit), dropped=(*fit.dropped, *lost))
    return replace(chosen, screened=fit)


@dataclass(frozen=True)
class _FitStart:
    """Start of a fit: the values under the paper's lens, poses left out, and views kept for the check."""

    start: State
    apart: tuple[int, ...]
    held: tuple[CalibrationView, ...]


def _corrected(problem: FitData, begun: _FitStart) -> Chosen:
    """Choose the lens, again with the target's errors as unknowns where the views show some."""
    chosen = _choose(problem, begun)
    half_side_mm = float(np.abs(problem.nodes_mm).max())
    check_flatness(chosen.structure, chosen.screened.adjustment, half_side_mm)
    fit = chosen.screened
    # residuals of a wrong scale or a bow under the simple lens are no errors of single points
    other = {found.name for found in chosen.structure} & {*SCALE_GROUPS, "bow"}
    if fit.adjustment.priors.nodes_free or (problem.staged and other):
        return chosen
    errors = find_target_errors(fit.adjustment, fit.rows, problem.flat_nodes_mm, in_space=bool(problem.frames))
    if errors is None:
        return chosen
    found, node_sigma_mm = errors
    try:
        corrected = _choose(replace(problem, node_sigma_mm=node_sigma_mm), begun)
    except CalibrationError:
        # these views do not determine both; the finding stays, and lowers the verdict
        return replace(chosen, structure=(found, *chosen.structure))
    if problem.frames and problem.options.estimate_nodes is not False:
        return replace(corrected, structure=(found, *corrected.structure))
    if corrected.model != chosen.model:
        # a lens must not take up the target's errors, which every position repeats
        tilt = corrected.screened.problem.options.axis_tilt_sigma_rad
        held_lens = replace(problem, options=replace(problem.options, lens=corrected.model, axis_tilt_sigma_rad=tilt))
        chosen = replace(_choose(held_lens, begun), reasons=corrected.reasons)
    return replace(chosen, structure=(found, *chosen.structure))


def _choose(problem: FitData, begun: _FitStart) -> Chosen:
    start, held = begun.start, begun.held
    paper = problem.layout("paper")

    def fit(model: LensName, problem: FitData = problem) -> Screened:
        layout = problem.layout(model)
        first = start if model == "paper" else unfolded(problem, layout, converted(start, paper, layout))
        return fit_lens(problem, layout, first, begun.apart)

    wanted = problem.options.lens
    if wanted != "auto":
        asked = _Candidate(fit(wanted), held)
        known: list[Structure] = []
        if wanted != "paper" and problem.staged:
            # a lens that was asked for takes a contradiction up as one that was found does
            with suppress(CalibrationError):
                known = _Candidate(fit("paper"), held).no_lens(LENS_LEVELS[0][1])
        result = _result(asked, (f"The lens model {wanted} was asked for.",), known)
        moved_mm, tilted = _with_tilt(asked, fit)
        if tilted is None:
            return result
        text = (
            "A tilted sensor in place of stages off the optical axes would leave the same residuals and move the shape "
            f'by {1e3 * moved_mm:.2g} um, more than is reported. The lens "auto" has both as unknowns.'
        )
        return replace(result, structure=(*result.structure, Structure(AXES, None, {}, 1.0, 0.0, text)))
    reasons: list[str] = []
    best = _Candidate(fit("paper"), held)
    while True:
        name = best.model
        models, names, probability, level, worst = best.richer
        if worst is None:
            reasons.append(f"{name}: more lens terms would explain no more than chance does (p = {probability:.2g}).")
            break
        if found := best.no_lens(level, names):
            reasons.append(f"{name}: its residuals are no lens's: {found[0].name}, p = {found[0].probability:.1g}.")
            break
        reasons.append(
            f"{name}: its residuals ask for further lens terms ({worst.name} of {worst.camera}, p = {probability:.1g}, "
            f"{worst.rms_px:.4f} px rms)."
        )
        fits: list[Screened] = []
        why = ""
        for one in models:  # a prism and a tilt look much alike to first order
            try:
                fits.append(fit(one))
            except CalibrationError as error:
                why = error.cause
        if not fits:
            reasons.append(f"{' or '.join(models)} is not determined by these views: {why}")
            break
        trial = _Candidate(min(fits, key=lambda f: float(np.sum(f.adjustment.noise_px**2))), held)
        model = trial.model
        before, after = best.held_out_rbe_px, trial.held_out_rbe_px
        if before is not None and after is not None:
            better = after <= _WORSE * before
            reasons.append(f"Held-out RBE {after:.4f} px under {model}, {before:.4f} px under {name}.")
            if not better:
                reasons.append(f"{name} was kept: views left out of the fit do not confirm {model}.")
                break
        best = trial
    moved_mm, tilted = _with_tilt(best, fit)
    if tilted is None:
        result = _result(best, tuple(reasons))
        return _tilted_throughout(result, held, fit) or _or_tilted(result, fit)
    reasons.append(
        f"{best.model}: a tilted sensor would leave the same residuals and move the shape by {1e3 * moved_mm:.2g} um: "
        "its tilt and those of the stages are unknowns."
    )
    seen = [replace(s, freed=None) for s in in_words(best.screened, best.contradicted, best.asked[1]) if s.name == AXES]
    result = _result(_Candidate(tilted, held), tuple(reasons))
    return replace(result, structure=(*seen, *result.structure))


def fit_lens(problem: FitData, layout: Layout, start: State, apart: Sequence[int] = ()) -> Screened:
    """Return the fit under a layout's lens; that of a tilted sensor may take many iterations."""
    if "tau_x_rad" not in layout.form.distortion_names:
        return fit_screened(problem, layout, start, apart)
    # poses, centres and decentring make room for a tilt along a curved valley
    patient = replace(problem, options=replace(problem.options, max_iterations=_ITERATIONS))
    fitted = fit_screened(patient, layout, start, apart)
    return replace(fitted, problem=replace(fitted.problem, options=problem.options))


def richer_lenses(screened: Screened) -> list[LensName]:
    """Return the lens models with further terms that the residuals of a fit ask for, one of which is the right one."""
    return _Candidate(screened, ()).richer[0]


def _with_tilt(best: _Candidate, fit: Callable[..., Screened]) -> tuple[float, Screened | None]:
    """Return the shape's change by a tilted sensor, mm, and the fit with one; None if it hardly matters."""
    found = best.screened
    if best.model in TILTED and may_be_tilted(found, best.contradicted):
        if any(s.name == "bow" for s in best.no_lens(0.0)):
            return 0.0, None  # a bow shows as axes that are off
        with suppress(CalibrationError):
            tilted = fit(TILTED[best.model], with_open_axes(found.problem, found))
            moved_mm = moved_by_tilt(found, tilted)
            if moved_mm is not None:
                return moved_mm, tilted
    return 0.0, None


def _tilted_throughout(result: Chosen, held: Sequence[CalibrationView], fit: Callable[..., Screened]) -> Chosen | None:
    """Return the choice with tilted sensors if these explain all structure of the residuals."""
    found, model = result.screened, TILTED.get(result.model)
    names = {s.name for s in result.structure}
    if model is None or not has_own_stages(found) or not names or not names <= LIKE_A_TILT:
        return None
    groups, score = scored(
        found.adjustment, found.rows, found.problem.flat_nodes_mm, found.problem.nominals, tilted=True
    )
    # a sheared grid is one tilt of both sensors
    if not no_target(groups, score, lens_significance(groups, score, (), (_TILT,))[1], staged=True):
        return None
    with suppress(CalibrationError):
        tilted = _Candidate(fit(model, with_open_axes(found.problem, found)), held)
        before, after = _Candidate(found, held).held_out_rbe_px, tilted.held_out_rbe_px
        if before is not None and after is not None and after > before:
            return None
        reason = f"{result.model}: a tilted sensor explains all that it leaves ({', '.join(sorted(names))})."
        chosen = _result(tilted, (*result.reasons, reason))
        if not chosen.structure:
            return chosen
    return None


def _or_tilted(result: Chosen, fit: Callable[..., Screened]) -> Chosen:
    """Add to contradicting scales or a sheared target that tilted sensors would leave the same residuals, if so."""
    found, model = result.screened, TILTED.get(result.model)
    like = {*SCALE_GROUPS, UNEQUAL_PITCH}
    if model is None or not has_own_stages(found) or not {s.name for s in result.structure} & like:
        return result
    with suppress(CalibrationError):
        tilted = fit(model, with_open_axes(found.problem, found))
        if text := as_tilts(tilted, with_open_scales(fit(UNTILTED[model]))):
            named = [replace(s, sentence=f"{s.text} {text}") if s.name in like else s for s in result.structure]
            return replace(result, structure=tuple(named))
    return result


class _Candidate:
    def __init__(self, screened: Screened, held: Sequence[CalibrationView]) -> None:
        self.screened = screened
        self.given = held

    @cached_property
    def held(self) -> list[HeldOutView]:
        return _held_out(self.screened, self.given)

    @cached_property
    def asked(self) -> tuple[list[Group], Score]:
        s = self.screened
        return scored(s.adjustment, s.rows, s.problem.flat_nodes_mm, s.problem.nominals)

    @property
    def model(self) -> LensName:
        return self.screened.adjustment.layout.form.model

    @cached_property
    def bent(self) -> list[Structure]:
        """Thin prism and tilted sensor, each if the residuals ask for it and it is no error of the target."""
        s, known = self.screened, _BENT.get(self.model, {})
        found: list[Structure] = []
        if known:
            tilted = _TILT in known
            groups, score = scored(s.adjustment, s.rows, s.problem.flat_nodes_mm, s.problem.nominals, tilted=tilted)
            for name in known:
                probability, best = lens_significance(groups, score, (), (name,))
                best = replace(best, probability=min(1.0, probability * len(known)))
                if best.probability <= _BENT_LEVEL and no_target(groups, score, best, staged=bool(s.problem.staged)):
                    found.append(best)
        return sorted(found, key=lambda b: b.probability)

    @cached_property
    def richer(self) -> tuple[list[LensName], Sequence[str], float, float, Structure | None]:
        """Lens models that the residuals ask for, their terms, probability, its level, and the most certain term."""
        model, level = _RICHER.get(self.model, (self.model, 0.0))
        probability, worst = lens_significance(*self.asked) if model != self.model else (1.0, None)
        bent = self.bent if probability > level or self.model != "paper" else []
        if bent and bent[0].probability < (probability if probability <= level else 1.0):
            models = [_BENT[self.model][b.name] for b in bent]
            return models, tuple(b.name for b in bent), bent[0].probability, _BENT_LEVEL, bent[0]
        if probability > level:
            return [], (), probability, level, None
        return [model], LENS_TERMS, probability, level, worst

    @cached_property
    def contradicted(self) -> list[tuple[Structure, Group]]:
        return contradicted(*self.asked)

    def no_lens(self, level: float, names: Sequence[str] = LENS_TERMS) -> list[Structure]:
        """Return causes of the residuals other than lens terms, which ask for no richer lens; empty without any."""
        given = [group for _, group in self.contradicted]
        if not given:
            bow = bow_of(*self.asked) if self.screened.problem.staged else None
            return [bow] if bow is not None and bow.rms_px > lens_share_px(*self.asked) else []
        # a millimetre measured twice explains more than all terms of a lens, or it would not be among these. With
        # stages off their axes a tilt of the sensor, alike to first order, is not asked for
        lens = any(g.name in names for g in self.asked[0])
        if given[-1].name in SCALE_GROUPS or not lens or lens_significance(*self.asked, given, names)[0] > level:
            return in_words(self.screened, self.contradicted, self.asked[1])
        return []

    @property
    def held_out_rbe_px(self) -> float | None:
        if not self.held:
            return None
        a = self.screened.adjustment
        nodes = points_mm(self.screened.problem, a.layout, a.state)
        errors = np.concatenate([np.linalg.norm(h.xy_px - h.camera.project(nodes).xy, axis=1) for h in self.held])
        return float(np.nanmean(errors))


def _held_out(screened: Screened, held: Sequence[CalibrationView]) -> list[HeldOutView]:
    a, problem = screened.adjustment, screened.problem
    staged = staged_views(problem, a.layout, a.state, held)
    free = [v for v in held if v.frame is not None]
    if free:
        return staged + held_out_views(problem, a.layout, a.state, free)
    return staged if staged else leave_out_in_turn(screened)


def _result(best: _Candidate, reasons: tuple[str, ...], known: Sequence[Structure] = ()) -> Chosen:
    """Return the choice with the structure of its residuals, after contradictions that a simpler lens showed."""
    groups, score = best.asked
    # a richer lens mixes contradictions that the simple one separated
    found = [] if known else in_words(best.screened, best.contradicted, score)
    wrong = any(f.name in SCALE_GROUPS and f.probability < FAILED_LEVEL for f in (*known, *found))
    if not wrong:  # the terms' names mean nothing for a rig that contradicts itself
        found += find_structure(groups, score, [group for _, group in best.contradicted])
    names = {f.name for f in known}
    structure = (*(replace(f, freed=None) for f in known), *(f for f in found if f.name not in names))
    return Chosen(best.screened, tuple(best.held), structure, reasons, scale_seen(groups, score), unseen(groups, score))
