"""The aspect ratio lambda as its own measurement, section 3.2.2.

If the optical axis is normal to the grid and the lines are at about 45 degrees, both diagonals of a square block of
intersections have one physical length; one runs along the columns, the other along the rows.

Effect of tilt: a grid turned by a small angle tau about the rows shows its columns shorter by tau^2 / 2 (1 degree:
1.5e-4), one turned about the columns makes lambda too large by as much. The diagonals do not show it. The refinement
over translated images does: known travel dZ along the axis gives the pinhole distance, and the convergence of the lines
then gives the tilt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import ELEVEN_PARAMETER_NAMES, Camera
from stereorig.core.errors import CalibrationInputError
from stereorig.core.grid.view import GridView
from stereorig.core.target import GridTarget

_BLOCK = 5
_CENTRE_PRIOR = 0.04  # share of the image's width: the image centre is never far from the middle, and has little effect
_KAPPA_PRIOR = 0.1  # kappa r^2 at the image's corner
_SIGMA_FLOOR_PX = 1e-4
_MIN_MOVED = 3
_MIN_SCALE_CHANGE = 1e-3


@dataclass(frozen=True)
class AspectResult:
    """The measured aspect ratio.

    Attributes
    ----------
    aspect, sigma
        The best value and its standard deviation: the refined one if there is one, else the first.
    first_estimate, first_estimate_sigma
        Mean over blocks and images of the diagonals' ratio; standard deviation of the images' means over the root of
        their number.
    blocks
        (images, block positions along X_sys, along Y_sys) ratio of each 5 x 5 block.
    refined, refined_sigma
        From the fit over translated images; None from fewer than three without known travel.
    tilt_rad
        (about the rows, about the columns) of the grid, from that fit; None without it. Without it, lambda has a bias
        of half of the tilt's square.
    """

    aspect: float
    sigma: float
    first_estimate: float
    first_estimate_sigma: float
    blocks: Float
    refined: float | None
    refined_sigma: float | None
    tilt_rad: tuple[float, float] | None

    @property
    def per_image(self) -> Float:
        """Mean of each image's blocks, (images,)."""
        return np.asarray(self.blocks.mean(axis=(1, 2)))


def block_ratios(xy_px: ArrayLike) -> Float:
    """Ratio of the diagonals of every 5 x 5 block of intersections.

    Parameters
    ----------
    xy_px
        (m, n, 2) intersections, indexed [i along X_sys, j along Y_sys].

    Returns
    -------
    Float
        (m - 4, n - 4) |dY_img| of the column-wise diagonal over |dX_img| of the row-wise one.
    """
    xy = np.asarray(xy_px, dtype=np.float64)
    if xy.ndim != 3 or xy.shape[2] != 2 or min(xy.shape[:2]) < _BLOCK:
        raise CalibrationInputError(
            f"intersections must be (m, n, 2) with at least {_BLOCK} each way, got {xy.shape}", code="aspect_views"
        )
    s = _BLOCK - 1
    # X_sys runs right and down, Y_sys left and down: their sum runs along the columns, their difference along the rows
    columns = xy[s:, s:] - xy[:-s, :-s]
    rows = xy[s:, :-s] - xy[:-s, s:]
    return np.asarray(np.abs(columns[..., 1]) / np.abs(rows[..., 0]))


