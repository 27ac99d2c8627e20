"""The uncertainty of K_I that a planned measurement of a centre-cracked panel would give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.factor import ParameterCovariance
from stereorig.core.errors import InputError
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.plan.modulus import PlannedCrack
from stereorig.core.plan.settings import PlannedMeasurement
from stereorig.core.plan.synthetic import PlannedField, Sizes, laid_about, planned_field
from stereorig.server.evaluations.centre_crack import Panel
from stereorig.server.evaluations.crack.drawn import DrawnCrack, drawn_crack
from stereorig.server.evaluations.crack.points import Points, points_about
from stereorig.server.evaluations.crack.series import fitted, terms_at
from stereorig.server.evaluations.crack.settings import CrackSettings, Elastic

_ORDER = 6
_ROOT_M = float(np.sqrt(1e3))  # sqrt(mm) of a sqrt(m)
_NEEDED = ("crack_half_mm", "panel_width_mm", "panel_thickness_mm", "panel_load_n", "youngs_modulus_mpa", "modulus_u")


def planned_k(
    pair: StereoPair, sizes: Sizes, source: ParameterCovariance, measured: PlannedMeasurement, crack: PlannedCrack
) -> dict[str, object]:
    """Return K_I of the panel, its standard uncertainty and that by cause, MPa m^0.5; None without all statements.

    Parameters
    ----------
    pair, sizes, source
        The cameras, their images' sizes, and the covariance of the cameras' parameters by cause.
    measured, crack
        The measurement and the panel; the tip is in the middle of the target's plane, the crack runs along -X from it.
        The cameras' errors are those after the largest of the measurement's translations, of the worst direction.

    Raises
    ------
    InputError
        ``crack_ring_invalid``, ``crack_outside``, ``panel_invalid``; ``too_few_points`` if the ring has too few points.
    """
    missing = [name for name in _NEEDED if getattr(crack, name) is None]
    if missing:
        return {"k1": None, "u": None, "parts": {}, "missing": missing}
    assert crack.crack_half_mm is not None
    assert crack.youngs_modulus_mpa is not None
    panel = Panel(crack.panel_width_mm or 0.0, crack.panel_thickness_mm or 0.0, 0.0)
    k = panel.k(crack.panel_load_n or 0.0, crack.crack_half_mm)
    elastic = Elastic(crack.youngs_modulus_mpa, crack.poisson)
    planned, drawn = _panel(pair, sizes, measured, crack, elastic, k)
    shared = SharedPixels(measured.subset_px)

    def points(of: PlannedField) -> Points:
        return points_about(of.field, shared, drawn, np.zeros(2)).few

    seen = points(planned)
    if len(seen.at) < 4 * (_ORDER + 2):
        raise InputError(
            f"The ring about the tip would have {len(seen.at)} points.",
            code="too_few_points",
            remedy="Plan a smaller spacing or a wider ring.",
        )
    fit = fitted(seen, elastic, _ORDER, np.zeros(2), drawn.inner_mm)
    gain = float(np.sqrt(2.0 * np.pi)) * elastic.two_g / _ROOT_M * fit.gains[2:3]
    parts = {"modulus": k * (crack.modulus_u or 0.0)}
    for cause, noise in (("reference", planned.reference), ("matching", planned.matching)):
        each = points(replace(planned, field=planned.of_noise(noise)))
        parts[cause] = float(np.sqrt(each.spread(gain).own[0, 0]))
    moved: list[dict[str, float]] = []
    for motion in max(measured.translations_mm) * np.eye(3):
        after = planned_field(pair, sizes, measured, _grid(pair, measured, crack), motion.tolist())
        of_cause: dict[str, float] = {}
        for name, field in after.of_causes(source).items():
            # the noise tells which points are used, and is no part of this
            with_noise = replace(planned.field, common=field.common)
            factor = points(replace(planned, field=with_noise)).spread(gain).common
            of_cause[str(name)] = 0.0 if factor is None else float(np.linalg.norm(factor))
        moved.append(of_cause)
    sizes_of = [float(np.linalg.norm(list(one.values()))) for one in moved]
    parts |= moved[int(np.argmax(sizes_of))]
    return {"k1": k, "u": float(np.linalg.norm(list(parts.values()))), "parts": parts, "missing": []}


def _panel(
    pair: StereoPair, sizes: Sizes, measured: PlannedMeasurement, crack: PlannedCrack, elastic: Elastic, k: float
) -> tuple[PlannedField, DrawnCrack]:
    """Return the field about the tip with the displacements of the series' first term, and the crack in it."""
    planned = planned_field(pair, sizes, measured, _grid(pair, measured, crack), (0.0, 0.0, 0.0))
    field = planned.field
    z = field.xyz_mm[..., 0] + 1j * field.xyz_mm[..., 1]
    terms = np.zeros(4)
    terms[2] = _ROOT_M * k / (float(np.sqrt(2.0 * np.pi)) * elastic.two_g)
    moved: Float = terms_at(z, 1, elastic.kappa) @ terms
    field = replace(field, uvw_mm=np.concatenate([moved, np.zeros((*field.shape, 1))], axis=-1))
    inner, outer = (None, crack.crack_half_mm) if crack.ring_mm is None else crack.ring_mm
    asked = CrackSettings.model_validate(
        {"crack_px": _line(pair, crack).tolist(), "inner_mm": inner, "outer_mm": outer}
    )
    return replace(planned, field=field), drawn_crack(field, SharedPixels(measured.subset_px), asked)


def _line(pair: StereoPair, crack: PlannedCrack) -> Float:
    """Return (2, 2) both ends of the crack in camera 1's image, the tip last."""
    return pair.cam1.project(np.array([[-2.0 * (crack.crack_half_mm or 0.0), 0.0, 0.0], [0.0, 0.0, 0.0]])).xy


def _grid(pair: StereoPair, measured: PlannedMeasurement, crack: PlannedCrack) -> tuple[Float, Float, Bool]:
    """Return the points about the tip, a little beyond the ring."""
    half_mm = crack.crack_half_mm or 1.0
    outer_mm = half_mm if crack.ring_mm is None else crack.ring_mm[1]
    line = _line(pair, crack)
    px_per_mm = float(np.linalg.norm(line[1] - line[0])) / (2.0 * half_mm)
    reach = int(np.ceil(1.1 * px_per_mm * outer_mm / measured.spacing_px)) + 1
    return laid_about([np.round(line[1])], measured.spacing_px, reach)
