"""Start of free poses: each camera by OpenCV, then one relative pose that most views of the pair agree on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.inputs import CalibrationView, NominalValues
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.cameras.lens import LensModel
from stereorig.core.errors import CalibrationError, CalibrationInputError
from stereorig.core.names import CAMERAS

MIN_POSES = 3
_MAX_POINTS = 120  # a view, for the start
_SAME_TURN_RAD = np.radians(3.0)
_SAME_SHIFT = 0.1  # share of the distance to the target
_RATIOS = (1.0, 0.6, 1.7)  # multiples of the nominal aspect ratio, to start from
_SURELY = 0.5  # share of the other start's residuals
_LEAST_TILT_RAD = np.radians(3.0)
_LEAST_POINTS = 6


@dataclass(frozen=True)
class FreeStart:
    """Start values of a calibration from free poses.

    Attributes
    ----------
    focal_px, k1, aspect
        (2,) of each camera.
    cam2_from_cam1
        Relative pose.
    cam1_from_target
        Pose of the target in each frame.
    half_turned
        Frames in which camera 2 counts the points from the other end.
    odd
        Frames that do not fit the relative pose.
    """

    focal_px: Float
    k1: Float
    aspect: Float
    cam2_from_cam1: RigidTransform
    cam1_from_target: dict[int, RigidTransform]
    half_turned: frozenset[int]
    odd: tuple[int, ...]


def start_free(
    views: Sequence[CalibrationView],
    nodes_mm: Float,
    nominals: Sequence[NominalValues],
    *,
    symmetric: bool,
    open_aspect: bool = True,
) -> FreeStart:
    """Find the start of both cameras from free poses alone.

    Parameters
    ----------
    views
        Views of free poses, of both cameras.
    nodes_mm
        (n_a, n_b, 2) nominal points.
    nominals
        Nominal cameras; only the pinhole distance and the aspect ratio are used.
    symmetric
        True if the target looks the same turned by half a turn.
    open_aspect
        True if the aspect ratio may have any value.

    Raises
    ------
    CalibrationInputError
        ``too_few_poses``, ``poses_parallel``, ``image_mirrored``, ``pair_inconsistent``.
    """
    frames = {name: {v.frame: v for v in views if v.camera == name and v.frame is not None} for name in CAMERAS}
    both = sorted(set(frames["cam1"]) & set(frames["cam2"]))
    if len(both) < MIN_POSES:
        raise CalibrationInputError(
            f"The target was found by both cameras in {len(both)} pose{'' if len(both) == 1 else 's'}; "
            f"{MIN_POSES} are needed.",
            code="too_few_poses",
            remedy="Take at least three views with the target tilted differently, better fifteen.",
        )
    single = [
        _single_camera(frames[name], nodes_mm, n, open_aspect=open_aspect)
        for name, n in zip(CAMERAS, nominals, strict=True)
    ]
    _check_tilts(single[0].poses, single[1].poses)
    pairs = {k: (single[0].poses[k], single[1].poses[k]) for k in both}
    relative, flipped, agreeing = _consensus(pairs, symmetric=symmetric)
    if len(agreeing) < max(MIN_POSES, (len(both) + 1) // 2):
        _raise_inconsistent(frames["cam2"], pairs, nodes_mm, nominals[1], len(agreeing), open_aspect=open_aspect)
    poses = dict(single[0].poses)
    for k, pose in single[1].poses.items():
        if k not in poses:
            poses[k] = relative.inverse() @ pose
    return FreeStart(
        focal_px=np.array([s.focal_px for s in single]),
        k1=np.array([s.k1 for s in single]),
        aspect=np.array([s.aspect for s in single]),
        cam2_from_cam1=relative,
        cam1_from_target=poses,
        half_turned=frozenset(flipped),
        odd=tuple(k for k in both if k not in agreeing),
    )


@dataclass(frozen=True)
class _Single:
    focal_px: float
    k1: float
    aspect: float
    poses: dict[int, RigidTransform]


def _points(view: CalibrationView, nodes_mm: Float, aspect: float) -> tuple[Float, Float]:
    found = view.found
    XY, xy = nodes_mm[found], view.xy_px[found] / [1.0, aspect]
    if len(XY) > _MAX_POINTS:
        keep = np.linspace(0, len(XY) - 1, _MAX_POINTS).astype(int)
        XY, xy = XY[keep], xy[keep]
    return XY, xy


def _single_camera(
    views: Mapping[int, CalibrationView], nodes_mm: Float, nominal: NominalValues, *, open_aspect: bool
) -> _Single:
    numbers = sorted(views)
    objects, images = [], []
    for k in numbers:
        XY, xy = _points(views[k], nodes_mm, nominal.aspect)
        objects.append(np.column_stack([XY, np.zeros(len(XY))]).astype(np.float32))
        images.append(xy.astype(np.float32))
    cx, cy = nominal.centre_px[0], nominal.centre_px[1] / nominal.aspect
    size = (nominal.image_size_px[0], round(nominal.image_size_px[1] / nominal.aspect))
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS
        | cv2.CALIB_FIX_PRINCIPAL_POINT
        | cv2.CALIB_FIX_ASPECT_RATIO
        | cv2.CALIB_ZERO_TANGENT_DIST
        | cv2.CALIB_FIX_K2
        | cv2.CALIB_FIX_K3
    )
    best: tuple[float, Any, Any, Any, Any] | None = None

    def attempt(fx: float, fy: float, flags: int, share: float) -> None:
        nonlocal best
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            rms, K, dist, rvecs, tvecs = cv2.calibrateCamera(objects, images, size, K, np.zeros(5), flags=flags)
        except cv2.error:
            return
        if np.isfinite(rms) and (best is None or rms < share * best[0]):
            best = (float(rms), np.asarray(K), np.asarray(dist), rvecs, tvecs)

    focals = (nominal.phd_px, 1.6 * nominal.phd_px, nominal.phd_px / 1.6)
    for focal in focals:
        attempt(focal, focal, flags, 0.98)
    if open_aspect:
        # the fit finds a ratio near the nominal one by itself; only one that the views surely show is a better start
        for focal in focals:
            for ratio in _RATIOS:
                attempt(focal, focal * ratio, flags & ~cv2.CALIB_FIX_ASPECT_RATIO, _SURELY)
    if best is None:
        raise CalibrationError(
            "OpenCV finds no start for a camera from its views of the target.",
            code="calibration_not_converged",
            remedy="Check the target's description and phd_px of the rig file.",
        )
    _, K, dist, rvecs, tvecs = best
    poses = {
        k: RigidTransform(np.asarray(cv2.Rodrigues(np.asarray(r))[0]), np.asarray(t).ravel())
        for k, r, t in zip(numbers, rvecs, tvecs, strict=True)
    }
    return _Single(float(K[0, 0]), float(dist.ravel()[0]), nominal.aspect * float(K[1, 1] / K[0, 0]), poses)


def pose_of(view: CalibrationView, nodes_mm: Float, lens: LensModel) -> RigidTransform | None:
    """Return the target's pose in a camera's frame by its lens; None if the points do not give one."""
    XY, _ = nodes_mm[view.found], None
    rays = lens.normalised_from_image(view.xy_px[view.found])
    if int(rays.valid.sum()) < _LEAST_POINTS:
        return None
    points = np.column_stack([XY[rays.valid], np.zeros(int(rays.valid.sum()))])
    try:
        good, r, t = cv2.solvePnP(points, rays.xy[rays.valid], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
        if good:
            good, r, t = cv2.solvePnP(points, rays.xy[rays.valid], np.eye(3), np.zeros(4), r, t, True)
    except cv2.error:
        return None
    if not good:
        return None
    return RigidTransform(np.asarray(cv2.Rodrigues(np.asarray(r))[0]), np.asarray(t, dtype=np.float64).ravel())


def _check_tilts(*cameras: Mapping[int, RigidTransform]) -> None:
    widest = 0.0
    for poses in cameras:
        normals = np.stack([p.rotation[:, 2] for p in poses.values()])
        widest = max(widest, float(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max()))
    if widest < _LEAST_TILT_RAD:
        raise CalibrationInputError(
            f"All poses of the target are parallel to {np.degrees(widest):.1f} degrees: they do not determine a "
            "pinhole distance.",
            code="poses_parallel",
            remedy="Tilt the target by 20 to 40 degrees, to every side.",
        )


def _turn_rad(a: RigidTransform, b: RigidTransform) -> float:
    cosine = 0.5 * (np.trace(a.rotation.T @ b.rotation) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


_HALF_TURN = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def _consensus(
    pairs: Mapping[int, tuple[RigidTransform, RigidTransform]], *, symmetric: bool
) -> tuple[RigidTransform, set[int], list[int]]:
    """Relative pose that most frames agree on, the frames half turned for it, and those that agree."""

    def relatives(k: int) -> list[RigidTransform]:
        one, two = pairs[k]
        out = [two @ one.inverse()]
        if symmetric:
            out.append(two @ _HALF_TURN @ one.inverse())
        return out

    distance = float(np.median([np.linalg.norm(one.translation_mm) for one, _ in pairs.values()]))

    def near(a: RigidTransform, b: RigidTransform) -> bool:
        shift = float(np.linalg.norm(a.translation_mm - b.translation_mm))
        return _turn_rad(a, b) < _SAME_TURN_RAD and shift < _SAME_SHIFT * distance

    best: list[tuple[int, int]] = []
    for k in pairs:
        for candidate in relatives(k):
            support = []
            for other in pairs:
                for flip, trial in enumerate(relatives(other)):
                    if near(candidate, trial):
                        support.append((other, flip))
                        break
            # if two fit alike, the one with fewer frames turned is taken
            if (len(support), -sum(f for _, f in support)) > (len(best), -sum(f for _, f in best)):
                best = support
    members = [relatives(k)[flip] for k, flip in best]
    rotation = np.mean([m.rotation for m in members], axis=0)
    u, _, vt = np.linalg.svd(rotation)
    shift = np.median([m.translation_mm for m in members], axis=0)
    relative = RigidTransform(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, shift)
    return relative, {k for k, flip in best if flip}, [k for k, _ in best]


def _raise_inconsistent(
    second: Mapping[int, CalibrationView],
    pairs: Mapping[int, tuple[RigidTransform, RigidTransform]],
    nodes_mm: Float,
    nominal: NominalValues,
    agreeing: int,
    *,
    open_aspect: bool,
) -> None:
    width = nominal.image_size_px[0]
    unmirrored = {}
    for k in pairs:
        view = second[k]
        xy = np.stack([width - 1.0 - view.xy_px[..., 0], view.xy_px[..., 1]], axis=-1)[::-1]
        unmirrored[k] = CalibrationView(view.camera, None, xy, frame=k)
    poses = _single_camera(unmirrored, nodes_mm, nominal, open_aspect=open_aspect).poses
    _, _, mirrored = _consensus({k: (pairs[k][0], poses[k]) for k in pairs}, symmetric=True)
    if len(mirrored) > max(agreeing, len(pairs) // 2):
        raise CalibrationInputError(
            "The views fit one relative pose only if one camera's images are mirrored.",
            code="image_mirrored",
            remedy="Switch mirroring off at the camera, or flip its images back.",
        )
    raise CalibrationInputError(
        f"Only {agreeing} of {len(pairs)} poses fit one relative pose of the cameras.",
        code="pair_inconsistent",
        remedy="Check that images of one number show one pose: both cameras at the same instant, cameras fixed to "
        "each other, and no camera's files exchanged or shifted.",
    )
