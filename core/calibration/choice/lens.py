"""The lens model: the one asked for, or the simplest whose residuals hold no structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from core.calibration.checks.flatness import check_flatness
from core.calibration.choice.held_out import HeldOutView, held_out_view, held_out_views, leave_out_in_turn
from core.calibration.choice.screening import Screened, fit_screened, points_mm
from core.calibration.choice.structure import Structure, find_structure, lens_significance
from core.calibration.choice.target_errors import find_target_errors
from core.calibration.fit.layout import camera_seeing
from core.calibration.fit.lens_form import LensName
from core.calibration.fit.problem import Problem, converted, started
from core.calibration.inputs import CalibrationView
from core.errors import CalibrationError
from core.names import CAMERAS

# by chance a right lens is given more terms once in so many calibrations; they cost a little noise, while terms that
# are missing bias the shape before their own significance is beyond doubt
LENS_LEVELS: tuple[tuple[LensName, float], ...] = (("opencv5", 0.01), ("opencv8", 1e-3))
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
        What its residuals hold beyond noise.
    reasons
        Why this lens, as sentences.
    """

    screened: Screened
    held_out: tuple[HeldOutView, ...]
    structure: tuple[Structure, ...]
    reasons: tuple[str, ...]

    @property
    def model(self) -> LensName:
        """Name of the lens model."""
        return self.screened.adjustment.layout.form.model


def choose_lens(problem: Problem, held: Sequence[CalibrationView]) -> Chosen:
    """Fit under the lens model that the options ask for, or find the simplest that leaves no structure.

    Where all views agree that points of a target declared exact lie elsewhere, the lens is chosen anew with these
    errors as unknowns, with a prior from the residuals. With free poses they are corrected, too.

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
    chosen = _choose(problem, held)
    half_side_mm = float(np.abs(problem.nodes_mm).max())
    check_flatness(chosen.structure, chosen.screened.adjustment, half_side_mm)
    fit = chosen.screened
    if fit.adjustment.priors.nodes_free:
        return chosen
    errors = find_target_errors(fit.adjustment, fit.rows, problem.flat_nodes_mm, in_space=bool(problem.frames))
    if errors is None:
        return chosen
    found, node_sigma_mm = errors
    try:
        corrected = _choose(replace(problem, node_sigma_mm=node_sigma_mm), held)
    except CalibrationError:
        # these views do not determine both; the finding stays, and lowers the verdict
        return replace(chosen, structure=(found, *chosen.structure))
    if problem.frames and problem.options.estimate_nodes is not False:
        return replace(corrected, structure=(found, *corrected.structure))
    if corrected.model != chosen.model:
        # a lens must not take up the target's errors, which every position repeats
        held_lens = replace(problem, options=replace(problem.options, lens=corrected.model))
        chosen = replace(_choose(held_lens, held), reasons=corrected.reasons)
    return replace(chosen, structure=(found, *chosen.structure))


def _choose(problem: Problem, held: Sequence[CalibrationView]) -> Chosen:
    turned, start, odd = started(problem)
    paper = turned.layout("paper")

    def fit(model: LensName) -> Screened:
        layout = turned.layout(model)
        return fit_screened(turned, layout, start if model == "paper" else converted(start, paper, layout), odd)

    wanted = problem.options.lens
    if wanted != "auto":
        screened = fit(wanted)
        return _result(screened, held, (f"The lens model {wanted} was asked for.",))
    reasons: list[str] = []
    best = _Candidate(fit("paper"), held)
    for model, level in LENS_LEVELS:
        probability, worst = best.significance
        name = best.screened.adjustment.layout.form.model
        if probability > level:
            reasons.append(f"{name}: more lens terms would explain no more than chance does (p = {probability:.2g}).")
            break
        reasons.append(
            f"{name}: its residuals ask for further lens terms ({worst.name} of {worst.camera}, p = {probability:.1g}, "
            f"{worst.rms_px:.4f} px rms)."
        )
        try:
            trial = _Candidate(fit(model), held)
        except CalibrationError as error:
            reasons.append(f"{model} is not determined by these views: {error.cause}")
            break
        before, after = best.held_out_rbe_px, trial.held_out_rbe_px
        if before is not None and after is not None:
            better = after <= _WORSE * before
            reasons.append(f"Held-out RBE {after:.4f} px under {model}, {before:.4f} px under {name}.")
            if not better:
                reasons.append(f"{name} was kept: views left out of the fit do not confirm {model}.")
                break
        best = trial
    else:
        reasons.append("opencv8: the richest lens model.")
    return _result(best.screened, held, tuple(reasons), best.held)


class _Candidate:
    def __init__(self, screened: Screened, held: Sequence[CalibrationView]) -> None:
        self.screened = screened
        self.held = _held_out(screened, held)

    @property
    def significance(self) -> tuple[float, Structure]:
        s = self.screened
        return lens_significance(s.adjustment, s.rows, s.problem.flat_nodes_mm, s.problem.nominals)

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
    staged = []
    for view in held:
        if view.dz_mm is not None:
            camera = camera_seeing(a.layout, a.state, CAMERAS.index(view.camera), view.dz_mm, None)
            staged.append(held_out_view(view, camera, points_mm(problem, a.layout, a.state)))
    free = [v for v in held if v.frame is not None]
    if free:
        return staged + held_out_views(problem, a.layout, a.state, free)
    return staged if staged else leave_out_in_turn(screened)


def _result(
    screened: Screened,
    held: Sequence[CalibrationView],
    reasons: tuple[str, ...],
    held_out: list[HeldOutView] | None = None,
) -> Chosen:
    out = _held_out(screened, held) if held_out is None else held_out
    found = find_structure(
        screened.adjustment, screened.rows, screened.problem.flat_nodes_mm, screened.problem.nominals
    )
    return Chosen(screened, tuple(out), tuple(found), reasons)
