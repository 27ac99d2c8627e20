"""One replicate drawn: the target as it was made, the stage's errors, the rig, the specimen and its motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tests.bench.coverage.render import Array, Sheet, discs, soft_texture
from tests.bench.coverage.strata import STRATA, Stratum
from tests.bench.coverage.targets import Made
from tests.support.relief_rig import ReliefCamera

SIZE = (224, 224)
FOCAL_PX = 3000.0
STANDOFF_MM = 200.0
GAMMA_DEG = 15.0
LINES, PITCH_MM, WIDTH_MM = (7, 7), 1.55, 0.14
CORNERS, SQUARE_MM = (7, 6), 1.4
POSITIONS_MM = (0.0, 5.0, 10.0)
POSES = 9
KNOT_MM = {"soft": 0.18, "discs": 0.4}


@dataclass(frozen=True)
class View:
    """One camera's picture of the target: its file's name, and the camera's place before the target's plane."""

    file: str
    camera: ReliefCamera


@dataclass(frozen=True)
class Replicate:
    """One drawn rig with its target and specimen."""

    stratum: Stratum
    cameras: tuple[ReliefCamera, ReliefCamera]
    made: Made
    views: tuple[View, ...]
    sheet: Sheet
    motions: tuple[tuple[str, Array, Array], ...]
    rng: np.random.Generator


def drawn(stratum: Stratum, seed: int, *, only: Sequence[str] = ()) -> Replicate:
    """Draw a replicate; all of it follows from stratum and seed. With ``only`` it has no more than these motions."""
    names = [s.name for s in STRATA]
    rng = np.random.default_rng([2020, names.index(stratum.name) if stratum.name in names else 999, seed])
    cameras = _camera(rng, -1.0, stratum), _camera(rng, 1.0, stratum)
    made, views = _board(rng, stratum, cameras) if stratum.free else _grid(rng, stratum, cameras)
    texture = discs(rng) if stratum.discs else soft_texture(rng)
    knot = KNOT_MM["discs" if stratum.discs else "soft"] * rng.uniform(0.95, 1.05)
    slope = rng.uniform(-0.1, 0.1, 2)
    sheet = Sheet((float(slope[0]), float(slope[1])), stratum.curvature_per_mm, texture, knot)
    motions = tuple(motion for motion in _motions(rng) if not only or motion[0] in only)
    return Replicate(stratum, cameras, made, views, sheet, motions, rng)


def _turn(alpha: float, beta: float, gamma: float) -> Array:
    """Eq. (1) of the method's page: R = Rx(beta) Ry(gamma) Rz(alpha)."""
    return np.asarray(Rotation.from_euler("XYZ", [beta, gamma, alpha]).as_matrix())


def _camera(rng: np.random.Generator, sign: float, stratum: Stratum) -> ReliefCamera:
    alpha = (0.0 if stratum.free else 45.0) + rng.uniform(-1.0, 1.0)
    R = _turn(*np.radians([alpha, rng.uniform(-0.3, 0.3), sign * GAMMA_DEG + rng.uniform(-0.5, 0.5)]))
    t = np.array([*rng.uniform(-0.05, 0.05, 2), stratum.reach * STANDOFF_MM + rng.uniform(-0.5, 0.5)])
    centre = 0.5 * (np.array(SIZE) - 1.0) + rng.uniform(-2.0, 2.0, 2)
    focal = stratum.reach * FOCAL_PX * (1.0 + 0.01 * rng.uniform(-1.0, 1.0))
    t[:2] -= (centre - 0.5 * (np.array(SIZE) - 1.0)) / focal * t[2]
    return ReliefCamera(SIZE, focal, (float(centre[0]), float(centre[1])), R, t, stratum.lens)


def _nodes(shape: tuple[int, int], pitch: float, rng: np.random.Generator, stratum: Stratum) -> Array:
    x, y = ((np.arange(n) - 0.5 * (n - 1)) * pitch for n in shape)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    nodes *= 1.0 + stratum.pitch * rng.standard_normal()
    return np.asarray(nodes + rng.uniform(-1.0, 1.0, nodes.shape) * stratum.tolerance_mm)


def _grid(
    rng: np.random.Generator, stratum: Stratum, cameras: tuple[ReliefCamera, ReliefCamera]
) -> tuple[Made, tuple[View, ...]]:
    views = []
    for c, camera in enumerate(cameras):
        tilt = stratum.tilt_rad * rng.standard_normal(2)
        along = np.array([*tilt, np.sqrt(1.0 - tilt @ tilt)])
        scale = stratum.stage_off + stratum.scale * rng.standard_normal()
        for dz in (stratum.travel * p for p in POSITIONS_MM):
            # positions are read against the first one, which defines the system's frame
            travel = dz * (1.0 + scale) + stratum.step_mm * rng.standard_normal()
            views.append(View(f"cam{c + 1}_{dz:+.3f}mm.tif", replace(camera, t=camera.t + travel * along)))
    return Made(_nodes(LINES, PITCH_MM, rng, stratum), PITCH_MM, WIDTH_MM), tuple(views)


def _board(
    rng: np.random.Generator, stratum: Stratum, cameras: tuple[ReliefCamera, ReliefCamera]
) -> tuple[Made, tuple[View, ...]]:
    made = Made(_nodes(CORNERS, SQUARE_MM, rng, stratum), SQUARE_MM)
    views = []
    for k in range(POSES):
        way = rng.uniform(0.0, 2.0 * np.pi)
        tilt = np.radians(rng.uniform(8.0, 25.0))
        R = Rotation.from_rotvec(tilt * np.array([np.cos(way), np.sin(way), 0.0])).as_matrix()
        t = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-3.0, 3.0)])
        for c, camera in enumerate(cameras):
            views.append(View(f"cam{c + 1}_{k:03d}.tif", replace(camera, R=camera.R @ R, t=camera.R @ t + camera.t)))
    return made, tuple(views)


def _motions(rng: np.random.Generator) -> tuple[tuple[str, Array, Array], ...]:
    """Name, A and b of each step: x' = A x + b."""
    eye, sign = np.eye(3), rng.choice([-1.0, 1.0], 16)

    def strained(e: float) -> Array:
        a = rng.uniform(0.0, np.pi)
        axes = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(axes @ np.diag([1.0 + e, 1.0 - 0.3 * e, 1.0]) @ axes.T)

    turned = Rotation.from_rotvec(np.radians([3.0, 2.0, 5.0]) * sign[:3]).as_matrix()
    none = np.zeros(3)
    return (
        ("0.05 to 0.5 mm", eye, 0.05 * 10.0 ** rng.uniform(0.0, 1.0, 3) * sign[3:6]),
        ("u of 2 mm", eye, np.array([2.0 * sign[9], 0.0, 0.0])),
        ("v of 2 mm", eye, np.array([0.0, 2.0 * sign[10], 0.0])),
        ("w of 2 mm", eye, np.array([0.0, 0.0, 2.0 * sign[11]])),
        ("strain of 0.1 %", strained(1e-3 * sign[12]), none),
        ("strain of 5 %", strained(5e-2 * sign[13]), none),
        ("rotation of 3, 2, 5 degrees", turned, none),
    )
