"""Angle between a line grid's plane and the image plane, from the perspective in its images.

The far side of a grid turned by tau is imaged smaller: its depth varies by tan(tau) / stand-off for every millimetre
across it. A homography has just these two numbers more than an affine map; a Seidel term accounts for the lens's
distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.expect import correlation_of_lines
from stereorig.core.grid.view import GridView

_KAPPA_PRIOR = 0.1  # kappa r^2 at the image's corner
_SIGMA_FLOOR_PX = 1e-4


@dataclass(frozen=True)
class GridPerspective:
    """Perspective of a grid in its images.

    Attributes
    ----------
    slope_per_mm
        (n, 2) relative change of depth for a millimetre along X_sys and Y_sys, of each image.
    covariance_per_mm2
        (n, 2, 2) of these.
    """

    slope_per_mm: Float
    covariance_per_mm2: Float

    def tilt_rad(self, standoff_mm: float) -> tuple[Float, Float]:
        """Angles (n,) between grid and image plane at a stand-off, and their standard deviations."""
        size = np.linalg.norm(self.slope_per_mm, axis=1)
        along = self.slope_per_mm / np.where(size > 0.0, size, 1.0)[:, None]
        sigma = np.sqrt(np.einsum("ni,nij,nj->n", along, self.covariance_per_mm2, along))
        return np.arctan(size * standoff_mm), sigma * standoff_mm / (1.0 + (size * standoff_mm) ** 2)


def grid_perspective(views: Sequence[GridView]) -> GridPerspective:
    """Fit each view by a homography and one Seidel term about the image's middle."""
    slopes, covariances = zip(*(_fit(view) for view in views), strict=True)
    return GridPerspective(np.array(slopes), np.array(covariances))


def _fit(view: GridView) -> tuple[Float, Float]:
    from scipy.optimize import least_squares  # slow to load, and not every start needs it

    size = view.image_size_px
    middle = 0.5 * (np.array(size) - 1.0)
    corner2 = 0.25 * float(size[0] ** 2 + size[1] ** 2)
    plane = view.object_points_mm.reshape(-1, 2)
    extent = float(np.abs(plane).max())
    on = plane / extent
    xy = view.xy_px.reshape(-1, 2) - middle
    sigma = np.maximum(view.sigma_px.reshape(-1, 2), _SIGMA_FLOOR_PX)
    affine = np.linalg.lstsq(np.column_stack([on, np.ones(len(on))]), xy, rcond=None)[0]

    def residuals(p: Float) -> Float:
        depth = 1.0 + on @ p[6:8]
        bar = (on @ p[:4].reshape(2, 2) + p[4:6]) / depth[:, None]
        bent = bar / (1.0 + p[8] / corner2 * (bar**2).sum(axis=1))[:, None]
        return np.concatenate([((bent - xy) / sigma).ravel(), [p[8] / _KAPPA_PRIOR]])

    start = np.concatenate([affine[:2].ravel(), affine[2], [0.0, 0.0, 0.0]])
    fit = least_squares(residuals, start, method="trf", x_scale="jac", xtol=1e-13, ftol=1e-13)
    left, jac = np.asarray(fit.fun), np.asarray(fit.jac)
    variance = max(1.0, float(left @ left) / max(left.size - len(start), 1))
    # points on one line share its error, which their residuals do not show
    variance *= correlation_of_lines(view.target, view.line_model)
    covariance = np.linalg.inv(jac.T @ jac)[6:8, 6:8] * variance
    return np.asarray(fit.x)[6:8] / extent, covariance / extent**2
