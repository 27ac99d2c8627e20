"""Inputs of a calibration: views of the target, nominal lens data, options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from core.arrays import Bool, Float
from core.errors import CalibrationInputError
from core.names import CameraName

_MIN_SPREAD_PX = 5.0  # rms over the narrower direction


class TargetLike(Protocol):
    """The part of the target's description that the calibration needs."""

    @property
    def pitch_mm(self) -> float:
        """Distance of neighbouring lines."""
        ...

    @property
    def lines(self) -> tuple[int, int]:
        """Number of lines crossed when walking along X_sys and along Y_sys."""
        ...

    @property
    def node_tolerance_mm(self) -> float:
        """The maker's bound on the position error of a node, per axis (0: exact)."""
        ...


@dataclass(frozen=True)
class NominalCamera:
    """Nominal data of a camera before it is calibrated.

    Attributes
    ----------
    image_size_px
        (width, height).
    phd_px, standoff_mm, angle_deg
        Pinhole distance, distance to the target and gamma of Eq. (1), each good to a few tens of percent or some
        degrees.
    aspect
        Rows' scale over columns' scale; measured on its own (section 3.2.2) and held fixed.
    """

    image_size_px: tuple[int, int]
    phd_px: float
    standoff_mm: float
    angle_deg: float
    aspect: float = 1.0

    @property
    def centre_px(self) -> tuple[float, float]:
        """Middle of the image, pixel centres at integers."""
        return 0.5 * (self.image_size_px[0] - 1), 0.5 * (self.image_size_px[1] - 1)


@dataclass(frozen=True)
class CalibrationView:
    """The target's inner intersections in one image.

    Attributes
    ----------
    camera
        The camera's name.
    dz_mm
        Its read-back travel along its own optical axis, positive away from the target.
    xy_px
        (n_a, n_b, 2) image positions, first axis along X_sys, second along Y_sys; NaN where one was not found.
    sigma_px
        Standard deviation per axis reported by the localiser, as a number or (n_a, n_b); None where it reports none.
        Only ratios matter: the noise level is estimated from the residuals.
    name
        Name used in messages (a file name, for instance).
    correlation
        Observed coordinates per independent one. A fit over whole lines gives every intersection on a line the line's
        own error, so that 162 coordinates of 18 straight lines hold no more information than 36 independent ones.
    """

    camera: CameraName
    dz_mm: float
    xy_px: Float
    sigma_px: float | Float | None = None
    name: str = ""
    correlation: float = 1.0

    @property
    def label(self) -> str:
        """Name for messages."""
        return self.name or f"{self.camera} at {self.dz_mm:+.3f} mm"

    @property
    def found(self) -> Bool:
        """(n_a, n_b), True where the intersection was found."""
        return np.asarray(np.isfinite(self.xy_px).all(axis=-1))


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """Settings of a calibration.

    Attributes
    ----------
    held_out_mm
        Positions left out of the fit and used for the check.
    hold_out_tolerance_mm
        Largest difference of a read-back position from the value given in ``held_out_mm``.
    centre_sigma_px
        Prior on the image centre. cx and x0 correlate at 0.9998, so that it has no effect in 3-D and keeps the solver
        from drifting along the valley.
    axis_tilt_sigma_rad
        Prior on the angle between stage axis and optical axis, per direction. The residuals cannot show it (1 mrad
        moves cx by 12 px at the same RBE), so it must be declared; it is carried into the covariance. 0 holds the
        axis fixed.
    estimate_nodes
        True if node corrections are unknowns; None: if the target has a tolerance.
    max_shape_uncertainty
        Largest predicted standard deviation of shape, relative to the target's extent, that is accepted.
    max_centre_sigma_px, max_standoff_sigma
        Largest predicted standard deviation of the image centre, and of the standoff relative to itself. Near the
        target's plane the shape stays good without any travel; these two show if the travel is enough.
    max_iterations
        Of the adjustment of both cameras.
    """

    held_out_mm: tuple[float, ...] = ()
    hold_out_tolerance_mm: float = 0.02
    centre_sigma_px: float = 20.0
    axis_tilt_sigma_rad: float = 0.0
    estimate_nodes: bool | None = None
    max_shape_uncertainty: float = 1e-3
    max_centre_sigma_px: float = 3.0
    max_standoff_sigma: float = 0.02
    max_iterations: int = 60


def inner_nodes_mm(target: TargetLike) -> Float:
    """Nominal positions of the inner intersections in the target's plane, (n_a, n_b, 2), origin at the centre."""
    (n_a, n_b), pitch = target.lines, target.pitch_mm
    x = (np.arange(1, n_a - 1) - 0.5 * (n_a - 1)) * pitch
    y = (np.arange(1, n_b - 1) - 0.5 * (n_b - 1)) * pitch
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)


def extent_mm(target: TargetLike) -> float:
    """Longer side of the field of inner intersections."""
    return float((max(target.lines) - 3) * target.pitch_mm)


def is_held_out(dz_mm: float, options: CalibrationOptions) -> bool:
    """Return True if a position is among those left out of the fit."""
    return any(abs(dz_mm - held) <= options.hold_out_tolerance_mm for held in options.held_out_mm)


def check_view(view: CalibrationView, target: TargetLike, nominal: NominalCamera) -> None:
    """Raise an error for a view whose numbers cannot be used.

    Raises
    ------
    CalibrationInputError
        ``view_shape``, ``view_not_finite``, ``view_outside_image``, ``view_incomplete``, ``view_degenerate``.
    """
    expected = (target.lines[0] - 2, target.lines[1] - 2, 2)
    if view.xy_px.shape != expected:
        raise CalibrationInputError(
            f"{view.label} has intersections of shape {view.xy_px.shape}, but the target has {expected}.",
            code="view_shape",
            remedy="Give the inner intersections of the target described.",
            view=view.label,
        )
    if not np.isfinite(view.dz_mm) or np.isinf(view.xy_px).any() or not _positive(view.sigma_px):
        raise CalibrationInputError(
            f"{view.label} holds a position, intersection or sigma that is not a finite number.",
            code="view_not_finite",
            remedy="Give finite numbers; mark a missing intersection by NaN in both coordinates.",
            view=view.label,
        )
    found = view.found
    if found.sum() < max(6, found.size // 4):
        raise CalibrationInputError(
            f"{view.label} has {int(found.sum())} of {found.size} intersections.",
            code="view_incomplete",
            remedy="Show the whole grid, clean and evenly lit.",
            view=view.label,
        )
    width, height = nominal.image_size_px
    xy = view.xy_px[found]
    if np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)[-1] < _MIN_SPREAD_PX * np.sqrt(len(xy)):
        raise CalibrationInputError(
            f"{view.label} shows the intersections within {np.ptp(xy, axis=0).round(1).tolist()} px, no grid.",
            code="view_degenerate",
            remedy="Show the grid across the image.",
            view=view.label,
        )
    if (xy < -0.5).any() or (xy[:, 0] > width - 0.5).any() or (xy[:, 1] > height - 0.5).any():
        raise CalibrationInputError(
            f"{view.label} has intersections from {xy.min(axis=0).round(1).tolist()} to "
            f"{xy.max(axis=0).round(1).tolist()} px, but the image is {width} x {height} px.",
            code="view_outside_image",
            remedy="Check image_size_px of the rig and which camera took the image.",
            view=view.label,
        )


def _positive(sigma_px: ArrayLike | None) -> bool:
    if sigma_px is None:
        return True
    sigma = np.asarray(sigma_px, dtype=np.float64)
    return bool((sigma[np.isfinite(sigma)] > 0.0).all())
