"""The material card as an evaluation: results, load and statements in, the card out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, MeasurementError
from stereorig.core.progress import Progress
from stereorig.server.evaluations.cards import CardNumber, MarkFound, number_found, number_missing
from stereorig.server.evaluations.door import Evaluated, Results
from stereorig.server.evaluations.histories import Ends, History, Mean, corners_of
from stereorig.server.evaluations.specimens import over_specimens, table_over
from stereorig.server.evaluations.tensile.assessment import Assessed, Found, assessed
from stereorig.server.evaluations.tensile.curve import AXIAL, LATERAL, STRESS, Curve, with_load_errors
from stereorig.server.evaluations.tensile.document import CurveFound, MaterialCardFound, page_of, table_of
from stereorig.server.evaluations.tensile.flexure import strain_of_deflection, with_beam_errors
from stereorig.server.evaluations.tensile.planning import Asked
from stereorig.server.evaluations.tensile.profiles import PROFILES, UNITS, Profile
from stereorig.server.evaluations.tensile.settings import TensileSettings
from stereorig.server.formats.channel_units import newtons_of
from stereorig.server.results.channels import Recorded


class MaterialCard:
    """The evaluation."""

    name = "tensile"
    title = "Material card of a tensile test"
    settings = TensileSettings
    document = MaterialCardFound
    needs: frozenset[str] = frozenset()

    def run(self, results: Results, asked: TensileSettings, progress: Progress) -> Evaluated:
        """Work out the card.

        Raises
        ------
        InputError
            ``section_missing``, ``load_missing``, ``load_unit``, ``load_uncertainty_missing``, ``times_missing``,
            ``not_on_card``.
        MeasurementError
            ``no_valid_points`` if no step has a strain and a load.
        """
        profile = PROFILES[asked.standard]
        unknown = [key for key in asked.require if key not in profile.numbers]
        if unknown:
            raise InputError(
                f"{profile.title} has no number {unknown[0]!r}; it has {', '.join(profile.numbers)}.",
                code="not_on_card",
                remedy="Require one of these.",
            )
        curve, missing = curve_of(results, asked, progress)
        rules = Asked(asked.min_steps, asked.sampling_share, asked.r_window, asked.n_window)
        expected = None if asked.expected_modulus_mpa is None else np.array(asked.expected_modulus_mpa)
        found = assessed(curve, profile, rules, expected)
        local = None
        if asked.local_px is not None:
            local = results.history(Mean(asked.components[0], corners_of(asked.local_px), asked.pull_px))
            local = local.at(np.isin(results.steps, curve.steps))
        card = _card(curve, found, profile, asked, missing, local)
        files = {".csv": table_of(card), ".html": page_of(self.title, card)}
        return Evaluated(card, results.steps[-1], files=files)

    def over(self, cards: Mapping[str, MaterialCardFound]) -> Evaluated:
        """Return mean, spread and bound of each number over specimens."""
        found = over_specimens(cards)
        return Evaluated(found, files={".csv": table_over(found)})


def curve_of(results: Results, asked: TensileSettings, progress: Progress) -> tuple[Curve, list[str]]:
    """Return the curve that results and statements give, and the parts of the uncertainty that it lacks."""
    section, section_u = asked.section()
    recorded = [results.recorded(step) for step in results.steps]
    load, load_u = _loads(recorded, asked)
    progress("reading strains", 0, 1)
    axial, lateral = _strains(results, asked)
    n = len(load)
    values = np.stack([axial.value, np.full(n, np.nan) if lateral is None else lateral.value, load / section])
    own = np.stack([axial.own, np.zeros(n) if lateral is None else lateral.own, load_u / section])
    there = np.isfinite(values[STRESS]) & np.isfinite(own[[AXIAL, STRESS]]).all(axis=0)
    if not (there & np.isfinite(values[AXIAL])).any():
        raise MeasurementError(
            "No step has both a strain with its uncertainty and a load.",
            code="no_valid_points",
            remedy="Look at the points' status in the gauge's area, and at the load of the steps.",
        )
    times = np.array([np.nan if one.time_s is None else one.time_s for one in recorded])[there]
    rising = bool(np.isfinite(times).all() and (np.diff(times) > 0.0).all())
    if (asked.load_late_s or asked.load_late_u_s) and not rising:
        raise InputError(
            "The load is said to be late, and the times of the steps are not known or do not rise.",
            code="times_missing",
            remedy="Import the images with their times, or leave load_late_s and load_late_u_s out.",
        )
    shared = {cause: columns[:, :, there] for cause, columns in _joined(axial, lateral).items()}
    names = {name for one in recorded for name in one.channels} - {asked.load_channel}
    others = {name: np.array([one.channels.get(name, np.nan) for one in recorded])[there] for name in sorted(names)}
    curve = Curve(
        values[:, there], own[:, there], shared, np.array(results.steps)[there], times if rising else None, others
    )
    missing = ["change of the stated section along the gauge"]
    missing += [] if axial.known and (lateral is None or lateral.known) else ["calibration of the cameras"]
    return with_load_errors(
        with_beam_errors(curve, asked),
        scale_u=asked.load_scale_u or 0.0,
        offset_u_mpa=asked.load_zero_u_n * asked.load_scale / section,
        section_u=section_u,
        late_s=asked.load_late_s,
        late_u_s=asked.load_late_u_s,
    ), missing


def _strains(results: Results, asked: TensileSettings) -> tuple[History, History | None]:
    if asked.deflection_px is not None:
        return strain_of_deflection(results, asked), None
    along, across = asked.components
    corners = corners_of(asked.rectangle_px)
    ends = None if asked.extensometer_px is None else Ends(*asked.extensometer_px)
    axial = results.history(ends or Mean(along, corners, asked.pull_px))
    if not asked.lateral or asked.span_mm is not None:
        return axial, None
    ends = None if asked.lateral_px is None else Ends(*asked.lateral_px)
    return axial, results.history(ends or Mean(across, corners, asked.pull_px))


def _joined(axial: History, lateral: History | None) -> dict[str, Float]:
    """Return the errors of both strains (k, 3, n) by cause; those of the cameras are the same, of the reference not."""
    n, found = len(axial.value), {}
    for cause in dict.fromkeys([*axial.shared, *(() if lateral is None else lateral.shared)]):
        one, two = (np.zeros((n, 0)) if h is None else h.shared.get(cause, np.zeros((n, 0))) for h in (axial, lateral))
        apart = one.shape[1] if cause == "reference" else 0
        out = np.zeros((max(one.shape[1], apart + two.shape[1]), 3, n))
        out[: one.shape[1], AXIAL] = one.T
        out[apart : apart + two.shape[1], LATERAL] = two.T
        found[cause] = out
    return found


def _loads(recorded: list[Recorded], asked: TensileSettings) -> tuple[Float, Float]:
    """Return the load of each step in N, NaN where there is none, and the standard uncertainty of each reading."""
    name = asked.load_channel
    raw = [one.load_n if name is None else one.channels.get(name) for one in recorded]
    if all(value is None for value in raw):
        known = sorted({key for one in recorded for key in one.channels})
        raise InputError(
            f"No step has {'a load' if name is None else f'the channel {name!r}'}; there are "
            f"{', '.join(known) or 'no channels'}.",
            code="load_missing",
            remedy="Name the load channel, or add the load frame's record to the test.",
        )
    units = [one.units.get(name or "", "1") for one in recorded]
    newtons = 1.0 if name is None else newtons_of(name, units, asked.load_unit)
    stated = [None if name is None else one.u.get(name) for one in recorded]
    own = asked.load_u_n
    if asked.load_scale_u is None or (own is None and any(u is None for u in stated)):
        raise InputError(
            "The uncertainty of the load is not stated, and no number's interval holds without it.",
            code="load_uncertainty_missing",
            remedy="State load_scale_u (class 0.5 of ISO 7500-1: 0.0029) and load_u_n.",
        )
    load = np.array([np.nan if value is None else float(value) for value in raw]) * newtons
    each = [own if own is not None else float(u or 0.0) * newtons for u in stated]
    return (load - asked.load_zero_n) * asked.load_scale, np.array(each) * asked.load_scale


def _card(
    curve: Curve, found: Assessed, profile: Profile, asked: TensileSettings, missing: list[str], local: History | None
) -> MaterialCardFound:
    numbers = {symbol: _number(key, found.numbers[key]) for key, symbol in profile.numbers.items()}
    verdict: str = "good"
    if any(one.state == "doubtful" for one in numbers.values()):
        verdict = "doubtful"
    elif any(one.state == "missing" for one in numbers.values() if one.key in asked.require):
        verdict = "incomplete"
    return MaterialCardFound.model_validate(
        {
            "verdict": verdict,
            "accepted": verdict == "good",
            "standard": profile.title,
            "section_mm2": asked.section()[0],
            "numbers": numbers,
            "toe_strain": None if found.toe is None else found.toe.value,
            "window_steps": list(found.used),
            "marks": [MarkFound(code=one.code, text=one.text, steps=list(one.steps)) for one in found.marks],
            "not_included": missing,
            "curve": _curve(curve, local),
        }
    )


def _number(key: str, found: Found) -> CardNumber:
    units, one = UNITS[key], found.number
    if one is None:
        why = "" if found.lack is None else f"{found.lack.code}: {found.lack.text}"
        return number_missing(key, units, why)
    return number_found(key, one.value, units, one.parts, found.doubts)


def _curve(curve: Curve, local: History | None) -> CurveFound:
    axial, lateral, stress = curve.values
    whole = np.sqrt(curve.own**2 + sum((columns**2).sum(axis=0) for columns in curve.shared.values()))
    near, near_u = (axial, whole[AXIAL]) if local is None else (local.value, local.whole)
    lists: Mapping[str, Float] = {
        "strain": axial,
        "lateral": lateral,
        "stress_mpa": stress,
        "strain_u": whole[AXIAL],
        "stress_u_mpa": whole[STRESS],
        "true_strain": np.log1p(near),
        "true_strain_u": near_u / (1.0 + near),
        "true_stress_mpa": stress * (1.0 + near),
    }
    plain = {name: [float(v) if np.isfinite(v) else None for v in values] for name, values in lists.items()}
    return CurveFound(steps=[int(step) for step in curve.steps], **plain)
