"""Test for cameras that disagree about the target's pose, although each camera's own views are consistent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.checks.measures import focal_lengths_px
from stereorig.core.calibration.result import ViewResult
from stereorig.core.cameras.camera import normalised_jacobian
from stereorig.core.cameras.lens import LensModel, OpenCVLens
from stereorig.core.cameras.opencv_full import OpenCVFullLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS

#: of the squared residuals: 0.7 to 1 for a bumped camera, below 0.2 for lenses that do not fit, bent boards and noise
DISAGREE_SHARE = 0.5


def share_of_own_poses(views: Sequence[ViewResult], points_mm: Float, pair: StereoPair) -> float:
    """Return the share of the squared residuals that vanishes if each camera gets its own poses of the target.

    A target seen in a free pose has one pose for both cameras. A camera that moved between the views, or images of one
    number that show two poses, make the two differ, and next to nothing else does.

    Parameters
    ----------
    views
        Views of a calibration; only free poses that both cameras saw are used.
    points_mm
        (n, 3) points of the target.
    pair
        The cameras.

    Returns
    -------
    float
        0 if no pose is used.
    """
    seen = [{v.frame for v in views if v.camera == name and v.frame is not None} for name in CAMERAS]
    total = left = 0.0
    for view in views:
        if view.frame not in seen[0] & seen[1]:
            continue
        residual = view.residual_px.reshape(-1, 2)
        found = np.isfinite(residual).all(axis=-1)
        if found.sum() <= 3:
            continue
        lens = (pair.cam1, pair.cam2)[CAMERAS.index(view.camera)].lens
        p = view.cam_from_target.apply(points_mm[found])
        by_point = lens.image_jacobian(p[:, :2] / p[:, 2:]) @ normalised_jacobian(p)
        arm = p - p.mean(axis=0)
        turns = np.stack([np.cross(np.eye(3)[axis], arm) for axis in range(3)], axis=-1)
        J = by_point @ np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], axis=-1)
        r, J = residual[found].ravel(), J.reshape(-1, 6)
        if not np.isfinite(J).all():
            continue
        total += float(r @ r)
        r = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
        # six numbers take up their share of mere noise, too
        left += float(r @ r) * len(r) / (len(r) - 6)
    return max(1.0 - left / total, 0.0) if total > 0.0 else 0.0


# Test for fitted lenses that cannot exist.

# shares of a point's distance from the centre, at the image's border: a lens of 120 degrees moves it by 0.4, and makers
# centre elements to far less than 0.05
_RADIAL, _TERM, _DECENTRING = 0.5, 1.0, 0.05
_TILT_RAD = 0.35  # adapters turn a sensor or a lens by up to 20 degrees
_DIRECTIONS, _RADII = 16, 200
_REACH = 3.0  # multiple of the border's distance without distortion, at which a barrel's image ends


def lens_faults(lens: LensModel, size_px: tuple[int, int]) -> tuple[list[str], bool]:
    """Return how a lens differs from any that exists, and whether it folds the image.

    Parameters
    ----------
    lens
        The lens.
    size_px
        (width, height) of the image.

    Returns
    -------
    list of str, bool
        Parts of a sentence; and True if the distance from the centre does not grow with the viewing angle all over
        the image, so that two directions have one pixel.
    """
    values = lens.kernel_parameters()
    focal = np.array(focal_lengths_px(lens))
    centre = np.array([values[4], values[5]])
    angle = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    way = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    inside = np.clip(centre, 0.0, np.array(size_px) - 1.0)
    with np.errstate(divide="ignore"):
        to_border = np.where(way > 0.0, (np.array(size_px) - 1.0 - inside) / way, -inside / way)
    border_px = np.min(np.where(way == 0.0, np.inf, to_border), axis=1)
    # a centre outside the image is placed on its border here, with no way to the border on that side
    way, border_px = way[border_px > 0.0], border_px[border_px > 0.0]
    reach = border_px / np.linalg.norm(way * focal, axis=1)
    radius = reach[:, None] * np.linspace(0.0, _REACH, _RADII + 1)[1:]
    image = lens.image_from_normalised(radius[..., None] * way[:, None, :])
    distance = np.where(image.valid, np.linalg.norm(image.xy - centre, axis=-1), -1.0)
    grows = np.diff(distance, axis=1) > 0.0
    before = distance[:, :-1] < border_px[:, None]
    # once a direction has reached the border, the picture knows no more of it
    seen = np.logical_and.accumulate(before, axis=1)
    folded = bool((seen & ~grows).any())
    faults = ["its image folds back within the picture"] if folded else []
    at_border = lens.image_from_normalised(reach[:, None] * way)
    ratio = np.linalg.norm((at_border.xy - centre) / focal, axis=-1) / reach
    moved = float(np.max(np.where(at_border.valid, np.abs(ratio - 1.0), 0.0)))
    if moved > _RADIAL:
        faults.append(f"it moves the image's border by {100.0 * moved:.0f} % of its distance from the centre")
    if isinstance(lens, OpenCVLens):
        corner = float(reach.max())
        if not (lens.k4 or lens.k5 or lens.k6):
            terms = {"k1": lens.k1 * corner**2, "k2": lens.k2 * corner**4, "k3": lens.k3 * corner**6}
            name = max(terms, key=lambda key: abs(terms[key]))
            if abs(terms[name]) > _TERM:
                faults.append(f"{name} alone moves the border by {100.0 * abs(terms[name]):.0f} %")
        off = float(np.hypot(lens.p1, lens.p2)) * corner
        if off > _DECENTRING:
            faults.append(f"its decentring moves the border by {100.0 * off:.0f} %")
    if isinstance(lens, OpenCVFullLens):
        off = float(np.hypot(lens.s1 + lens.s2 * corner**2, lens.s3 + lens.s4 * corner**2)) * corner
        if off > _DECENTRING:
            faults.append(f"its thin prism moves the border by {100.0 * off:.0f} %")
        if (angle_rad := float(np.hypot(lens.tau_x_rad, lens.tau_y_rad))) > _TILT_RAD:
            faults.append(f"its sensor is tilted by {np.degrees(angle_rad):.0f} degrees")
    return faults, folded