def measure_aspect(views: Sequence[GridView], *, dz_mm: Sequence[float] | None = None) -> AspectResult:
    """Measure lambda from images of a grid (nearly) normal to the optical axis.

    Parameters
    ----------
    views
        Detections of one target by one camera; the paper takes twenty.
    dz_mm
        Travel of the camera along its axis at each view, away from the target. With travel the estimate is refined by a
        fit of the whole camera over the translated images, which removes the effect of the tilt. Without it, and with
        three views or more, all intersections of all views are fitted with one aspect ratio and one distortion, the
        axis being normal to the grid: that averages the noise and removes the effect of distortion, but not of tilt.

    Raises
    ------
    CalibrationInputError
        ``aspect_views``: no views, too few intersections, different targets or image sizes, or positions of another
        number.
    """
    if not views:
        raise CalibrationInputError("no views were given", code="aspect_views")
    if any(v.target != views[0].target or v.image_size_px != views[0].image_size_px for v in views):
        raise CalibrationInputError("the views show different targets or image sizes", code="aspect_views")
    blocks = np.stack([block_ratios(v.xy_px) for v in views])
    per_image = blocks.mean(axis=(1, 2))
    first = float(per_image.mean())
    n = len(views)
    if n > 1:
        first_estimate_sigma = float(per_image.std(ddof=1) / np.sqrt(n))
    else:
        # one image: its intersections' own noise; a diagonal has two ends, and the blocks share most of them
        span = float(np.median(np.abs(views[0].xy_px[_BLOCK - 1 :, : 1 - _BLOCK] - views[0].xy_px[: 1 - _BLOCK, 4:])))
        first_estimate_sigma = 2.0 * float(np.median(views[0].sigma_px)) / max(span, 1.0)
    if dz_mm is None:
        if n < _MIN_MOVED:
            return AspectResult(first, first_estimate_sigma, first, first_estimate_sigma, blocks, None, None, None)
        value, sigma = _refine_moved(views, first)
        return AspectResult(value, sigma, first, first_estimate_sigma, blocks, value, sigma, None)
    dz = np.asarray(dz_mm, dtype=np.float64)
    if dz.shape != (n,) or not np.isfinite(dz).all():
        raise CalibrationInputError(f"{n} views need {n} finite positions, got {list(dz_mm)}", code="aspect_views")
    if float(np.ptp(dz)) == 0.0:
        raise CalibrationInputError(
            f"all views are at dZ = {dz[0]:g} mm: without travel the tilt stays unknown", code="aspect_views"
        )
    refined, sigma, tilt = _refine(views, dz, first)
    return AspectResult(refined, sigma, first, first_estimate_sigma, blocks, refined, sigma, tilt)


def _refine(views: Sequence[GridView], dz: Float, first: float) -> tuple[float, float, tuple[float, float]]:
    """Fit all eleven parameters over the translated images."""
    target, size = views[0].target, views[0].image_size_px
    from scipy.optimize import least_squares  # slow to load, and not every start needs it

    points = _plane_points(target)
    xy = np.stack([v.xy_px for v in views])
    sigma = np.maximum(np.stack([v.sigma_px for v in views]), _SIGMA_FLOOR_PX)
    start = _start(xy, points, dz, first, size)
    corner2 = 0.25 * float(size[0] ** 2 + size[1] ** 2)
    prior = {
        "cx_px": (0.5 * (size[0] - 1), _CENTRE_PRIOR * size[0]),
        "cy_px": (0.5 * (size[1] - 1), _CENTRE_PRIOR * size[0]),
        "kappa_per_px2": (0.0, _KAPPA_PRIOR / corner2),
    }
    # steps of equal effect on the image make one trust region fit all
    scale = np.array([start[0] * 1e-2, 10.0, 10.0, 0.01 / corner2, 1e-3, 1e-3, 1e-3, 1e-3, 0.1, 0.1, start[10] * 1e-2])

    def camera(p: Float) -> Camera:
        return Camera.from_paper(**dict(zip(ELEVEN_PARAMETER_NAMES, (start + p * scale).tolist(), strict=True)))

    def residuals(p: Float) -> Float:
        cam = camera(p)
        parts = [((cam.moved(z).project(points).xy - m) / s).ravel() for z, m, s in zip(dz, xy, sigma, strict=True)]
        full = start + p * scale
        parts.append(np.array([(full[ELEVEN_PARAMETER_NAMES.index(k)] - mean) / sd for k, (mean, sd) in prior.items()]))
        return np.asarray(np.nan_to_num(np.concatenate(parts), nan=1e6))

    fit = least_squares(residuals, np.zeros(len(ELEVEN_PARAMETER_NAMES)), method="lm", xtol=1e-12, ftol=1e-12)
    dof = max(residuals(fit.x).size - len(ELEVEN_PARAMETER_NAMES), 1)
    left, jac = np.asarray(fit.fun), np.asarray(fit.jac)
    variance = max(1.0, float(left @ left) / dof)
    covariance = np.linalg.inv(jac.T @ jac) * variance
    best = start + fit.x * scale
    return (float(best[4]), float(np.sqrt(covariance[4, 4]) * scale[4]), (float(best[6]), float(best[7])))


