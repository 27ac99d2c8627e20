"""Results of a known surface and motion, written as a measurement writes them: a cylinder with a crack and holes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.strain import surface_strain
from stereorig.core.strain.options import StrainOptions
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.gauge_field import SUBSET, make_field

ROWS, COLS = 24, 31  # x 40 to 250 px, y 60 to 221 px, 7 px apart
RADIUS_MM, MM_PER_PX = 20.0, 0.02
CRACK_X_PX = 148.3
HOLE = [(85.0, 108.0), (111.0, 108.0), (111.0, 137.0), (85.0, 137.0), (85.0, 108.0)]
PIN_HOLE = [(202.0, 83.0), (203.0, 83.0), (203.0, 84.0), (202.0, 83.0)]  # inside one triangle
FAILED = [(3, 25), (3, 26), (17, 4), (23, 30), (12, 22), (13, 21)]
CALIBRATION = "c0" * 32
SETTINGS = {"subset_px": SUBSET, "spacing_px": 7, "patch": "affine", "interpolation": "quintic", "note": "a -- b # c"}


def cylinder(x_px: Float, y_px: Float) -> Float:
    """A cylinder about the Y axis that bulges towards the cameras; the arc is as long as the image shows it."""
    angle = MM_PER_PX * (x_px - 145.0) / RADIUS_MM
    return np.stack([RADIUS_MM * np.sin(angle), MM_PER_PX * (y_px - 140.0), RADIUS_MM * (1 - np.cos(angle))], axis=-1)


def cylinder_normal(x_mm: Float) -> Float:
    """Of the same, away from the cameras."""
    s = x_mm / RADIUS_MM
    return np.stack([-s, np.zeros_like(s), np.sqrt(1 - s**2)], axis=-1)


def moved(factor: float):  # type: ignore[no-untyped-def]
    """A stretch and a lift."""
    return lambda p: p * np.array([1.0 + 1e-3 * factor, 1.0, 1.0]) + np.array([0.0, 0.0, -0.05 * factor])


def cuts() -> Cuts:
    return Cuts([[(CRACK_X_PX, 0.0), (CRACK_X_PX, 130.0)], HOLE, PIN_HOLE])


def failed() -> NDArray[np.bool_]:
    x, y = np.meshgrid(40.0 + 7 * np.arange(COLS), 60.0 + 7 * np.arange(ROWS))
    gone = (x > 85.0) & (x < 111.0) & (y > 108.0) & (y < 137.0)
    for index in FAILED:
        gone[index] = True
    return gone


def write_results(folder: Path, steps: int = 3, **more: str) -> list[Path]:
    """Write a shape and displacements that grow with the step; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for n in range(steps):
        field = make_field(
            moved(float(n)) if n else None, rows=ROWS, cols=COLS, shape=cylinder, failed=failed(), cuts=cuts()
        )
        normal = cylinder_normal(field.xyz_mm[..., 0])
        field = type(field)(**{**field.__dict__, "normal_sys": normal})
        strain = surface_strain(field, StrainOptions(), subset_px=SUBSET) if n else None
        extra = {"label": f"Stufe {n} µ", **more} | ({"load_n": repr(125.5 * n)} if n else {})
        provenance = Provenance(
            settings=SETTINGS,
            inputs={"calibration": CALIBRATION, "cam1": "ab" * 32},
            software_version="9.8.7",
            step=n,
            extra=extra,
        )
        paths.append(folder / f"step_{n:04d}.nc")
        write_field(paths[-1], field, provenance, strain)
    return paths
