"""Random stereo rigs before random targets, right or with one fault, and what their calibration may answer.

Truth is OpenCV's projection; dots are the centroids of their projected discs. Everything follows from a seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.boards import BoardTarget
from stereorig.core.calibration import CalibrationOptions, CalibrationResult, CalibrationView, NominalValues, calibrate
from stereorig.core.calibration.inputs import AnyTarget, nodes_of
from stereorig.core.errors import StereorigError
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget
from tests.support.calibration_rigs import (
    Array,
    Pose,
    TrueCamera,
    hand_held,
    made,
    observed,
    rotation,
    shape_error_um,
    views_of_poses,
)

KINDS = ("line_grid", "checkerboard", "charuco", "circles", "circles_asymmetric")
LENS_KINDS = ("pinhole", "kappa", "k1 k2", "p1 p2", "rational", "thin prism", "fisheye")
MOTIONS = ("cameras", "target", "both_cameras", "free", "free", "cameras+free", "target+free")
SIZES = ((1280, 1024), (1600, 1200), (2448, 2048), (4096, 3000))
TOO_LITTLE = frozenset({"calibration_dz_too_small", "calibration_one_position", "calibration_singular"})
#: codes of the causes by which a fault may be refused
CAUSES: dict[str, frozenset[str]] = {
    "swapped cameras": frozenset({"cameras_swapped"}),
    "one mirrored": frozenset({"image_mirrored", "cameras_swapped"}),
    "wrong unit": frozenset({"positions_unit", "position_wrong"}) | TOO_LITTLE,
    "reversed sign": frozenset({"positions_sign_reversed"}),
    "permuted files": frozenset({"positions_permuted", "position_wrong", "pair_inconsistent", "too_few_poses"}),
    "bumped half-way": frozenset({"pair_inconsistent", "too_few_poses", "position_wrong"}),
    "bent board": frozenset({"target_not_flat"}),
    "wrong size": frozenset({"view_shape"}),
    "parallel poses": frozenset({"poses_parallel", "calibration_singular"}),
    "too few poses": frozenset({"too_few_poses"}) | TOO_LITTLE,
    "moved in some": frozenset({"pair_inconsistent", "too_few_poses"}),
}
#: words of the causes that the reasons of a verdict may give for a fault, where its numbers are wrong
REASONS: dict[str, tuple[str, ...]] = {
    "permuted files": ("left out", "moved there", "cameras disagree"),
    "bumped half-way": ("left out", "moved there", "cameras disagree"),
    "moved in some": ("left out", "moved there", "cameras disagree"),
    "bent board": ("departs from a plane", "um out of plane", "Node corrections"),
    "parallel poses": ("Predicted shape uncertainty",),
    "too few poses": ("Predicted shape uncertainty", "nothing independent confirms"),
}
#: the same of a sound rig whose lens no model here has
FOREIGN_LENSES = ("thin prism", "fisheye")
LENS_REASON = "hold structure"
#: faults that no part of the views escapes: a calibration of them that is called good is a violation, however wide
EVERYWHERE = frozenset(
    {"swapped cameras", "one mirrored", "wrong unit", "reversed sign", "wrong size", "too few poses"}
)
STAGE_FAULTS = (
    "swapped cameras",
    "one mirrored",
    "wrong unit",
    "reversed sign",
    "permuted files",
    "bumped half-way",
    "bent board",
    "wrong size",
    "too few poses",
)
FREE_FAULTS = (
    "one mirrored",
    "permuted files",
    "bumped half-way",
    "bent board",
    "wrong size",
    "parallel poses",
    "too few poses",
    "moved in some",
)
FAULTY = 1.0 / 3.0
SIGMAS = 3.0


@dataclass(frozen=True)
class RandomRig:
    """One rig, its views, and what was told of it."""

    seed: int
    kind: str
    lens: str
    motion: str
    fault: str | None
    angle_deg: float
    standoff_mm: float
    noise_px: float
    cameras: tuple[TrueCamera, TrueCamera]
    target: AnyTarget
    views: list[CalibrationView]
    nominals: tuple[NominalValues, NominalValues]
    options: CalibrationOptions

    @property
    def text(self) -> str:
        """The rig in one line."""
        return (
            f"seed {self.seed}: {self.kind}, {self.lens}, {self.motion}, {self.angle_deg:.0f} degrees, "
            f"{self.standoff_mm:.0f} mm, noise {self.noise_px:.3f} px, {self.fault or 'no fault'}"
        )


@dataclass(frozen=True)
class Answer:
    """What the calibration said of a rig.

    Attributes
    ----------
    outcome
        ``right`` within the reported uncertainty, ``warned`` (wrong, not good, for the right cause), ``refused``, or a
        violation: ``good and wrong``, ``good in spite of the fault``, ``refused without a fault``, ``wrong cause``.
    ratio
        True over reported shape error; NaN where refused.
    said
        Verdict's level, or the error's code.
    detail
        Reasons.
    """

    outcome: str
    ratio: float
    said: str
    detail: str
    model: str = ""

    @property
    def violation(self) -> bool:
        """True for what must not be."""
        return self.outcome not in ("right", "warned", "refused")


def random_rig(seed: int) -> RandomRig:
    """Return the rig of a seed."""
    rng = np.random.default_rng([18, seed])
    size = SIZES[rng.integers(len(SIZES))]
    focal = float(size[0] * rng.uniform(1.2, 4.0))
    standoff = float(np.exp(rng.uniform(np.log(500.0), np.log(10_000.0))))
    angle = float(rng.uniform(6.0, 60.0))
    kind = str(rng.choice(KINDS))
    lens_kind = str(rng.choice(LENS_KINDS))
    motion = str(rng.choice(MOTIONS))
    staged, free = motion != "free", "free" in motion
    fault = None
    if rng.random() < FAULTY:
        fault = str(rng.choice(STAGE_FAULTS if not free else FREE_FAULTS if not staged else ("bumped half-way",)))
    noise = float(np.exp(rng.uniform(np.log(0.005), np.log(0.05))))
    extent = 0.45 * min(size) / focal * standoff
    exact = fault == "bent board" or rng.random() < 0.5
    tolerance = 0.0 if exact else 2e-4 * extent
    target = _target(kind, rng, extent, tolerance)
    nodes = nodes_of(target)
    dot_radius = float(rng.uniform(0.2, 0.35)) * target.pitch_mm if kind.startswith("circles") else None
    bow = 4e-3 * extent if fault == "bent board" else 0.0
    points = made(nodes, rng, tolerance_mm=tolerance, bow_mm=bow, axes=3 if free else 2)
    cameras = _cameras(rng, lens_kind, size, focal, standoff, angle, kind)
    views: list[CalibrationView] = []
    held: tuple[float, ...] = ()
    if staged:
        step_mm = 0.04 * standoff
        positions = [0.0] if fault == "too few poses" else [step_mm * k for k in range(5)]
        held = () if fault == "too few poses" else (_told(positions[2], fault),)
        views += _staged(rng, cameras, points, positions, motion.split("+")[0], noise, dot_radius, fault)
    if free:
        n = 2 if fault == "too few poses" else int(rng.integers(9, 14))
        views += _free(rng, cameras, points, n, noise, dot_radius, fault, standoff, kind, nodes)
    if fault == "swapped cameras":
        views = [replace(v, camera="cam2" if v.camera == "cam1" else "cam1") for v in views]
    if fault == "one mirrored":
        views = [_mirrored(v, size[0]) if v.camera == "cam2" else v for v in views]
    if fault == "wrong size":
        views = [replace(v, xy_px=v.xy_px[:-1]) for v in views]
    nominals = [
        NominalValues(
            size,
            focal * (1.0 + 0.2 * float(rng.uniform(-1, 1))),
            standoff * (1.0 + 0.2 * float(rng.uniform(-1, 1))) if staged else None,
            sign * 0.5 * angle + 5.0 * float(rng.uniform(-1, 1)) if staged else None,
        )
        for sign in (-1.0, 1.0)
    ]
    moves = motion.split("+")[0]
    options = CalibrationOptions(moves=moves, held_out_mm=held)  # type: ignore[arg-type]
    return RandomRig(
        seed,
        kind,
        lens_kind,
        motion,
        fault,
        angle,
        standoff,
        noise,
        cameras,
        target,
        views,
        (nominals[0], nominals[1]),
        options,
    )


def answer(rig: RandomRig) -> Answer:
    """Calibrate a rig and judge what comes of it."""
    try:
        result = calibrate(rig.views, rig.target, rig.nominals, rig.options)
    except StereorigError as error:
        code = error.code
        if rig.fault is None:
            outcome = "refused without a fault"
        else:
            outcome = "refused" if code in CAUSES[rig.fault] else "wrong cause"
        return Answer(outcome, float("nan"), code, str(error))
    ratio = true_over_reported(rig, result)
    good = result.verdict.level == "good"
    dropped = "; ".join(f"{d.name}: {d.reason}" for d in result.dropped)
    detail = " ".join(result.verdict.reasons) + dropped
    if good and rig.fault in EVERYWHERE:
        outcome = "good in spite of the fault"
    elif ratio <= SIGMAS:
        outcome = "right"
    elif good:
        outcome = "good and wrong"
    else:
        outcome = "warned" if _names_cause(rig, detail) else "wrong cause"
    return Answer(outcome, ratio, result.verdict.level, detail, result.lens.model)


def _names_cause(rig: RandomRig, detail: str) -> bool:
    """Return True if the reasons of a verdict name what is wrong with a rig."""
    words = REASONS.get(rig.fault, ()) if rig.fault is not None else ()
    if rig.lens in FOREIGN_LENSES:
        words = (*words, LENS_REASON)
    return any(word.lower() in detail.lower() for word in words)


def true_over_reported(rig: RandomRig, result: CalibrationResult) -> float:
    """True over reported shape error at the points of the report, in camera 1's frame."""
    points = result.pair.cam1.cam_from_sys.apply(result.uncertainty.points_mm)
    one, two = rig.cameras
    apart = [replace(c, R=c.R @ one.R.T, t_mm=c.t_mm - c.R @ one.R.T @ one.t_mm) for c in (one, two)]
    pair = result.pair
    xyz = pair.triangulate(*(c.project(points) for c in apart)).xyz_mm
    if not np.isfinite(xyz).all():
        return float("inf")
    return shape_error_um(pair, apart, points) / (1e3 * result.uncertainty.shape_rms_mm)


