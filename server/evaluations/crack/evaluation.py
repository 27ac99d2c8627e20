"""The crack's numbers as an evaluation: results and statements in, the card out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from stereorig.core.errors import InputError, MeasurementError
from stereorig.core.progress import Progress
from stereorig.server.evaluations.cards import Lack, Mark, MarkFound, number_found, number_missing
from stereorig.server.evaluations.centre_crack import K_I, Panel, beside
from stereorig.server.evaluations.crack.assessment import NUMBERS, Assessed, Problem, assessed, parts_of
from stereorig.server.evaluations.crack.document import (
    CrackCardFound,
    CrackStepFound,
    GrowthFound,
    OpeningFound,
    OutOfPlaneFound,
    RingFound,
    page_of,
    table_of,
)
from stereorig.server.evaluations.crack.drawn import drawn_crack
from stereorig.server.evaluations.crack.growth import Growth
from stereorig.server.evaluations.crack.settings import CrackSettings
from stereorig.server.evaluations.door import Evaluated, Results
from stereorig.server.evaluations.histories import shared_pixels
from stereorig.server.results.channels import Recorded


class CrackCard:
    """The evaluation."""

    name = "crack"
    title = "Stress intensity, J and growth of a crack"
    settings = CrackSettings
    document = CrackCardFound
    needs: frozenset[str] = frozenset()

    def run(self, results: Results, asked: CrackSettings, progress: Progress) -> Evaluated:
        """Work out the card.

        Raises
        ------
        InputError
            ``modulus_missing``, ``modulus_unit_missing``, ``no_displacement``, ``crack_smoothed``,
            ``cycles_missing``, ``panel_invalid``, and those of the drawn crack.
        MeasurementError
            ``too_few_points`` if no step has enough in the ring.
        """
        elastic = asked.elastic()
        moved = [step for step in results.steps if results.field(step).has_motion]
        if not moved:
            raise InputError(
                "No step has displacements.",
                code="no_displacement",
                remedy="Measure the displacements of loaded steps.",
            )
        recorded = {step: results.recorded(step) for step in moved}
        _check_cycles(recorded, asked)
        first = results.field(moved[0])
        shared = shared_pixels(results.file(moved[0]), first)
        crack = drawn_crack(first, shared, asked)
        degrees = asked.direction_u_deg
        direction_u = crack.scale / crack.outer_mm if degrees is None else math.radians(degrees)
        problem = Problem(shared, crack, elastic, asked, direction_u)
        steps: list[tuple[CrackStepFound, Sequence[Lack | Mark]]] = []
        growth = Growth(first, shared)
        unknown = False
        start = np.zeros(2)
        for k, step in enumerate(moved):
            progress("crack", k, len(moved))
            field = results.field(step)
            if field.smoothing is not None:
                raise InputError(
                    f"The displacements of step {step} are smoothed, over the crack's tip as well.",
                    code="crack_smoothed",
                    remedy="Measure without smoothing.",
                )
            found = assessed(field, problem, start)
            unknown |= field.common is None
            one = _step(step, found, recorded[step], problem)
            # the points take more memory than all else: they are not kept
            steps.append((one, [found] if isinstance(found, Lack) else found.doubts))
            if isinstance(found, Assessed):
                start = found.fit.tip_mm
                growth.add(step, one.cycles, found)
        card = _card(steps, growth.document(crack.length_mm), problem, unknown)
        return Evaluated(card, moved[-1], files={".csv": table_of(card), ".html": page_of(self.title, card)})


def _check_cycles(recorded: dict[int, Recorded], asked: CrackSettings) -> None:
    """Refuse growth over a channel that there is not."""
    name = asked.cycles_channel
    if name is not None and any(name not in one.channels for one in recorded.values()):
        known = sorted({key for one in recorded.values() for key in one.channels})
        raise InputError(
            f"Not every step has the channel {name!r}; there are {', '.join(known) or 'no channels'}.",
            code="cycles_missing",
            remedy="Name the channel that counts the load cycles, or leave cycles_channel out.",
        )


def _step(step: int, found: Assessed | Lack, recorded: Recorded, of: Problem) -> CrackStepFound:
    cycles = None if of.asked.cycles_channel is None else recorded.channels.get(of.asked.cycles_channel)
    one = CrackStepFound(step=step, load_n=recorded.load_n, cycles=cycles, state="missing")
    if isinstance(found, Lack):
        one.why = f"{found.code}: {found.text}"
        return one
    for key, (symbol, units) in NUMBERS.items():
        if key in found.numbers:
            doubts = [doubt.code for doubt in found.doubts if key in doubt.spoils]
            one.numbers[symbol] = number_found(key, found.numbers[key].value, units, parts_of(found, key), doubts)
        else:
            one.numbers[symbol] = number_missing(key, units, "ring_not_measured: points near the faces are missing.")
    one.state = "doubtful" if any(number.state == "doubtful" for number in one.numbers.values()) else "good"
    if of.asked.panel is not None:
        # the other end is as drawn, to a pixel
        half_u = {"tip": 0.5 * (one.numbers["tip x"].u or 0.0), "other_end": 0.5 * of.crack.scale}
        half = 0.5 * (of.crack.length_mm + float(found.fit.tip_mm[0]))
        one.numbers |= beside(one.numbers[K_I], Panel(*of.asked.panel), one.load_n, half, half_u)
    one.tip_px = of.crack.pixel(found.fit.tip_mm).tolist()
    one.order, one.points = found.fit.order, len(found.points.few.at)
    one.chi_square, one.degrees = found.fit.chi_square, found.fit.degrees
    one.rings = [RingFound(inner_mm=a, outer_mm=b, j=ring.value, u=u) for a, b, ring, u in found.paths]
    one.opening = OpeningFound(
        behind_mm=found.opening.behind_mm.tolist(),
        across_mm=found.opening.value[:, 1].tolist(),
        across_u_mm=found.opening_u[:, 1].tolist(),
        along_mm=found.opening.value[:, 0].tolist(),
        along_u_mm=found.opening_u[:, 0].tolist(),
    )
    w, whole = found.points.uvw_mm[:, 2], found.paths[-1][2] if found.paths else None
    one.out_of_plane = OutOfPlaneFound(
        highest_mm=float(w.max()),
        lowest_mm=float(w.min()),
        u_mm=float(np.median(found.points.sigma_w_mm)),
        slope=None if whole is None else whole.slope,
        strain=None if whole is None else whole.strain,
    )
    return one


def _card(
    steps: list[tuple[CrackStepFound, Sequence[Lack | Mark]]], growth: GrowthFound | None, of: Problem, unknown: bool
) -> CrackCardFound:
    states = {one.state for one, _ in steps}
    if states == {"missing"} and all(mark.code == "too_few_points" for _, named in steps for mark in named):
        raise MeasurementError(
            steps[0][1][0].text,
            code="too_few_points",
            remedy="State a larger outer_mm, measure with a smaller spacing, or look at the points' status.",
        )
    marks: dict[str, MarkFound] = {}
    for one, named in steps:
        for mark in named:
            marks.setdefault(mark.code, MarkFound(code=mark.code, text=mark.text, steps=[])).steps.append(one.step)
    verdict = "doubtful" if "doubtful" in states else "good" if "good" in states else "incomplete"
    return CrackCardFound.model_validate(
        {
            "verdict": verdict,
            "accepted": verdict == "good",
            "state": of.elastic.state,
            "youngs_modulus_mpa": of.elastic.youngs_modulus,
            "poisson": of.elastic.poisson,
            "drawn_length_mm": of.crack.length_mm,
            "inner_mm": of.crack.inner_mm,
            "outer_mm": of.crack.outer_mm,
            "steps": [one for one, _ in steps],
            "growth": growth,
            "marks": list(marks.values()),
            "not_included": ["calibration of the cameras"] if unknown else [],
        }
    )
