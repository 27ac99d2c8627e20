"""Inputs of a calibration: views of the target, nominal lens data, options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.fit.lens_form import LensChoice
from stereorig.core.errors import CalibrationInputError
from stereorig.core.names import CameraName

Moves = Literal["cameras", "target", "both_cameras", "free"]
MOVES: tuple[Moves, ...] = get_args(Moves)

#: relative scale error of a stage of which nothing is stated: a screw's lead
ASSUMED_SCALE_SIGMA = 1e-4
_MIN_SPREAD_PX = 5.0  # rms over the narrower direction


@runtime_checkable
class BoardLike(Protocol):
    """The part of a board's description that the calibration needs, in addition to the tolerance."""

    @property
    def pitch_mm(self) -> float:
        """Distance of neighbouring points."""
        ...

    @property
    def node_tolerance_mm(self) -> float:
        """The maker's bound on the position error of a point, per axis (0: exact)."""
        ...

    def points_mm(self) -> Float:
        """Nominal positions (columns, rows, 2) in the target's plane, origin at the centre."""
        ...


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


AnyTarget = TargetLike | BoardLike


class LineOffsetsLike(Protocol):
    """Errors of the intersections of a line grid as offsets across its lines.

    The offsets of different lines are independent of each other; along a line they are not, since neighbouring
    intersections share a piece of it.
    """

    @property
    def normal_a(self) -> Float:
        """(n_a, n_b, 2) unit normal of family a's line at each intersection."""
        ...

    @property
    def normal_b(self) -> Float:
        """(n_a, n_b, 2) unit normal of family b's line."""
        ...

    @property
    def covariance_a(self) -> Float:
        """(n_a, n_b, n_b) covariance along each line of family a, px^2."""
        ...

    @property
    def covariance_b(self) -> Float:
        """(n_b, n_a, n_a) covariance along each line of family b, px^2."""
        ...