def _target(kind: str, rng: np.random.Generator, extent: float, tolerance: float) -> AnyTarget:
    columns, rows = int(rng.integers(8, 11)), int(rng.integers(6, 9))
    if kind == "line_grid":
        n = int(rng.integers(9, 12))
        pitch = extent / (n - 3)
        return GridTarget(
            pitch_mm=pitch, lines=(n, n), line_width_mm=0.03 * pitch, node_tolerance_mm=tolerance, dark_lines=True
        )
    pitch = extent / (columns - 1) / (2.0 if kind == "circles_asymmetric" else 1.0)
    return BoardTarget(
        kind=kind,  # type: ignore[arg-type]
        size=(columns, rows),
        pitch_mm=pitch,
        node_tolerance_mm=tolerance,
        marker_mm=0.7 * pitch if kind == "charuco" else None,
    )


def _cameras(
    rng: np.random.Generator,
    lens_kind: str,
    size: tuple[int, int],
    focal: float,
    standoff: float,
    angle: float,
    kind: str,
) -> tuple[TrueCamera, TrueCamera]:
    roll = float(rng.choice([0.0, 45.0])) if kind == "line_grid" else 0.0
    out = []
    for sign in (-1.0, 1.0):
        f = focal * float(rng.uniform(0.98, 1.02))
        centre = 0.5 * (np.array(size) - 1.0) + 0.01 * size[0] * rng.uniform(-1, 1, 2)
        K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
        R = rotation(
            np.radians(roll + rng.uniform(-5, 5)),
            np.radians(rng.uniform(-2, 2)),
            np.radians(sign * 0.5 * angle + rng.uniform(-1, 1)),
        )
        t = np.array([*(0.01 * standoff * rng.uniform(-1, 1, 2)), standoff * rng.uniform(0.98, 1.02)])
        lens = _lens(rng, lens_kind, float(0.5 * np.hypot(*size) / f), f)
        out.append(TrueCamera(size, K, lens, R, t, fisheye=lens_kind == "fisheye"))
    return out[0], out[1]


