"""The clamped plate's radial and hoop strain against bending theory.

The face moves in the plane by half the thickness times the slope. A gauge takes a fit over its width for the slope in
its middle. On the plate, whose face moves by ``k (1 - r^2 / a^2)`` times the radius, a whole window's fit is off by the
same amount everywhere, ``k (M4 / M2 + M2) / a^2``, M2 and M4 the mean square and fourth power of its points' positions.
"""

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
from stereorig.server.demo.strain import MICRO, StrainDifference, along, as_read, chi_limit, difference, whole_gauges
from stereorig.sim.plate import CircularPlate


@dataclass(frozen=True, eq=False)
class PlateStrain:
    """One pressure: strain in radial and hoop direction at (r, c) points, and its error.

    Attributes
    ----------
    r_mm
        Distance from the fitted centre.
    found, sigma, theory, read
        (2, r, c) radial and hoop: measured, its standard deviation, theory at the point, theory as the gauge reads it.
    whole
        (r, c) points whose window no edge cuts.
    off_theory, off_read
        Radial and hoop over whole windows, against theory and against the gauge's reading of it.
    all_off_theory
        Radial and hoop over all points.
    """

    r_mm: Float
    found: Float
    sigma: Float
    theory: Float
    read: Float
    whole: NDArray[np.bool_]
    off_theory: tuple[StrainDifference, StrainDifference]
    off_read: tuple[StrainDifference, StrainDifference]
    all_off_theory: tuple[StrainDifference, StrainDifference]


def plate_strain(
    result: Field,
    strain: StrainField,
    comparison: MotionComparison,
    pressure_kpa: float,
    plate: CircularPlate,
    centre_mm: tuple[float, float],
) -> PlateStrain:
    """Turn a step's strain to the plate's radius and compare it with theory."""
    arm = result.xyz_mm[..., :2] - np.array(centre_mm)
    r = np.linalg.norm(arm, axis=-1)
    round_ = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)
    true = as_read(result, comparison.truth, strain)
    found, sigma = (np.stack(v) for v in zip(along(strain, arm), along(strain, round_), strict=True))
    read = np.stack([along(true, arm)[0], along(true, round_)[0]])
    theory = np.stack(plate.face_strain(r, pressure_kpa))
    whole = whole_gauges(strain)

    def off(other: Float, use: NDArray[np.bool_]) -> tuple[StrainDifference, StrainDifference]:
        radial, hoop = (difference(found[k], other[k], sigma[k], use) for k in range(2))
        return radial, hoop

    return PlateStrain(
        r, found, sigma, theory, read, whole, off(theory, whole), off(read, strain.valid), off(theory, strain.valid)
    )


def gauge_effect(strain: StrainField, pressure_kpa: float, plate: CircularPlate) -> float:
    """Return by how much the gauge's width lowers the plate's bending strain."""
    half = strain.options.window // 2
    position = np.arange(-half, half + 1) * strain.gauge_mm * strain.spacing_px / strain.gauge_px
    m2, m4 = np.mean(position**2), np.mean(position**4)
    at_centre = float(plate.bending_strain(0.0, pressure_kpa)[0])
    return float(at_centre * (m4 / m2 + m2) / plate.radius_mm**2)


def add_checks(
    outcome: Outcome,
    found: Sequence[PlateStrain],
    strains: Sequence[StrainField],
    pressures_kpa: Sequence[float],
    plate: CircularPlate,
    at_centre: Sequence[tuple[float, float]],
) -> None:
    """Add the strain's table, figures and limits to the experiment's outcome.

    Parameters
    ----------
    outcome
        To add to.
    found, strains, pressures_kpa
        A step each.
    plate
        The theory.
    at_centre
        Mean of both normal strains in the plate's centre and its standard deviation, as a point gauge has read it.
    """
    rows = []
    for one, strain, q, (centre, sigma) in zip(found, strains, pressures_kpa, at_centre, strict=True):
        (radial, hoop), (radial_read, hoop_read) = one.off_theory, one.off_read
        rows.append(
            [
                f"{q:.1f}",
                f"{MICRO * centre:.0f} +- {MICRO * sigma:.0f}",
                f"{MICRO * plate.face_strain(0.0, q)[0]:.0f}",
                f"{radial.rms:.0f}",
                f"{hoop.rms:.0f}",
                f"{MICRO * gauge_effect(strain, q, plate):.0f}",
                f"{radial.reported:.0f}",
                f"{radial_read.chi:.2f}",
                f"{hoop_read.chi:.2f}",
            ]
        )
    strain, q = strains[-1], pressures_kpa[-1]
    effect, chance = MICRO * gauge_effect(strain, q, plate), chi_limit(strain)
    for k, name in enumerate(("radial", "hoop")):
        off, read = found[-1].off_theory[k], found[-1].off_read[k]
        limit = float(np.hypot(chance * off.reported, effect))
        outcome.checks += [
            DemoCheck(
                f"{name} strain at {q:g} kPa, rms off plate theory", "microstrain", off.rms, None, off.rms, limit
            ),
            DemoCheck(
                f"{name} strain at {q:g} kPa, its chi with the gauge's width known",
                "",
                read.chi,
                None,
                read.chi,
                chance,
            ),
        ]
    (centre, sigma), true = at_centre[-1], float(plate.face_strain(0.0, q)[0])
    outcome.checks.append(
        DemoCheck(
            f"strain in the centre at {q:g} kPa",
            "microstrain",
            MICRO * centre,
            MICRO * true,
            MICRO * (centre - true),
            3.0 * MICRO * sigma + effect,
        )
    )
    outcome.lines += [
        "",
        *table(
            [
                "kPa",
                "strain in the centre",
                "theory",
                "rms off: radial",
                "hoop",
                "gauge's width",
                "noise reported",
                "chi radial",
                "hoop",
            ],
            rows,
        ),
        "",
        f"microstrain; gauge of {strain.gauge_mm:.2f} mm; rms over points with a whole window; chi: with the gauge's "
        "width known, 1 where noise explains the rest",
    ]
    outcome.data["strain"] = {
        "gauge_mm": strain.gauge_mm,
        "gauge_effect_microstrain": effect,
        "centre_microstrain": [MICRO * v for v, _ in at_centre],
        "centre_sigma_microstrain": [MICRO * s for _, s in at_centre],
        "rms_microstrain": [[d.rms for d in one.off_theory] for one in found],
        "rms_all_points_microstrain": [[d.rms for d in one.all_off_theory] for one in found],
        "reported_microstrain": [[d.reported for d in one.off_theory] for one in found],
        "chi": [[d.chi for d in one.off_read] for one in found],
    }
