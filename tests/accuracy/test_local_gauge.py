"""True stress and strain past necking, by a local gauge in the neck."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.core.arrays import Float
from stereorig.core.progress import no_progress
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.evaluations.door import evaluate
from stereorig.server.evaluations.tensile.document import MaterialCardFound
from stereorig.server.evaluations.tensile.evaluation import MaterialCard
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.gauge_field import SUBSET, make_field

#: of the strip outside the neck and in it, step by step; the load falls once it necks
OUTSIDE = np.array([0.001, 0.002, 0.004, 0.05, 0.10, 0.10, 0.10, 0.10])
NECK = np.array([0.001, 0.002, 0.004, 0.05, 0.10, 0.18, 0.28, 0.40])
LOAD_N = np.array([70.0, 140.0, 250.0, 320.0, 340.0, 335.0, 320.0, 300.0]) * 25.0
MIDDLE, HALF = 0.0, 0.6  # mm


def flat(x_px: Float, y_px: Float) -> Float:
    return np.stack([0.02 * (x_px - 140.0), 0.02 * (y_px - 140.0), np.zeros_like(x_px)], axis=-1)


def pulled(outside: float, neck: float, at: Float) -> Float:
    """Positions of a strip along y whose middle 1.2 mm are stretched by another strain; width at constant volume."""
    y = at[..., 1]
    inner = np.clip(y, MIDDLE - HALF, MIDDLE + HALF)
    return np.stack([at[..., 0], y + outside * (y - inner) + neck * inner, at[..., 2]], axis=-1)


def test_true_strain_past_the_largest_load_is_that_of_the_neck(tmp_path: Path) -> None:
    files = []
    for n, (outside, neck, load) in enumerate(zip(OUTSIDE, NECK, LOAD_N, strict=True), 1):
        field = make_field(lambda at, o=outside, k=neck: pulled(o, k, at), rows=24, cols=9, shape=flat, growing=False)
        files.append(tmp_path / f"step_{n:04d}.nc")
        strain = surface_strain(field, StrainOptions(window=3), subset_px=SUBSET)
        about = Provenance({"subset_px": SUBSET}, {}, "1", step=n, extra={"load_n": f"{load}"})
        write_field(files[-1], field, about, strain)
    made: Any = MaterialCard()
    stated = {"width_mm": 12.5, "thickness_mm": 2.0, "section_u": 0.003, "load_scale_u": 0.003, "load_u_n": 2.0}
    # two points of the neck, whose windows are within it
    local = {"local_px": [45.0, 125.0, 95.0, 155.0], "lateral": False}
    card = evaluate(made, files, stated | local, no_progress).document
    assert isinstance(card, MaterialCardFound)
    curve = card.curve
    np.testing.assert_allclose(np.array(curve.true_strain, float), np.log1p(NECK), rtol=1e-3)
    np.testing.assert_allclose(np.array(curve.true_stress_mpa, float), LOAD_N / 25.0 * (1.0 + NECK), rtol=1e-3)
    assert all(u is not None and u > 0.0 for u in curve.true_strain_u)
    # the whole area is stretched less
    whole = curve.strain[-1]
    assert whole is not None
    assert OUTSIDE[-1] < whole < NECK[-1]
    plain = evaluate(made, files, stated | {"lateral": False}, no_progress).document
    assert isinstance(plain, MaterialCardFound)
    assert plain.curve.true_strain[-1] == pytest.approx(np.log1p(whole))
