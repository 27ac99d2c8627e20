"""A strip with a material law in a load frame, at the level of gauge readings: true curve, and drawn readings of it.

The laws are formulas; the readings have a common and an independent error of strain, and a load cell with gain, offset
and noise. Nothing here uses the code that is tested.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import brentq

from stereorig.core.arrays import Float
from stereorig.server.evaluations.tensile.curve import Curve, with_load_errors

SCALE_U, OFFSET_U, SECTION_U, NOISE = 0.002, 0.3, 0.004, 0.2
STRAIN_U, COMMON_U, REFERENCE_U = 1.0e-5, 0.002, 1.5e-5


@dataclass(frozen=True)
class Law:
    """A material: stress over engineering strain, lateral strain, and its true numbers."""

    name: str
    strain: Float
    lateral: Float
    stress: Float
    truth: dict[str, float]
    time_s: Float = field(default_factory=lambda: np.zeros(0))


def _steps(end: float, elastic: float = 0.004, fine: int = 80, coarse: int = 40) -> Float:
    """Strains of the steps: the elastic part and the knee more finely than the rest, three at rest at first."""
    rest = np.zeros(3)
    first = np.linspace(0.0, min(elastic, end), fine + 1)[1:]
    return np.concatenate([rest, first, np.linspace(first[-1], end, coarse + 1)[1:] if end > elastic else []])


def linear(e: float = 70_000.0, nu: float = 0.33) -> Law:
    strain = _steps(0.004)
    return Law("linear", strain, -nu * strain, e * strain, {"modulus": e, "poisson": nu})


def ramberg_osgood(e: float = 200_000.0, nu: float = 0.29, proof: float = 350.0, exponent: float = 14.0) -> Law:
    """strain = s / E + 0.002 (s / proof)^exponent: the proof stress at 0.2 % is the parameter itself."""
    strain = _steps(0.03)

    def excess(s: float, at: float) -> float:
        return s / e + 0.002 * (s / proof) ** exponent - at

    stress = np.array([brentq(excess, 0.0, 3.0 * proof, args=(at,)) for at in strain])
    plastic = strain - stress / e
    truth = {"modulus": e, "poisson": nu, "proof": proof}
    return Law("ramberg_osgood", strain, -nu * stress / e - 0.5 * plastic, stress, truth)


def voce(e: float = 70_000.0, nu: float = 0.33, start: float = 120.0, rise: float = 130.0, rate: float = 25.0) -> Law:
    """Linear up to ``start``, then s = start + rise (1 - exp(-rate p)): the proof stress is that at p = 0.002."""
    strain = _steps(0.06)

    def excess(p: float, at: float) -> float:
        return p + (start + rise * (1.0 - np.exp(-rate * p))) / e - at

    plastic = np.array([brentq(excess, 0.0, 1.0, args=(at,)) if at > start / e else 0.0 for at in strain])
    stress = np.where(strain > start / e, start + rise * (1.0 - np.exp(-rate * plastic)), e * strain)
    truth = {"modulus": e, "poisson": nu, "proof": start + rise * (1.0 - np.exp(-rate * 0.002))}
    return Law("voce", strain, -nu * stress / e - 0.5 * plastic, stress, truth)


def orthotropic(
    e: float = 200_000.0, nu: float = 0.3, k: float = 550.0, n: float = 0.2, r: float = 1.6, offset: float = 0.002
) -> Law:
    """Sheet in true quantities: s = K (p + offset)^n; width against thickness strains as 1 to 1 / r."""
    strain = _steps(0.28, elastic=0.005, fine=120, coarse=60)
    along = np.log1p(strain)

    def excess(p: float, at: float) -> float:
        return p + k * (p + offset) ** n / e - at

    def of_neck(p: float) -> float:
        # Considere: the load is largest where the true stress rises by itself
        true = k * (p + offset) ** n
        rise = n * true / (p + offset)
        return rise / (1.0 + rise / e) - true

    start = k * offset**n / e
    plastic = np.array([brentq(excess, 0.0, 1.0, args=(at,)) if at > start else 0.0 for at in along])
    true = np.where(along > start, k * (plastic + offset) ** n, e * along)
    width = -nu * true / e - r / (1.0 + r) * plastic
    neck = brentq(of_neck, 0.01, 1.0)
    at_neck = float(np.expm1(neck + k * (neck + offset) ** n / e))
    strength = k * (neck + offset) ** n / (1.0 + at_neck)
    grid = np.log1p(np.linspace(0.10, 0.15, 1000))
    exponent = float(np.polynomial.polynomial.polyfit(np.log(grid), n * np.log(grid + offset), 1)[1])
    truth = {"r": r, "n": exponent, "strength": strength, "uniform": at_neck - strength / e}
    return Law("orthotropic", strain, np.expm1(width), true / (1.0 + strain), truth)


LAWS = {law.name: law for law in (linear(), ramberg_osgood(), voce(), orthotropic())}


def drawn(law: Law, rng: np.random.Generator, **change: float) -> Curve:
    """Readings of a test: every error drawn from what the curve states of it."""
    n = len(law.strain)
    gain, section = 1.0 + SCALE_U * rng.normal(), 1.0 + SECTION_U * rng.normal()
    common, reference, reference_lateral = rng.normal(size=3)
    strain, lateral = law.strain * (1.0 + COMMON_U * common), law.lateral * (1.0 + COMMON_U * common)
    moved = np.arange(n) > 0
    strain = strain + moved * (REFERENCE_U * reference + STRAIN_U * rng.normal(size=n))
    lateral = lateral + moved * (REFERENCE_U * reference_lateral + STRAIN_U * rng.normal(size=n))
    stress = law.stress * gain / section + OFFSET_U * rng.normal() + NOISE * rng.normal(size=n)
    return stated(strain, lateral, stress, np.arange(n, dtype=float), **change)


def stated(strain: Float, lateral: Float, stress: Float, time_s: Float, **change: float) -> Curve:
    """The curve of readings, with the uncertainties that they were drawn with."""
    n, moved = len(strain), np.arange(len(strain)) > 0
    values = np.stack([strain, lateral, stress])
    own = np.stack([STRAIN_U * moved, STRAIN_U * moved, np.full(n, NOISE)])
    calibration, reference = np.zeros((1, 3, n)), np.zeros((2, 3, n))
    calibration[0, :2] = COMMON_U * values[:2]
    reference[0, 0], reference[1, 1] = REFERENCE_U * moved, REFERENCE_U * moved
    curve = Curve(values, own, {"calibration": calibration, "reference": reference}, np.arange(n), time_s)
    errors = {"scale_u": SCALE_U, "offset_u_mpa": OFFSET_U, "section_u": SECTION_U, "late_s": 0.0, "late_u_s": 0.0}
    return with_load_errors(curve, **{**errors, **change})


def late(curve: Curve, by_s: float) -> Curve:
    """The load is written down so much later than the images."""
    assert curve.time_s is not None
    values = curve.values.copy()
    values[2] = np.interp(curve.time_s - by_s, curve.time_s, values[2])
    return replace(curve, values=values)


def slipped(curve: Curve, law: Law, at: int, share: float = 0.25) -> Curve:
    """At a step the grips let a share of the load go, along the elastic line; then the machine pulls on."""
    fall = share * law.stress[at]
    e = law.truth.get("modulus", 200_000.0)
    nu = law.truth.get("poisson", 0.3)
    steps = np.insert(curve.values, at + 1, curve.values[:, at] - fall * np.array([1.0 / e, -nu / e, 1.0]), axis=1)
    return stated(*steps, np.arange(steps.shape[1], dtype=float))


def with_cross_talk(curve: Curve, rng: np.random.Generator, size_mpa: float) -> Curve:
    """A pump's pressure, which is recorded, is in the load."""
    pump = 100.0 + 5.0 * rng.normal(size=curve.values.shape[1])
    values = curve.values.copy()
    values[2] += size_mpa * (pump - 100.0) / 5.0
    return replace(curve, values=values, others={"pump_bar": pump, "room_c": 20.0 + 0.01 * rng.normal(size=len(pump))})


def broken(curve: Curve, steps: int = 4) -> Curve:
    """After the last step the specimen breaks; the load cell goes back to its zero."""
    values = np.concatenate([curve.values, np.full((3, steps), np.nan)], axis=1)
    values[2, -steps:] = values[2, :3].mean() * np.ones(steps)
    return stated(*values, np.arange(values.shape[1], dtype=float))