def _lens(rng: np.random.Generator, kind: str, corner: float, focal: float) -> tuple[float, ...]:
    """Coefficients whose terms move the image's corner by shares of its distance that lenses have."""
    del focal
    k1, k2 = 0.08 * rng.uniform(-1, 1) / corner**2, 0.03 * rng.uniform(-1, 1) / corner**4
    p1, p2 = 0.002 * rng.uniform(-1, 1, 2) / corner
    s1, s3 = 0.001 * rng.uniform(-1, 1, 2) / corner
    k4, k5 = 0.05 * rng.uniform(-1, 1) / corner**2, 0.02 * rng.uniform(-1, 1) / corner**4
    terms: dict[str, tuple[float, ...]] = {
        "pinhole": (0.0,) * 5,
        # the paper's lens divides by 1 + kappa r^2
        "kappa": (0.0, 0.0, 0.0, 0.0, 0.0, abs(k4), 0.0, 0.0),
        "k1 k2": (k1, k2, 0.0, 0.0, 0.0),
        "p1 p2": (k1, k2, p1, p2, 0.0),
        "rational": (k1, k2, p1, p2, 0.0, k4, k5, 0.0),
        "thin prism": (k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0, s1, 0.0, s3, 0.0),
        "fisheye": (0.05 * float(rng.uniform(-1, 1)), 0.02 * float(rng.uniform(-1, 1)), 0.0, 0.0),
    }
    return tuple(float(v) for v in terms[kind])


