"""W of the paper's clamped plate at the last load step of the tutorial, compared with the textbook's."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np

API = "/api/v1"
# the tutorial's plate is the paper's, in mm and N/mm^2; the last pressure in kPa
RADIUS, THICKNESS, MODULUS, POISSON, PRESSURE = 13.385, 0.762, 71.0e3, 0.334, 689.0


def check_plate_field(client: httpx.Client, w_mm: Any) -> None:
    """Assert that this is W of the newest analysis, and the textbook's: a clamped plate's deflection."""
    test_id = client.get(f"{API}/tests").json()["tests"][-1]["id"]
    test = client.get(f"{API}/tests/{test_id}").json()
    assert [step["label"] for step in test["steps"]] == ["0 kPa", "344.5 kPa", "689 kPa"]
    path = f"{API}/tests/{test_id}/analyses/{test['analyses'][-1]['id']}/steps/2/fields"
    x, y, w = (
        np.array(client.get(f"{path}/{name}").json()["values"], dtype=float) for name in ("x_mm", "y_mm", "w_mm")
    )
    np.testing.assert_allclose(w_mm, w.reshape(np.shape(w_mm)), rtol=1e-6)
    stiffness = MODULUS * THICKNESS**3 / (12 * (1 - POISSON**2))
    deflection = PRESSURE * 1e-3 * RADIUS**4 / (64 * stiffness)
    true = -deflection * np.clip(1 - (np.hypot(x, y) / RADIUS) ** 2, 0, None) ** 2
    assert np.isfinite(w).mean() > 0.99
    assert np.abs(w).max() > 0.1
    assert np.sqrt(np.nanmean((w - true) ** 2)) < 1e-3  # mm
