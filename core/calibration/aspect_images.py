"""The aspect ratio from images of the grid alone, section 3.2.2, with an error for images that do not show it.

The measure needs the lines at about 45 degrees and the optical axis along the grid's normal: a tilt tau changes lambda
by tau^2 / 2 at most. Perspective shows the tilt; it gives an angle if the stand-off is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.aspect import AspectResult, measure_aspect
from stereorig.core.calibration.expect import correlation_of_lines
from stereorig.core.errors import CalibrationInputError
from stereorig.core.grid.view import GridView

MAX_TILT_RAD = float(np.radians(1.0))  # lambda is off by 1.5e-4
_MAX_OFF_DIAGONAL_RAD = float(np.radians(20.0))
#: of the image's width; lenses in use are shorter, and a shorter one makes the same perspective at a smaller tilt
_LONGEST_PHD = 30.0
_SIGMAS = 3.0


@dataclass(frozen=True)
class AspectMeasurement:
    """A measured aspect ratio of one camera.

    Attributes
    ----------
    aspect, sigma
        Rows' scale over columns' scale, and its standard deviation from the intersections' noise.
    images
        Number of images.
    tilt_rad, tilt_sigma_rad
        Largest angle between grid and image plane, and its standard deviation; an upper bound if the stand-off was not
        given.
    tilt_effect
        The most by which tilts so large change the aspect ratio.
    standoff_known
        True if the tilt is an angle and no bound.
    text
        The finding in one sentence.
    """

    aspect: float
    sigma: float
    images: int
    tilt_rad: float
    tilt_sigma_rad: float
    tilt_effect: float
    standoff_known: bool
    text: str


def measure_aspect_normal(
    views: Sequence[GridView], *, standoff_mm: float | None = None, names: Sequence[str] = ()
) -> AspectMeasurement:
    """Measure the aspect ratio of one camera and check that the images show it.

    Parameters
    ----------
    views
        The grid in one camera's images, moved about in its plane between them; the paper takes twenty.
    standoff_mm
        Distance of the camera from the grid, good to a few tens of percent. Without it, the stand-off of the longest
        lens in use is taken, which sees the same perspective at the largest tilt.
    names
        Names of the views in messages.

    Raises
    ------
    CalibrationInputError
        ``aspect_not_diagonal``, ``aspect_not_normal`` with the reason; ``aspect_views`` as :func:`measure_aspect`.
    """
    result: AspectResult = measure_aspect(views)
    labels = [names[k] if k < len(names) else f"image {k + 1}" for k in range(len(views))]
    for label, view in zip(labels, views, strict=True):
        off = view.rotation_rad - 0.25 * np.pi
        if abs(off) > _MAX_OFF_DIAGONAL_RAD:
            raise CalibrationInputError(
                f"{label}: the lines lie at {np.degrees(view.rotation_rad):.1f} degrees to the rows, "
                f"{abs(np.degrees(off)):.0f} off the 45 degrees that the measure needs.",
                code="aspect_not_diagonal",
                remedy="Turn the grid until its lines lie at 45 degrees.",
            )
    perspective = grid_perspective(views)
    standoff = _longest_standoff_mm(views) if standoff_mm is None else standoff_mm
    tilt, tilt_sigma = perspective.tilt_rad(standoff)
    # the largest of many random errors is large, so each image's tilt is compared with its own uncertainty
    excess = tilt - _SIGMAS * tilt_sigma
    worst = int(np.argmax(excess))
    shown = f"{np.degrees(tilt[worst]):.2f} +- {np.degrees(tilt_sigma[worst]):.2f} degrees"
    if excess[worst] > MAX_TILT_RAD:
        by = (
            f"up to {shown}, taking the longest lens in use"
            if standoff_mm is None
            else f"{shown} at {standoff:g} mm from it"
        )
        raise CalibrationInputError(
            f"{labels[worst]}: its perspective shows the grid tilted by {by}; more than "
            f"{np.degrees(MAX_TILT_RAD):.0f} degree changes the aspect ratio by {0.5 * MAX_TILT_RAD**2:.1e} and more.",
            code="aspect_not_normal",
            remedy="Set the optical axis along the grid's normal"
            + (", or give the stand-off." if standoff_mm is None else "."),
        )
    largest = int(np.argmax(tilt))
    effect = float(result.aspect * 0.5 * np.mean(tilt**2))
    count = f"{len(views)} image{'s' if len(views) > 1 else ''}"
    text = (
        f"aspect ratio {result.aspect:.6f} +- {result.sigma:.6f} from {count}; tilt "
        f"{'at most ' if standoff_mm is None else ''}{np.degrees(tilt[largest]):.2f} +- "
        f"{np.degrees(tilt_sigma[largest]):.2f} degrees, which changes it by {effect:.1e} at most"
    )
    return AspectMeasurement(
        result.aspect,
        result.sigma,
        len(views),
        float(tilt[largest]),
        float(tilt_sigma[largest]),
        effect,
        standoff_mm is not None,
        text,
    )


def _longest_standoff_mm(views: Sequence[GridView]) -> float:
    pitch_px = float(np.median([v.pitch_px for v in views]))
    return _LONGEST_PHD * views[0].image_size_px[0] * views[0].target.pitch_mm / pitch_px


# Angle between a line grid's plane and the image plane, from the perspective in its images.
#
# The far side of a grid turned by tau is imaged smaller: its depth varies by tan(tau) / stand-off for every millimetre
# across it. A homography has just these two numbers more than an affine map; a Seidel term accounts for the lens's
# distortion.

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