@dataclass(frozen=True)
class NominalValues:
    """Nominal data of a camera before it is calibrated.

    Attributes
    ----------
    image_size_px
        (width, height).
    phd_px
        Pinhole distance, good to a few tens of percent.
    standoff_mm, angle_deg
        Distance to the target and gamma of Eq. (1), good to a few tens of percent and some degrees. None if not
        known; stage positions need them, free poses do not.
    aspect
        Rows' scale over columns' scale; measured on its own (section 3.2.2). Held fixed if only a stage moves.
    """

    image_size_px: tuple[int, int]
    phd_px: float
    standoff_mm: float | None = None
    angle_deg: float | None = None
    aspect: float = 1.0

    @property
    def centre_px(self) -> tuple[float, float]:
        """Middle of the image, pixel centres at integers."""
        return 0.5 * (self.image_size_px[0] - 1), 0.5 * (self.image_size_px[1] - 1)

    def placed(self) -> tuple[float, float]:
        """Return stand-off and angle.

        Raises
        ------
        CalibrationInputError
            ``nominal_missing`` if one of them is not known.
        """
        if self.standoff_mm is None or self.angle_deg is None:
            missing = "standoff_mm" if self.standoff_mm is None else "angle_deg"
            raise CalibrationInputError(
                f"{missing} of a camera is not given, but stage positions need it as a start.",
                code="nominal_missing",
                remedy="Give standoff_mm and angle_deg of both cameras, or take free poses of the target.",
            )
        return self.standoff_mm, self.angle_deg


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The target's inner intersections in one image.

    Attributes
    ----------
    camera
        The camera's name.
    dz_mm
        Read-back position of the stage, positive if target and cameras move away from each other, whichever moves; None
        for a free pose.
    xy_px
        (n_a, n_b, 2) image positions, first axis along X_sys, second along Y_sys; NaN for points that were not found.
    sigma_px
        Standard deviation per axis reported by the localiser, as a number or (n_a, n_b); None if it reports none. Only
        ratios matter: the noise level is estimated from the residuals.
    name
        Name used in messages (a file name, for instance).
    correlation
        Observed coordinates per independent one. A fit over whole lines gives every intersection on a line the line's
        own error, so that 162 coordinates of 18 straight lines hold no more information than 36 independent ones.
    frame
        Number of the free pose, the same for both cameras; None if the stage's position defines the pose.
    offsets
        Covariance of the intersections along the lines; None if they are independent of each other.
    dot_radius_mm
        Radius of the target's dots, whose imaged centres differ from the images of their centres; None for corners.
    """

    camera: CameraName
    dz_mm: float | None
    xy_px: Float
    sigma_px: float | Float | None = None
    name: str = ""
    correlation: float = 1.0
    frame: int | None = None
    offsets: LineOffsetsLike | None = None
    dot_radius_mm: float | None = None

    @property
    def label(self) -> str:
        """Name for messages."""
        return self.name or place(self.camera, self.dz_mm, self.frame)

    @property
    def position_mm(self) -> float:
        """The stage's position.

        Raises
        ------
        ValueError
            For a free pose.
        """
        if self.dz_mm is None:
            raise ValueError(f"{self.label} is a free pose")
        return self.dz_mm

    @property
    def found(self) -> Bool:
        """(n_a, n_b), True where the intersection was found."""
        return np.asarray(np.isfinite(self.xy_px).all(axis=-1))


def place(camera: CameraName, dz_mm: float | None, frame: int | None) -> str:
    """Name of a view by its camera and position, for messages."""
    return f"{camera}, pose {frame}" if dz_mm is None else f"{camera} at {dz_mm:+.3f} mm"


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """Settings of a calibration.

    Attributes
    ----------
    moves
        Part of the rig that moves by dZ: ``cameras`` (each along its optical axis, the paper's), ``target`` or
        ``both_cameras`` (one stage, its direction is an unknown), or ``free``: no stage, the target is shown in any
        poses.
    lens
        Lens model; ``auto`` takes the simplest whose residuals hold no structure.
    held_out_mm
        Positions left out of the fit and used for the check.
    held_out_frames
        The same for free poses, by their numbers. Without any of both, positions between the first and the last, or
        free poses, are left out of the fit in turn for the check.
    hold_out_tolerance_mm
        Largest difference of a read-back position from the value given in ``held_out_mm``.
    centre_sigma_px
        Prior on the image centre. cx and x0 correlate at 0.9998, so that it has no effect in 3-D and keeps the solver
        from drifting along the valley.
    axis_tilt_sigma_rad
        Prior on the angle between stage axis and optical axis, per direction. The residuals cannot show it (1 mrad
        moves cx by 12 px at the same RBE), so it must be declared; it is carried into the covariance. 0 holds the axis
        fixed. Default 1 mrad, as a careful alignment reaches.
    stage_scale_sigma
        Prior on a stage's relative scale error; 0: exact. None: not stated, 1e-4 is assumed.
    stage_step_sigma_mm
        Prior on the error of each position read back; 0: exact.
    aspect_sigma
        Prior on the aspect ratio. None leaves it open for free poses; if only a stage moves it is held, with 1e-4 of it
        in the covariance unless it is 1 (square pixels). 0: exact.
    estimate_nodes
        True if node corrections are unknowns; None: if the target has a tolerance.
    max_shape_uncertainty
        Largest predicted standard deviation of shape, relative to the target's extent, that is accepted.
    max_centre_sigma_px, max_standoff_sigma
        Largest predicted standard deviation of the image centre, and of the standoff relative to itself. Near the
        target's plane the shape stays good without any travel; these two show if the travel is enough.
    max_iterations
        Limit of iterations of the adjustment of both cameras.
    """

    moves: Moves = "cameras"
    lens: LensChoice = "auto"
    held_out_mm: tuple[float, ...] = ()
    held_out_frames: tuple[int, ...] = ()
    hold_out_tolerance_mm: float = 0.02
    centre_sigma_px: float = 20.0
    axis_tilt_sigma_rad: float = 1e-3
    stage_scale_sigma: float | None = None
    stage_step_sigma_mm: float = 0.0
    aspect_sigma: float | None = None
    estimate_nodes: bool | None = None
    max_shape_uncertainty: float = 1e-3
    max_centre_sigma_px: float = 3.0
    max_standoff_sigma: float = 0.02
    max_iterations: int = 60

    @property
    def scale_sigma(self) -> float:
        """Prior on a stage's relative scale error, stated or assumed."""
        return ASSUMED_SCALE_SIGMA if self.stage_scale_sigma is None else self.stage_scale_sigma


def nodes_of(target: AnyTarget) -> Float:
    """Nominal positions (n_a, n_b, 2) of the target's points, mm, origin at the centre, Z = 0.

    For a line grid the inner intersections: the outermost lines end at their crossings.
    """
    if isinstance(target, BoardLike):
        return target.points_mm()
    (n_a, n_b), pitch = target.lines, target.pitch_mm
    x = (np.arange(1, n_a - 1) - 0.5 * (n_a - 1)) * pitch
    y = (np.arange(1, n_b - 1) - 0.5 * (n_b - 1)) * pitch
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)


