"""Declarations that the views contradict: tested together with the lens terms by the same score tests, and worded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.choice.declared import (
    ASPECTS,
    AXES,
    DECLARED,
    MOVED,
    POSITIONS,
    SCALE,
    SCALE_GROUPS,
    SCALES,
    TURNS,
    position_name,
)
from stereorig.core.calibration.choice.screening import Screened, fit_screened
from stereorig.core.calibration.choice.structure import (
    SIGNIFICANT,
    UNEQUAL_PITCH,
    Group,
    Score,
    Structure,
    Unseen,
    joint_terms,
)
from stereorig.core.calibration.fit.adjust import Adjustment
from stereorig.core.calibration.inputs import CalibrationOptions
from stereorig.core.errors import CalibrationError
from stereorig.core.names import CAMERAS

#: probability by chance below which two measures of a millimetre contradict each other, as for a lens's terms, shared
#: by all tests of the millimetre, so that one right calibration of a hundred comes upon any of them by chance; the
#: verdict fails from a tenth of it on
SCALE_LEVEL = 0.01 / len(SCALE_GROUPS)
FAILED_LEVEL = 0.1 * SCALE_LEVEL
# the many terms of a lens, and a smooth field, absorb all of a wrong scale and some noise, while one scale absorbs a
# hundredth of a lens's effect; one scale of each camera absorbs 0.8 of decentring, and one scale leaves 0.82 to a bow.
# An aspect ratio and a sheared target cannot be distinguished
_SHARE, _SHARE_OF_ONE, _ALIKE = 0.9, 0.7, ("aspect", UNEQUAL_PITCH)
_NEARLY = 0.85  # share of a probability's power of ten: the simplest of the scales that is nearly as certain is named
_LEAST = 1e-200  # probabilities below it are rounding
#: relative error that may be in an aspect ratio, and in a stretch or shear of a target, of which nothing is stated
UNSTATED = 1e-4
_OPEN_SCALE, _OPEN_ASPECT = 0.5, 0.1  # priors that say next to nothing
_ITERATIONS = 300  # iterations of fits that start far off


def contradicted(groups: Sequence[Group], score: Score) -> list[tuple[Structure, Group]]:
    """Return the declared quantities that the residuals contradict.

    One that terms of a lens, a bow of the target or any smooth field over the image explain better is left out. Axes,
    positions and the target's other errors have similar effects: only the most certain of them is returned, followed by
    the quantity that contradicts the millimetre.
    """
    rivals_px = [_rivals_px(groups, score, one=one) for one in (False, True)]
    axes = [(score.test(g, []).probability, g) for g in groups if g.name == AXES]
    found: list[tuple[Structure, Group]] = []
    left = [g for g in groups if g.name in DECLARED]
    while left:
        given = [g for _, g in found]
        tests = [(score.test(g, given), g) for g in left]
        if axes and axes[0][0] < FAILED_LEVEL and axes[0][1] not in given:
            # axes near the limit of their prior pull aspect ratios apart, and no scale is wrong
            tests = [
                (score.test(g, [*given, axes[0][1]]) if g.name in SCALE_GROUPS and axes[0][0] < t.probability else t, g)
                for t, g in tests
            ]
        # after another finding the amounts are no longer small, and a test to first order is less sure
        levels = [SCALE_LEVEL if g.name in SCALE_GROUPS and not found else SIGNIFICANT for g in left]
        certain = [
            (t, g)
            for (t, g), level in zip(tests, levels, strict=True)
            if t.probability < level and t.rms_px > rivals_px[len(g.columns) == 1]
        ]
        if not certain:
            break
        best = min(certain, key=lambda pair: pair[0].probability)
        if best[1].name in SCALE_GROUPS:
            nearly = max(best[0].probability ** _NEARLY, _LEAST)
            # the simplest of them that explains nearly as much
            return [*found, next(pair for pair in certain if pair[0].probability <= nearly)]
        found.append(best)
        left = [g for g in left if g.name in SCALE_GROUPS]
    return found


def _rivals_px(groups: Sequence[Group], score: Score, *, one: bool) -> float:
    """Rms of the largest effect of other causes beyond chance, less the part that a wrong scale causes.

    ``one``: to one scale for both cameras.
    """
    kinds: dict[str, list[Group]] = {}
    for group in (*joint_terms(groups), *groups):
        if group.name not in (*DECLARED, *_ALIKE):
            kinds.setdefault(group.name, []).append(group)
    largest = 0.0
    for name, own in kinds.items():
        tests = [score.test(g, []) for g in own]
        if min(t.probability for t in tests) < SIGNIFICANT:
            squares = [max(t.rms_px**2 - score.chance_px(g) ** 2, 0.0) for t, g in zip(tests, own, strict=True)]
            share = _SHARE_OF_ONE if one and name != "bow" else _SHARE
            largest = max(largest, share * float(np.sqrt(np.mean(squares))))
    return largest


def bow_of(groups: Sequence[Group], score: Score) -> Structure | None:
    """Return the bow of a target that was declared exact, if the residuals show one."""
    own = [score.test(g, []) for g in groups if g.name == "bow"]
    return own[0] if own and own[0].probability < SIGNIFICANT else None


def scale_seen(groups: Sequence[Group], score: Score) -> tuple[float, float] | None:
    """Return how much longer the stage's travel is by the pitch than as read, relative, and the standard deviation.

    None if only the target measures a millimetre.
    """
    for group in groups:
        if group.name == SCALE:
            value, sigma = score.test(group, []).terms["pitch"]
            return -value, sigma
    return None


def unseen(groups: Sequence[Group], score: Score) -> tuple[Unseen, ...]:
    """Return the errors that aspect ratios and a target taken as exact may have, as far as these views hide them."""
    return tuple(score.hidden(g, UNSTATED) for g in groups if g.name in (ASPECTS, UNEQUAL_PITCH))


def in_words(screened: Screened, found: Sequence[tuple[Structure, Group]], score: Score) -> list[Structure]:
    """Return contradictions with their amounts, each as a sentence; scales by a fit that frees them."""
    out = []
    groups = [g for _, g in found]
    freed = score.freed(groups, [score.weights(g, groups[:k]) for k, g in enumerate(groups)], ())
    for k, ((named, group), terms) in enumerate(zip(found, freed, strict=True)):
        given, structure = groups[:k], replace(named, freed=terms)
        if group.name in SCALE_GROUPS:
            stated = _scale(screened, structure)
            off, sigma = stated.terms.get(SCALE, (np.inf, 0.0))
            # after another finding the first-order test is less sure, as the amount may be large
            if not k or abs(off) > 2.0 * sigma:
                out.append(stated)
        elif group.name == POSITIONS:
            out.append(replace(structure, sentence=_positions(screened.adjustment, group, score, given)))
        else:
            worded = {AXES: _axes, TURNS: _turns, MOVED: _moved}[group.name]
            out.append(replace(structure, sentence=worded(screened, structure)))
    return out


def _refitted(screened: Screened, options: CalibrationOptions) -> Screened:
    problem = replace(screened.problem, options=replace(options, max_iterations=_ITERATIONS))
    return fit_screened(problem, screened.adjustment.layout, screened.adjustment.state)


def with_open_scales(screened: Screened) -> Screened:
    """Return the fit that chooses stage scales and aspect ratios by the residuals alone."""
    options = replace(screened.problem.options, stage_scale_sigma=_OPEN_SCALE, aspect_sigma=_OPEN_ASPECT)
    return _refitted(screened, options)


def _scale(screened: Screened, structure: Structure) -> Structure:
    """Word a contradiction of stage, pitch and aspect ratio, with other causes that would leave the same residuals."""
    problem, layout = screened.problem, screened.adjustment.layout
    aspects = [layout.lens(c).stop - 1 for c in range(2)]
    terms: dict[str, tuple[float, float]] = {}
    texts: list[str] = []
    try:
        axes = sorted({axis for axis, _ in layout.steps})
        # the pitch as an open unknown leaves a curved valley, along which a fit takes hundreds of steps; stages do not
        freed = _refitted(screened, replace(problem.options, stage_scale_sigma=_OPEN_SCALE))
        stages = _values(freed, [layout.stage_scale(axis) for axis in axes])
        weights = np.array([s**-2 for _, s in stages])
        off = float(weights @ [v for v, _ in stages] / weights.sum())
        sigma = float(weights.sum() ** -0.5)
        terms[SCALE] = off, sigma
        mm = float(np.linalg.norm(problem.nodes_mm[1, 0] - problem.nodes_mm[0, 0]))
        texts.append(
            f"Stage and grid disagree by {100.0 * abs(off):.2f} +- {100.0 * sigma:.2f} %: by the stage's millimetre "
            f"the pitch is {mm / (1.0 + off):.5g} mm, declared are {mm:.5g} mm."
        )
        if structure.name == SCALES:
            terms.update({f"stage {axis + 1}": value for axis, value in zip(axes, stages, strict=True)})
            parts = [
                f"{n}'s by {100.0 * v:+.2f} +- {100.0 * s:.2f} %" for n, (v, s) in zip(CAMERAS, stages, strict=True)
            ]
            texts.append(f"By the grid, the stages travel farther than they read: {' and '.join(parts)}.")
        if not layout.frames:
            values = _values(_refitted(screened, replace(problem.options, aspect_sigma=_OPEN_ASPECT)), aspects)
            terms.update({f"aspect {c + 1}": value for c, value in enumerate(values)})
            shown = " and ".join(f"{v:.4f} +- {s:.4f}" for v, s in values)
            given = " and ".join(f"{n.aspect:.5g}" for n in problem.nominals)
            texts.append(f"Aspect ratios of {shown} in place of {given} would leave nearly the same residuals.")
    except CalibrationError:
        texts = texts or ["Stage and grid disagree."]
        texts.append("Another aspect ratio than declared would leave nearly the same residuals.")
    return replace(structure, terms=terms or structure.terms, sentence=" ".join(texts))


def _values(screened: Screened, places: Sequence[int]) -> list[tuple[float, float]]:
    """Return value and standard deviation of some unknowns."""
    found = screened.adjustment
    return [(float(found.state.x[k]), float(np.sqrt(found.covariance[k, k]))) for k in places]


def _positions(adjustment: Adjustment, group: Group, score: Score, given: Sequence[Group]) -> str:
    """Put errors of the positions read back in words: one that alone explains them, or how far all scatter."""
    steps = adjustment.layout.steps
    alone = [Group(POSITIONS, None, (name,), group.columns[k : k + 1]) for k, name in enumerate(group.names)]
    k = min(range(len(alone)), key=lambda k: score.test(alone[k], given).probability)
    axis, dz = steps[k]
    whose = f"{CAMERAS[axis]}'s stage" if adjustment.layout.moves == "cameras" else "the stage"
    if score.test(group, [*given, alone[k]]).probability > SIGNIFICANT:
        value, sigma = score.test(alone[k], given).terms[position_name(axis, dz)]
        return (
            f"The position {dz:+.3f} mm of {whose} is off by {1e3 * value:+.1f} +- {1e3 * sigma:.1f} um against the "
            "others: it slipped there, or something moved."
        )
    scatter = score.spread(group, given)
    return (
        f"The stage's positions are off by {1e3 * scatter:.1f} um rms against the images, most of all {dz:+.3f} mm of "
        f"{whose}. Declare stage_step_sigma_mm, or look for a periodic error of the screw."
    )


def with_open_steps(screened: Screened, groups: Sequence[Group], score: Score) -> Screened:
    """Return the fit with errors of the positions read back as unknowns, with a prior as large as they scatter."""
    options = screened.problem.options
    scatter = max(score.spread(g, ()) for g in groups if g.name == POSITIONS)
    if scatter <= options.stage_step_sigma_mm:
        return screened
    return _refitted(screened, replace(options, stage_step_sigma_mm=scatter))


def _axes(screened: Screened, structure: Structure) -> str:
    """Put stages that travel off the optical axes in words."""
    tilts = np.array([v for v, _ in structure.terms.values()]).reshape(2, 2)
    off = [f"{n}'s by {1e3 * size:.0f} mrad" for n, size in zip(CAMERAS, np.linalg.norm(tilts, axis=1), strict=True)]
    return (
        f"The stages travel off the optical axes: {' and '.join(off)}; declared are "
        f"{1e3 * screened.problem.options.axis_tilt_sigma_rad:g} (axis_tilt_sigma_rad). A thin prism or a tilted "
        "sensor would leave nearly the same residuals."
    )


def _turns(_: Screened, structure: Structure) -> str:
    """Put stages that turn what they carry in words."""
    turns = np.array([v for v, _ in structure.terms.values()]).reshape(-1, 3)
    sizes = " and ".join(f"{1e3 * size:.2g}" for size in np.linalg.norm(turns, axis=1))
    who = "The stages turn what they carry" if len(turns) > 1 else "The stage turns what it carries"
    return f"{who} by {sizes} mrad over the travel (pitch, yaw and roll)."


def _moved(screened: Screened, structure: Structure) -> str:
    """Put a target that moved between the positions in words: the largest change from one position to the next."""
    values = np.array([v for v, _ in structure.terms.values()]).reshape(-1, 2)
    jumps: Float = np.linalg.norm(np.diff(np.vstack([np.zeros(2), values]), axis=0), axis=1)
    k = int(np.argmax(jumps))
    positions = sorted({v.position_mm for v in screened.problem.staged if v.camera == CAMERAS[0]})
    return (
        f"The target moved in its plane between the views: by about {1e3 * jumps[k]:.1f} um from {positions[k]:+.3f} "
        f"to {positions[k + 1]:+.3f} mm."
    )
