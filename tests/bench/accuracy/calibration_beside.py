"""Free poses calibrated beside OpenCV's stereoCalibrate and mrcal, from the same corners of the same views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.calibration import CalibrationOptions, NominalValues, calibrate
from tests.bench.accuracy.table import Row, Section
from tests.support.calibration_rigs import (
    LENSES,
    checkerboard,
    hand_held,
    made,
    ordinary_pair,
    rms,
    seen_from,
    shape_error_um,
    stereo_calibrate,
    views_of_poses,
)
from tests.support.mrcal_witness import calibrate_by_mrcal, mrcal_is_there, shape_sigma_um

REPLICATES = 20
POSES = 16
NOISE_PX = 0.02
LENS = "p1 p2 of 3e-4"
NOT_ABOVE, HALF = 1.05, 0.5


@dataclass(frozen=True)
class Case:
    """One kind of lens and board."""

    name: str
    lens: str
    tolerance_mm: float
    bow_mm: float
    limit: float


CASES = (
    Case("pinhole, exact board", "pinhole", 0.0, 0.0, NOT_ABOVE),
    Case("k1 k2 p1 p2, exact board", LENS, 0.0, 0.0, NOT_ABOVE),
    Case("pinhole, board of 0.05 mm", "pinhole", 0.05, 0.0, NOT_ABOVE),
    Case("k1 k2 p1 p2, board of 0.05 mm bowed by 0.3 mm", LENS, 0.05, 0.3, HALF),
)


@dataclass(frozen=True)
class Compared:
    """Shape errors of one replicate, um: ours, what is reported, OpenCV's, mrcal's plain and with a bowed board."""

    ours: float
    at_own_points: float
    reported: float
    opencv: float
    mrcal: float
    mrcal_bowed: float
    sigma_over_mrcal: float
    model: str
    level: str


def compare(case: Case, seed: int, *, mrcal: bool = True) -> Compared:
    """Calibrate one set of views by all; errors over all points of all poses after a rigid motion."""
    rng = np.random.default_rng(seed)
    board = checkerboard(case.tolerance_mm)
    cameras = ordinary_pair(LENSES[case.lens])
    size = cameras[0].size_px
    points = made(board.points_mm(), rng, tolerance_mm=case.tolerance_mm, bow_mm=case.bow_mm)
    poses = hand_held(rng, cameras, points, POSES)
    views = views_of_poses(cameras, points, poses, rng, NOISE_PX)
    nominal = NominalValues(size, 1.1 * cameras[0].K[0, 0])
    ours = calibrate(views, board, (nominal, nominal), CalibrationOptions(moves="free"))
    opencv = stereo_calibrate(views, board.points_mm(), size)
    nan = float("nan")
    plain, bowed, ratio = nan, nan, nan
    everywhere = np.concatenate([p.of(points.reshape(-1, 3)) for p in poses])
    if mrcal:
        one = calibrate_by_mrcal(views, board.pitch_mm, [size] * 2, opencv, noise_px=ours.noise_px)
        two = calibrate_by_mrcal(views, board.pitch_mm, [size] * 2, opencv, noise_px=ours.noise_px, warp=True)
        plain, bowed = (shape_error_um(m.pair, cameras, everywhere) for m in (one, two))
        in_camera = ours.pair.cam1.cam_from_sys.apply(ours.uncertainty.points_mm)
        ratio = 1e3 * ours.uncertainty.shape_rms_mm / shape_sigma_um(one, in_camera)
    return Compared(
        shape_error_um(ours.pair, cameras, everywhere),
        shape_error_um(ours.pair, seen_from(poses[0], cameras), ours.uncertainty.points_mm),
        1e3 * ours.uncertainty.shape_rms_mm,
        shape_error_um(opencv.pair, cameras, everywhere),
        plain,
        bowed,
        ratio,
        ours.lens.model,
        ours.verdict.level,
    )


def beside(figures: Path) -> Section:
    """Shape errors beside OpenCV's and mrcal's."""
    mrcal = mrcal_is_there()
    rows: list[Row] = []
    fig, axes = plt.subplots(1, len(CASES), figsize=(13, 3.6), layout="constrained")
    for case, ax in zip(CASES, axes, strict=True):
        runs = [compare(case, seed, mrcal=mrcal) for seed in range(REPLICATES)]
        ours, opencv = [r.ours for r in runs], [r.opencv for r in runs]
        rows += [
            Row(f"{case.name}: shape error, rms of {REPLICATES}", rms(ours), "um"),
            Row(f"{case.name}: OpenCV's", rms(opencv), "um"),
            Row(f"{case.name}: over OpenCV's, rms", rms(ours) / rms(opencv), "1", case.limit),
            Row(f"{case.name}: over OpenCV's, median", float(np.median(ours) / np.median(opencv)), "1", case.limit),
        ]
        names, columns = ["here", "OpenCV"], [ours, opencv]
        if mrcal:
            for name, own in (("mrcal", [r.mrcal for r in runs]), ("mrcal, bowed", [r.mrcal_bowed for r in runs])):
                rows.append(Row(f"{case.name}: {name}", rms(own), "um"))
                names.append(name)
                columns.append(own)
        reported = rms([r.reported for r in runs]) / rms([r.at_own_points for r in runs])
        rows.append(Row(f"{case.name}: reported over true", reported, "1"))
        rows.append(Row(f"{case.name}: verdict good", 100.0 * np.mean([r.level == "good" for r in runs]), "%"))
        for k, own in enumerate(columns):
            ax.plot(np.full(len(own), k) + np.linspace(-0.2, 0.2, len(own)), own, ".", ms=4)
        ax.set(yscale="log", ylabel="shape error, um")
        ax.set_xticks(range(len(names)), names, fontsize=7)
        ax.set_title(case.name, fontsize=8)
    fig.savefig(figures / "accuracy_beside.png", dpi=100)
    plt.close(fig)
    notes = [
        "Error: of all corners in all poses, triangulated from the true cameras' exact images, rms a coordinate after the "
        "best rigid motion. Reported over true is at the points that the report uses (4 x 4 of every pose, the rim among "
        "them), rms over rms; one mode, the scale, makes most of a bad board's error, so that the rms of "
        f"{REPLICATES} is good to {100.0 / np.sqrt(2.0 * REPLICATES):.0f} %. mrcal ran without regularisation and without "
        "its rejection of outliers, flat and with its two terms of a bowed board."
    ]
    if not mrcal:
        notes.append("mrcal was not installed where this ran.")
    return Section(
        "Free poses beside OpenCV and mrcal",
        f"The same corners (noise {NOISE_PX} px) of {POSES} hand-held poses of 9 x 7 corners, 14 mm, 350 mm away, at "
        "25 degrees, 2448 x 2048 px.",
        rows,
        [("accuracy_beside.png", "Shape errors of the replicates")],
        notes,
    )