def inner_nodes_mm(target: TargetLike) -> Float:
    """Nominal positions of a line grid's inner intersections, see :func:`nodes_of`."""
    return nodes_of(target)


def pitch_scale_sigma(target: AnyTarget) -> float:
    """Relative standard deviation of the target's pitch; if it is not stated, the points' tolerance over its size.

    The tolerance is a bound, whose standard deviation is a root of three less.
    """
    stated = getattr(target, "pitch_scale_sigma", None)
    return target.node_tolerance_mm / float(np.sqrt(3.0)) / extent_mm(target) if stated is None else float(stated)


def least_count_sigma_mm(resolution_mm: float | None) -> float:
    """Standard deviation of a position that is read back to a least count; 0 if none is stated."""
    return 0.0 if resolution_mm is None else resolution_mm / float(np.sqrt(12.0))


def flatness_mm(target: AnyTarget) -> float:
    """Bound on the target's departure from a plane; if it is not stated, the bound on its points' positions."""
    flatness = getattr(target, "flatness_mm", None)
    return target.node_tolerance_mm if flatness is None else float(flatness)


def half_sides_mm(target: AnyTarget) -> tuple[float, float]:
    """Half of the field of points along X and Y."""
    x, y = np.abs(nodes_of(target)).max(axis=(0, 1))
    return float(x), float(y)


def extent_mm(target: AnyTarget) -> float:
    """Longer side of the field of points."""
    return 2.0 * max(half_sides_mm(target))


def is_held_out(dz_mm: float | None, options: CalibrationOptions, frame: int | None = None) -> bool:
    """Return True if a position or a free pose is among those left out of the fit."""
    if dz_mm is None:
        return frame in options.held_out_frames
    return any(abs(dz_mm - held) <= options.hold_out_tolerance_mm for held in options.held_out_mm)


def check_view(view: CalibrationView, target: AnyTarget, nominal: NominalValues) -> None:
    """Raise an error for a view whose numbers cannot be used.

    Raises
    ------
    CalibrationInputError
        ``view_shape``, ``view_not_finite``, ``view_outside_image``, ``view_incomplete``, ``view_degenerate``.
    """
    expected = nodes_of(target).shape
    if view.xy_px.shape != expected:
        raise CalibrationInputError(
            f"{view.label} has points of shape {view.xy_px.shape}, but the target has {expected}.",
            code="view_shape",
            remedy="Give the points of the target described.",
            view=view.label,
        )
    if (view.dz_mm is None) == (view.frame is None):
        raise CalibrationInputError(
            f"{view.label} needs either a stage position or the number of a free pose.",
            code="view_not_finite",
            remedy="Give one of them.",
            view=view.label,
        )
    if (
        (view.dz_mm is not None and not np.isfinite(view.dz_mm))
        or np.isinf(view.xy_px).any()
        or not _positive(view.sigma_px)
    ):
        raise CalibrationInputError(
            f"{view.label} holds a position, intersection or sigma that is not a finite number.",
            code="view_not_finite",
            remedy="Give finite numbers; mark a missing intersection by NaN in both coordinates.",
            view=view.label,
        )
    found = view.found
    # a board in a known pose of its own may be seen in part; a stage's view is one of few
    least = 6 if view.frame is not None else max(6, found.size // 4)
    if found.sum() < least:
        raise CalibrationInputError(
            f"{view.label} has {int(found.sum())} of {found.size} points.",
            code="view_incomplete",
            remedy="Show the whole target, clean and evenly lit.",
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
