"""Line grids from pictures of a renderer apart: is the claimed covariance what repeated pictures scatter?

Of the offsets along the lines, under blurs and noises that the profile does not know, and of the parameters.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereorig.core.calibration import COVARIANCE_NAMES, CalibrationOptions, CalibrationView, NominalValues, calibrate
from stereorig.core.grid import GridOptions, GridView, detect_grid
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget
from tests.bench.accuracy.table import Row, Section
from tests.support import line_noise
from tests.support.calibration_rigs import Array
from tests.support.independent_rig import LineGrid, PlainCamera, exposed, picture

REPLICATES = 60
REPEATS = 40  # of the localiser alone
NOISE = 2.0
POSITIONS = (0.0, 5.0)
RENDERED = 8  # samples of a pixel each way
TARGET = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.1)
PAIR = tuple(
    PlainCamera((512, 480), phd, cx, cy, kappa, 0.9617, np.radians(alpha), beta, np.radians(gamma), x0, y0, z0)
    for phd, cx, cy, kappa, alpha, beta, gamma, x0, y0, z0 in (
        (12000.0, 262.0, 233.0, 2.5e-9, 44.0, 0.01, -29.0, 0.3, -0.2, 398.0),
        (12100.0, 250.0, 246.0, 2.0e-9, 46.0, -0.012, 31.0, -0.25, 0.15, 403.0),
    )
)
NOMINALS = (
    NominalValues((512, 480), 12000.0, 400.0, -30.0, 0.9617),
    NominalValues((512, 480), 12000.0, 400.0, 30.0, 0.9617),
)
# the pictures' stage, aspect ratio and axes are exact
OPTIONS = CalibrationOptions(lens="paper", axis_tilt_sigma_rad=0.0, stage_scale_sigma=0.0, aspect_sigma=0.0)


def clean_pictures() -> dict[tuple[str, float], Array]:
    """Grey levels without noise of every view."""
    grid = LineGrid(TARGET.pitch_mm, TARGET.lines, TARGET.line_width_mm)
    return {
        (name, dz): picture(camera, grid, dz=dz, n=RENDERED)
        for name, camera in zip(CAMERAS, PAIR, strict=True)
        for dz in POSITIONS
    }


def detections(replicates: int) -> list[list[tuple[str, float, GridView]]]:
    """Camera, dZ and grid of every view, of each replicate."""
    clean = clean_pictures()
    out = []
    for seed in range(replicates):
        rng = np.random.default_rng([3, seed])
        out.append(
            [
                (name, dz, detect_grid(exposed(grey, NOISE, rng), TARGET, options=GridOptions(line_model="local")))
                for (name, dz), grey in clean.items()
            ]
        )
    return out


def normalised_squares(detected: list[list[tuple[str, float, GridView]]], *, joint: bool = True) -> list[float]:
    """Squared error of the twenty parameters over their covariance, a parameter, of each replicate's pictures.

    ``joint``: with the covariance along the lines; without it each intersection's own is taken for independent.
    """
    truth = np.array(
        [v for c in PAIR for v in (c.phd, c.cx, c.cy, c.kappa, c.alpha, c.beta, c.gamma, c.x0, c.y0, c.z0)]
    )
    out = []
    for replicate in detected:
        views = [
            CalibrationView(
                name,  # type: ignore[arg-type]
                dz,
                found.xy_px,
                sigma_px=np.sqrt(0.5 * np.trace(found.covariance_px2, axis1=-2, axis2=-1)),
                offsets=found.line_offsets if joint else None,
            )
            for name, dz, found in replicate
        ]
        result = calibrate(views, TARGET, NOMINALS, OPTIONS)
        assert result.names == COVARIANCE_NAMES
        values = result.pair.values()
        off = np.array([values[n] for n in result.names]) - truth
        s = np.sqrt(np.diagonal(result.covariance))
        factor = np.linalg.cholesky(result.covariance / s[:, None] / s)
        out.append(float(np.mean(np.linalg.solve(factor, off / s) ** 2)))
    return out


def line_grid(figures: Path) -> Section:
    """Normalised squared error of the parameters."""
    del figures
    detected = detections(REPLICATES)
    joint, apart = normalised_squares(detected), normalised_squares(detected, joint=False)
    scatter = float(np.sqrt(2.0 / (20.0 * REPLICATES)))
    return Section(
        "Covariance from line grids",
        f"Pictures of the paper's rig by a renderer apart ({RENDERED} x {RENDERED} rays a pixel), noise {NOISE:g} of 255, "
        f"`local` lines, dZ 0 and 5 mm, {REPLICATES} replicates: squared error of the twenty parameters over their "
        "covariance, a parameter (1 is right). Below, the localiser alone: squared offsets of the intersections about their "
        f"means over {REPEATS} pictures, over their covariance along the lines, in each family of lines.",
        [
            Row("with the covariance along the lines", float(np.mean(joint)), "1"),
            Row("its own standard deviation over so many replicates", scatter, "1"),
            Row("intersections taken for independent", float(np.mean(apart)), "1"),
            *_localiser_rows(),
        ],
        [],
        [],
    )


def _localiser_rows() -> list[Row]:
    rows = []
    for blur, grey in line_noise.clean_pictures().items():
        for noise, photons in ((1.0, False), (2.0, False), (4.0, False), (2.0, True)):
            ratios = line_noise.scatter_over_claim(grey, noise, REPEATS, photons=photons)
            kind = "photons' noise of mean" if photons else "noise"
            rows += [
                Row(f"offsets' scatter over claim, {blur}, {kind} {noise:g}, family {family}", ratio, "1")
                for family, ratio in zip("ab", ratios, strict=True)
            ]
    return rows
