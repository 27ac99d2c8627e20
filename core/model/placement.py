"""Rigid placement of a model in the system frame, with its uncertainty.

``x_sys = R x_model + t``. Errors are a small rotation about ``centre_mm`` (rad) and a shift (mm), both along the
system's axes: a point of the model that was placed at x is placed too far by ``omega x (x - centre) + shift``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, MeasurementError, RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of
from stereorig.core.gauge.align import Alignment, three_two_one
from stereorig.core.gauge.rigid import skew
from stereorig.core.gauge.sampling import sample
from stereorig.core.model.surface import ModelSurface

_ROUNDS = 60
_SETTLED_MM = 1e-7
# share of the best determined direction's sensitivity: a direction below it is not determined by the shape
_DETERMINED = 1e-3
_AXES = ("turn about X", "turn about Y", "turn about Z", "shift along X", "shift along Y", "shift along Z")


@dataclass(frozen=True, eq=False)
class Placement:
    """A placement of the model.

    Attributes
    ----------
    rotation, shift_mm
        R (3, 3) and t (3,).
    centre_mm
        (3,) about which errors turn, system frame.
    own
        (6, 6) covariance of the six errors from the points' own noise, and from the user's statement.
    common
        (6, k) their common factor, columns as the field's; None if the field has none.
    kind
        ``given``, ``3-2-1``, ``markers`` or ``best-fit``.
    points
        Number of measured points that it was fitted to; 0 for a given placement.
    residual_rms_mm
        Rms distance of these points.
    held
        Directions that the shape did not determine and that the start of a best fit did, in words.
    """

    rotation: Float
    shift_mm: Float
    centre_mm: Float
    own: Float
    common: Float | None
    kind: str
    points: int = 0
    residual_rms_mm: float = 0.0
    held: tuple[str, ...] = ()

    @property
    def covariance(self) -> Float:
        """(6, 6) with the common part."""
        return self.own if self.common is None else np.asarray(self.own + self.common @ self.common.T)

    def moved_by(self, points_mm: Float) -> Float:
        """Return (n, 3, 6): how far the six errors move placed points (n, 3)."""
        return _moves(points_mm, self.centre_mm)


def place_given(
    rotation: ArrayLike, origin_mm: ArrayLike, field: Field, *, sigma_rad: float = 0.0, sigma_mm: float = 0.0
) -> Placement:
    """Place a model whose axes are the rows of ``rotation`` and whose origin is ``origin_mm``, in the system frame.

    ``sigma_rad`` and ``sigma_mm`` are standard uncertainties of each turn and shift, about the measured points' middle.
    """
    R = np.asarray(rotation, dtype=np.float64).T
    centre = field.xyz_mm[field.valid].mean(axis=0) if field.valid.any() else np.zeros(3)
    own = np.diag([sigma_rad**2] * 3 + [sigma_mm**2] * 3)
    return Placement(R, np.asarray(origin_mm, dtype=np.float64), centre, own, _no_common(field), "given")


def place_in_frame(frame: Alignment, model_mm: ArrayLike | None) -> Placement:
    """Place a model by a frame that was laid through measured positions (3-2-1).

    Parameters
    ----------
    frame
        Through six measured positions.
    model_mm
        (6, 3) the same six positions on the model; None: the frame's axes are the model's own.

    Raises
    ------
    RegionError
        ``gauge_unusable`` if the model's positions span no frame.
    """
    R_model, origin = np.eye(3), np.zeros(3)
    if model_mm is not None:
        x = np.asarray(model_mm, dtype=np.float64)
        if x.shape != (6, 3) or not np.isfinite(x).all():
            raise RegionError(
                f"3-2-1 takes six positions of the model, got an array of shape {x.shape}.",
                code="gauge_unusable",
                remedy="Give X, Y, Z of the model for each of the six positions.",
            )
        R_model, origin = three_two_one(x)
    R = frame.rotation.T @ R_model
    turn = np.kron(np.eye(2), frame.rotation.T)  # the frame's errors are along its own axes
    own = turn @ frame.own_covariance @ turn.T
    common = None if frame.common is None else turn @ frame.common
    return Placement(R, frame.origin_mm - R @ origin, frame.origin_mm, own, common, "3-2-1", frame.points)


def place_by_markers(
    field: Field, positions_px: ArrayLike, model_mm: ArrayLike, *, shared: SharedPixels, sigma_mm: float = 0.0
) -> Placement:
    """Place a model by three or more of its points that are found in camera 1's reference image.

    Parameters
    ----------
    field
        Any field; its reference positions are used.
    positions_px
        (m, 2) in camera 1's reference image.
    model_mm
        (m, 3) the same points of the model.
    shared
        The correlation of neighbouring points.
    sigma_mm
        Standard uncertainty of each position along each axis in addition to the measurement's: of finding the marker in
        the image and on the model.

    Raises
    ------
    RegionError
        ``gauge_outside``; ``gauge_unusable`` for fewer than three markers or markers on one line.
    MeasurementError
        ``too_few_points`` if a marker has no valid point about it.
    """
    xy, x = np.asarray(positions_px, dtype=np.float64), np.asarray(model_mm, dtype=np.float64)
    if len(xy) < 3 or xy.shape != (len(xy), 2) or x.shape != (len(xy), 3):
        raise RegionError(
            f"{len(xy)} markers with {len(x)} points of the model place no model.",
            code="gauge_unusable",
            remedy="Give three or more markers that span an area, each with its point of the model.",
        )
    found = sample(field, xy)
    if not found.found.all():
        k = int(np.argmin(found.found))
        raise MeasurementError(
            f"Marker {k + 1} at ({xy[k, 0]:g}, {xy[k, 1]:g}) px has no measured point about it: {found.missing[k]}.",
            code="too_few_points",
            remedy="Choose markers where the shape was measured.",
        )
    at = found.of(field.xyz_mm)
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    if not spread[1] > 1e-6 * spread[0]:
        raise RegionError(
            "The markers lie on one line of the model.", code="gauge_unusable", remedy="Give markers that span an area."
        )
    m = len(xy)
    joint = found.position_covariance(shared) + sigma_mm**2 * np.eye(3 * m)
    weight = np.linalg.inv(joint + 1e-18 * np.eye(3 * m))
    R = Rotation.align_vectors(at - at.mean(axis=0), x - x.mean(axis=0))[0].as_matrix()
    centre = at.mean(axis=0)
    t = centre - R @ x.mean(axis=0)
    for _ in range(_ROUNDS):
        placed = x @ R.T + t
        A = _moves(placed, centre).reshape(3 * m, 6)
        gain = np.linalg.solve(A.T @ weight @ A, A.T @ weight)
        p = gain @ (at - placed).ravel()
        R, t = _turned(R, t, centre, p)
        if np.abs(p).max() < _SETTLED_MM:
            break
    common = None if found.common() is None else gain @ np.asarray(found.common())[:, :3].reshape(3 * m, -1)
    rms = float(np.sqrt(np.mean(np.sum((at - (x @ R.T + t)) ** 2, axis=1))))
    return Placement(R, t, centre, gain @ joint @ gain.T, common, "markers", m, rms)


def place_by_fit(field: Field, surface: ModelSurface, start: Placement, *, shared: SharedPixels) -> Placement:
    """Move a placed model onto the measured shape: least distances along its normals, weighed by their noise.

    Directions that the shape does not determine, as shifts along a plane, stay as in ``start`` and keep its
    uncertainty. Points beyond the model's border, or farther from it than three robust standard deviations of all, take
    no part.

    Parameters
    ----------
    field
        Any field; its reference positions are used.
    surface
        In the model's frame.
    start
        The placement to start from.
    shared
        The correlation of neighbouring points.

    Raises
    ------
    InputError
        ``model_no_overlap`` if fewer than ten points are over the model.
    """
    R, t = start.rotation, start.shift_mm
    rows, cols = np.nonzero(field.valid)
    x, cov = field.xyz_mm[rows, cols], field.covariance[rows, cols][:, :3, :3]
    centre = x.mean(axis=0)
    length = max(float(np.sqrt(np.mean(np.sum((x - centre) ** 2, axis=1)))), 1e-9)
    scale = np.array([length] * 3 + [1.0] * 3)
    known = np.eye(6)
    for _ in range(_ROUNDS):
        placed = surface.moved(R, t)
        feet = placed.feet(x)
        normal = placed.normals[feet.triangle]
        foot = np.einsum("nk,nka->na", feet.weight, placed.corners_mm[feet.triangle])
        r = np.einsum("na,na->n", x - foot, normal)
        inside = feet.beyond_mm <= 1e-9 * length
        if inside.sum() < 10:
            raise no_overlap(field, surface, int(inside.sum()))
        away = np.abs(r - np.median(r[inside]))
        used = inside & (away <= 3.0 * 1.4826 * np.median(away[inside]) + 1e-9)
        weight = np.where(used, 1.0 / np.maximum(np.einsum("na,nab,nb->n", normal, cov, normal), 1e-18), 0.0)
        A = np.einsum("na,nak->nk", normal, _moves(x, centre)) / scale
        H = (A.T * weight) @ A
        value, vector = np.linalg.eigh(H)
        known = vector[:, value > _DETERMINED * value[-1]]
        gain = known @ np.linalg.solve(known.T @ H @ known, known.T @ (A.T * weight))
        p = (gain @ r) / scale
        R, t = _turned(R, t, centre, p)
        if np.abs(p * scale).max() < _SETTLED_MM:
            break
    each = np.zeros((*field.shape, 6, 3))
    each[rows, cols] = np.swapaxes((gain / scale[:, None])[:, :, None] * normal[None], 0, 1)
    roots = roots_of(np.where(field.valid[..., None, None], field.covariance[..., :3, :3], 0.0))
    noise = each @ roots
    own = np.einsum("rcij,rckj->ik", noise, shared.positions.summed(field, noise))
    # about the same centre, and from the start only the directions that the shape leaves open
    open_ = np.eye(6) - known @ known.T
    kept = (open_ * scale) @ _about(start.centre_mm, centre) / scale[:, None]
    own = 0.5 * (own + own.T) + kept @ start.own @ kept.T
    common = None
    if field.common is not None:
        held = np.where(field.valid[..., None, None], field.common[..., :3, :], 0.0)
        common = np.einsum("rcij,rcjk->ik", each, held)
        if start.common is not None:
            common = common + kept @ start.common
    names = tuple(name for name, share in zip(_AXES, np.diag(open_), strict=True) if share > 0.5)
    rms = float(np.sqrt(np.mean(r[used] ** 2)))
    return Placement(R, t, centre, own, common, "best-fit", int(used.sum()), rms, names)


def no_overlap(field: Field, surface: ModelSurface, over: int) -> InputError:
    """Return the error for a model outside the measured field."""
    x = field.xyz_mm[field.valid]
    size = float(np.linalg.norm(np.ptp(x, axis=0))) if len(x) else 0.0
    return InputError(
        f"{over} of the {len(x)} measured points lie over the model: it is {surface.size_mm:.4g} mm across, the "
        f"measured field {size:.4g} mm.",
        code="model_no_overlap",
        remedy="Check the model's unit of length and how it is aligned: by 3-2-1 or markers where the frames differ.",
    )


def _moves(points: Float, centre: Float) -> Float:
    out = np.zeros((*points.shape[:-1], 3, 6))
    out[..., :3] = -skew(points - centre)
    out[..., range(3), range(3, 6)] = 1.0
    return out


def _turned(R: Float, t: Float, centre: Float, p: Float) -> tuple[Float, Float]:
    turn = Rotation.from_rotvec(p[:3]).as_matrix()
    return turn @ R, turn @ (t - centre) + centre + p[3:]


def _about(old: Float, new: Float) -> Float:
    """(6, 6): errors about one centre as errors about another."""
    out = np.eye(6)
    out[3:, :3] = -skew((new - old)[None])[0]
    return out


def _no_common(field: Field) -> Float | None:
    return None if field.common is None else np.zeros((6, field.common.shape[-1]))