def _bump(rng: np.random.Generator) -> Array:
    way = rng.standard_normal(3)
    return np.asarray(np.radians(rng.uniform(0.3, 1.5)) * way / np.linalg.norm(way))


def _told(dz_mm: float, fault: str | None) -> float:
    return dz_mm / 25.4 if fault == "wrong unit" else -dz_mm if fault == "reversed sign" else dz_mm


def _staged(
    rng: np.random.Generator,
    cameras: tuple[TrueCamera, TrueCamera],
    points: Array,
    positions: list[float],
    moves: str,
    noise: float,
    dot_radius: float | None,
    fault: str | None,
) -> list[CalibrationView]:
    out: list[CalibrationView] = []
    direction = np.array([*np.sin(np.radians(2.0) * rng.uniform(-1, 1, 2)), 0.0])
    direction[2] = np.sqrt(1.0 - direction @ direction)
    bump = _bump(rng)
    for name, camera in zip(CAMERAS, cameras, strict=True):
        tilt = np.array([*(1e-3 * rng.standard_normal(2)), 0.0])  # the prior's
        tilt[2] = np.sqrt(1.0 - tilt @ tilt)
        declared = list(positions)
        if fault == "permuted files" and name == "cam2":
            declared[1], declared[3] = declared[3], declared[1]
        for k, dz in enumerate(positions):
            turn = bump if fault == "bumped half-way" and name == "cam2" and k >= 3 else None
            shift = dz * (tilt if moves == "cameras" else camera.R @ direction)
            xy = observed(camera.moved(shift, turn), points, rng, noise, dot_radius)
            out.append(CalibrationView(name, _told(declared[k], fault), xy, sigma_px=noise, dot_radius_mm=dot_radius))
    return out


def _free(
    rng: np.random.Generator,
    cameras: tuple[TrueCamera, TrueCamera],
    points: Array,
    n: int,
    noise: float,
    dot_radius: float | None,
    fault: str | None,
    standoff: float,
    kind: str,
    nodes: Array,
) -> list[CalibrationView]:
    tilt = 0.5 if fault == "parallel poses" else 30.0
    share = 0.6 if kind == "charuco" else 1.0
    reach = 0.5 * float(np.abs(nodes).max())
    poses = hand_held(
        rng, cameras, points, n, tilt_deg=tilt, span_mm=min(reach, 0.2 * standoff), least_share=share, turn_deg=20.0
    )
    views = views_of_poses(cameras, points, poses, rng, noise, dot_radius_mm=dot_radius)
    if fault == "permuted files":
        views = [replace(v, frame=((v.frame or 0) + 1) % n) if v.camera == "cam2" else v for v in views]
    if fault == "bumped half-way":
        after = cameras[0], cameras[1].moved(np.zeros(3), _bump(rng))
        half = n // 2
        views = views[: 2 * half] + views_of_poses(
            after, points, poses[half:], rng, noise, first=half, dot_radius_mm=dot_radius
        )
    if fault == "moved in some":
        for k in map(int, rng.choice(n, 2, replace=False)):
            moved = Pose(_turned(rng) @ poses[k].R, poses[k].t_mm + 0.02 * np.abs(nodes).max() * rng.uniform(-1, 1, 3))
            views[2 * k + 1] = views_of_poses(cameras, points, [moved], rng, noise, first=k, dot_radius_mm=dot_radius)[
                1
            ]
    return views


def _turned(rng: np.random.Generator) -> Array:
    return rotation(*np.radians(rng.uniform(-1.5, 1.5, 3)))


def _mirrored(view: CalibrationView, width: int) -> CalibrationView:
    """A mirrored camera's view, its points counted as a localiser does, which knows no mirrors: columns turn round."""
    xy = np.stack([width - 1.0 - view.xy_px[..., 0], view.xy_px[..., 1]], axis=-1)[::-1]
    return replace(view, xy_px=xy)