def _refine_moved(views: Sequence[GridView], first: float) -> tuple[float, float]:
    """Fit one aspect ratio and one Seidel term over all views, each seen along the grid's normal."""
    from scipy.optimize import least_squares  # slow to load, and not every start needs it

    size = views[0].image_size_px
    middle = 0.5 * (np.array(size) - 1.0)
    corner2 = 0.25 * float(size[0] ** 2 + size[1] ** 2)
    plane = views[0].object_points_mm.reshape(-1, 2) @ np.array([1.0, 1.0j])
    xy = np.stack([v.xy_px.reshape(-1, 2) for v in views]) - middle
    sigma = np.maximum(np.stack([v.sigma_px.reshape(-1, 2) for v in views]), _SIGMA_FLOOR_PX)
    n = len(views)

    def residuals(p: Float) -> Float:
        motion = p[2:].reshape(n, 4, 1)
        s = (motion[:, 0] + 1j * motion[:, 1]) * plane + motion[:, 2] + 1j * motion[:, 3]
        bar = s / (1.0 + p[1] / corner2 * np.abs(s) ** 2)
        off = np.stack([bar.real, p[0] * bar.imag], axis=-1) - xy
        return np.concatenate([(off / sigma).ravel(), [p[1] / _KAPPA_PRIOR]])

    start = [first, 0.0]
    for w in xy @ np.array([[1.0], [1.0j / first]]):
        a = np.vdot(plane, w[:, 0]) / np.vdot(plane, plane)
        b = w.mean()  # the inner intersections are centred on the origin
        start += [a.real, a.imag, b.real, b.imag]
    fit = least_squares(residuals, np.array(start), method="trf", x_scale="jac", xtol=1e-13, ftol=1e-13)
    left, jac = np.asarray(fit.fun), np.asarray(fit.jac)
    variance = max(1.0, float(left @ left) / max(left.size - len(start), 1))
    return float(fit.x[0]), float(np.sqrt(np.linalg.inv(jac.T @ jac)[0, 0] * variance))


def _plane_points(target: GridTarget) -> Float:
    xy = target.inner_points_mm()
    return np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1)


def _start(xy: Float, points: Float, dz: Float, aspect: float, size: tuple[int, int]) -> Float:
    """Start values from scale against travel: 1 / scale = (z0 + dZ) / phd."""
    inverse_scale, alpha, shift = [], [], []
    flat = points[..., :2].reshape(-1, 2)
    for image in xy:
        u = image.reshape(-1, 2) - 0.5 * (np.array(size) - 1.0)
        u[:, 1] /= aspect
        middle = u.mean(axis=0)
        # similarity as one complex number
        z = (flat - flat.mean(axis=0)) @ np.array([1.0, 1.0j])
        w = (u - middle) @ np.array([1.0, 1.0j])
        s = np.vdot(z, w) / np.vdot(z, z)
        inverse_scale.append(1.0 / abs(s))
        alpha.append(float(np.angle(s)))
        shift.append(middle / abs(s))
    slope, offset = np.polyfit(dz, np.array(inverse_scale), 1)
    change = abs(slope) * np.ptp(dz) / offset
    if slope <= 0.0 or change < _MIN_SCALE_CHANGE:
        raise CalibrationInputError(
            f"the grid's scale changes by {slope * np.ptp(dz) / offset:.2e} over {np.ptp(dz):g} mm of travel; it must"
            f" shrink by {_MIN_SCALE_CHANGE:g} at least",
            code="aspect_views",
            remedy="Give dZ in mm, positive away from the target, and travel further.",
        )
    phd, z0 = 1.0 / slope, offset / slope
    x0, y0 = np.mean(shift, axis=0)
    middle_px = 0.5 * (np.array(size) - 1.0)
    return np.array([phd, *middle_px, 0.0, aspect, np.mean(alpha), 0.0, 0.0, x0, y0, z0])
