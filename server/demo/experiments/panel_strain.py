"""Strain of the cracked panel along the load: at the crack, which a gauge may not reach over, and elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField
from stereorig.server.demo.compare import MotionComparison
from stereorig.server.demo.session import DemoCheck, Outcome, table
from stereorig.server.demo.strain import MICRO, StrainDifference, along, as_read, chi_limit, difference
from stereorig.sim.panel import CrackedPanel

LOAD_SYS = (1.0, 1.0)  # the panel hangs upright, the grid's lines at 45 degrees
_BESIDE = 0.6  # of the half crack: beyond, the tips' strain varies within a gauge
SHARE_OVER = 0.1  # of the reading of a gauge over the crack


@dataclass(frozen=True, eq=False)
class PanelStrain:
    """Strain along the load of one step, (r, c).

    Attributes
    ----------
    found, sigma, true, read
        Measured, its standard deviation, true at the point, true as the gauge reads it.
    beside
        Points whose window the crack cuts, except those near its tips.
    at_points, all_read, beside_read, beside_points
        Differences from the truth at the points and from the gauge's reading of it; everywhere, and at `beside`.
    over
        Excess reading of a gauge that reached over the crack's middle: the opening over the gauge's width.
    """

    found: Float
    sigma: Float
    true: Float
    read: Float
    beside: NDArray[np.bool_]
    at_points: StrainDifference
    all_read: StrainDifference
    beside_read: StrainDifference
    beside_points: StrainDifference
    over: float


def panel_strain(result: Field, strain: StrainField, comparison: MotionComparison, opening_mm: float) -> PanelStrain:
    """Compare a step's strain along the load with the truth."""
    truth = comparison.truth
    found, sigma = along(strain, LOAD_SYS)
    read, true = along(as_read(result, truth, strain), LOAD_SYS)[0], truth.stretch[..., 1]
    half_crack = CrackedPanel().half_crack_mm
    reach = 0.5 * strain.gauge_mm
    beside = strain.valid & (np.abs(truth.st_mm[..., 0]) < _BESIDE * half_crack) & (np.abs(truth.st_mm[..., 1]) < reach)
    use = strain.valid & np.isfinite(read)
    return PanelStrain(
        found,
        sigma,
        true,
        read,
        beside,
        difference(found, true, sigma, use),
        difference(found, read, sigma, use),
        difference(found, read, sigma, beside & use),
        difference(found, true, sigma, beside),
        MICRO * opening_mm / strain.gauge_mm,
    )


def add_checks(outcome: Outcome, found: Sequence[PanelStrain], strain: StrainField, loads_kn: Sequence[float]) -> None:
    """Add the strain's table, figures and limits to the experiment's outcome."""
    rows = [
        [
            f"{load:g}",
            f"{one.at_points.rms:.0f}",
            f"{one.all_read.rms:.0f}",
            f"{one.all_read.reported:.0f}",
            f"{one.all_read.chi:.2f}",
            f"{one.beside_points.rms:.0f}",
            f"{one.beside_read.rms:.0f}",
            f"{one.beside_read.chi:.2f}",
            f"{one.over:.0f}",
        ]
        for one, load in zip(found, loads_kn, strict=True)
    ]
    last, load = found[-1], loads_kn[-1]
    chi, beside = last.all_read.chi, last.beside_points.rms
    outcome.checks += [
        DemoCheck(
            f"strain along the load at {load:g} kN, its chi with the gauge's width known",
            "",
            chi,
            None,
            chi,
            chi_limit(strain),
        ),
        DemoCheck(
            f"strain beside the crack at {load:g} kN, rms off the truth at the points",
            "microstrain",
            beside,
            None,
            beside,
            SHARE_OVER * last.over,
        ),
    ]
    outcome.lines += [
        "",
        f"strain along the load, microstrain, gauge of {strain.gauge_mm:.1f} mm; off the truth at the points, and "
        "off what the gauge reads of it:",
        *table(
            [
                "kN",
                "rms off",
                "as read",
                "reported",
                "chi",
                "beside the crack",
                "as read",
                "chi",
                "over it it would be",
            ],
            rows,
        ),
    ]
    outcome.data["strain"] = {
        "gauge_mm": strain.gauge_mm,
        "rms_microstrain": [one.at_points.rms for one in found],
        "rms_as_read_microstrain": [one.all_read.rms for one in found],
        "reported_microstrain": [one.all_read.reported for one in found],
        "chi": [one.all_read.chi for one in found],
        "beside_crack_rms_microstrain": [one.beside_points.rms for one in found],
        "beside_crack_chi": [one.beside_read.chi for one in found],
        "over_the_crack_microstrain": [one.over for one in found],
    }
