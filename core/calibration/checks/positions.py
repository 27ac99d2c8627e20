"""Check of the declared stage positions against the scale of the views.

The grid's image shrinks as 1 / (distance), so each view gives its own distance, up to one common factor. The reciprocal
of the image scale is a straight line over dZ, with the standoff as the ratio of intercept and slope; a localiser good
to thousandths of a pixel locates a view on that line to some micrometres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.inputs import CalibrationView, NominalValues
from stereorig.core.errors import CalibrationInputError

_UNITS = ((1e3, "micrometres for millimetres"), (25.4, "mils or inches for millimetres"), (10.0, "a factor of ten"))
_STRAIGHT, _NEARLY_STRAIGHT = 0.02, 0.1  # share of the travel that the positions may be off the line
_VISIBLE = 1e-4  # travel over standoff that image scales show with certainty


@dataclass(frozen=True)
class PositionCheck:
    """Positions seen in one camera's images against the declared ones.

    Attributes
    ----------
    declared_mm, seen_mm
        (v,) per view; the seen ones take the nominal standoff as their scale.
    standoff_mm
        Distance at dZ = 0 that the declared positions imply.
    residual_mm
        Root mean square residual of the straight line, in declared millimetres.
    """

    declared_mm: Float
    seen_mm: Float
    standoff_mm: float
    residual_mm: float


def image_scale(view: CalibrationView, nodes_mm: Float, aspect: float) -> tuple[float, float]:
    """Scale of the grid's image at the target's centre, px/mm, and its relative standard deviation.

    It is the root of the determinant of a homography there; its uncertainty follows from a fit of a scale to points
    with the homography's own residuals.
    """
    found = view.found
    XY, xy = nodes_mm[found], view.xy_px[found] / [1.0, aspect]
    origin, spread = xy.mean(axis=0), np.ptp(xy, axis=0).max()
    unit = np.abs(XY).max()
    (u, v), (x, y) = (XY / unit).T, ((xy - origin) / spread).T
    one, zero = np.ones_like(u), np.zeros_like(u)
    rows = np.concatenate(
        [
            np.stack([u, v, one, zero, zero, zero, -x * u, -x * v], axis=1),
            np.stack([zero, zero, zero, u, v, one, -y * u, -y * v], axis=1),
        ]
    )
    image = np.concatenate([x, y])
    h = np.linalg.lstsq(rows, image, rcond=None)[0]
    residual = np.sqrt(np.sum((rows @ h - image) ** 2) / max(len(image) - 8, 1))
    # derivative of (h0 u + h1 v + h2)/(h6 u + h7 v + 1) at the origin
    a, b = h[0] - h[2] * h[6], h[1] - h[2] * h[7]
    c, d = h[3] - h[5] * h[6], h[4] - h[5] * h[7]
    scale = float(np.sqrt(abs(a * d - b * c)) * spread / unit)
    return scale, float(residual / np.sqrt(np.sum(x**2 + y**2)))


def seen_distances(views: Sequence[CalibrationView], nodes_mm: Float, aspect: float) -> tuple[Float, float]:
    """Distance of each view in arbitrary but common units, (v,), and their relative standard deviation."""
    scale, relative = np.array([image_scale(v, nodes_mm, aspect) for v in views]).T
    return 1.0 / scale, float(np.sqrt(np.mean(relative**2)))


def focus_px(views: Sequence[CalibrationView]) -> tuple[Float, float]:
    """Point (2,) that the images of all points move towards as one camera travels, and its standard deviation, px.

    It is the principal point, if the camera travels along its optical axis. A lens's distortion moves it by little.
    """
    first = views[0]
    normals, moments = [], []
    for view in views[1:]:
        both = first.found & view.found
        start, way = first.xy_px[both], view.xy_px[both] - first.xy_px[both]
        normal = np.stack([-way[:, 1], way[:, 0]], axis=-1)
        normals.append(normal)
        moments.append(np.sum(normal * start, axis=-1))
    N, m = np.concatenate(normals), np.concatenate(moments)
    focus = np.linalg.lstsq(N, m, rcond=None)[0]
    variance = float(np.sum((N @ focus - m) ** 2)) / max(len(m) - 2, 1)
    return focus, float(np.sqrt(variance * np.linalg.norm(np.linalg.pinv(N.T @ N), 2)))


def check_positions(
    views: Sequence[CalibrationView], nodes_mm: Float, nominal: NominalValues, *, along_axis: bool = True
) -> PositionCheck:
    """Compare the declared positions of one camera's views with those seen in the images.

    Parameters
    ----------
    views
        One camera's views, by ascending position.
    nodes_mm
        (n_a, n_b, 2) nominal points.
    nominal
        The nominal camera.
    along_axis
        True if the camera moves along its optical axis. A stage in another direction turns the target's obliquity, and
        the reciprocal of the image's scale is then only near a straight line.

    Raises
    ------
    CalibrationInputError
        ``positions_sign_reversed``, ``positions_unit``, ``positions_permuted`` or ``position_wrong``.
    """
    camera = views[0].camera
    dz = np.array([v.position_mm for v in views])
    distance, relative_noise = seen_distances(views, nodes_mm, nominal.aspect)
    nominal_mm, _ = nominal.placed()
    bent = _STRAIGHT if along_axis else _NEARLY_STRAIGHT
    noise_mm = relative_noise * nominal_mm
    at_zero = distance[np.argmin(np.abs(dz))]
    seen = nominal_mm * (distance / at_zero - 1.0)
    seen += dz[np.argmin(np.abs(dz))]
    if np.ptp(dz) == 0.0:
        return PositionCheck(dz, seen, float("nan"), 0.0)
    slope, intercept = np.polyfit(dz, distance, 1)
    standoff = float(intercept / slope) if slope != 0.0 else float("inf")
    left = distance - (intercept + slope * dz)
    rms_mm = float(np.sqrt(np.mean(left**2)) / abs(slope)) if slope != 0.0 else float("inf")
    check = PositionCheck(dz, seen, standoff, rms_mm)
    shown = ", ".join(f"{d:+.3f} (seen {s:+.3f})" for d, s in zip(dz, seen, strict=True))
    context = {"camera": camera, "declared_mm": dz.tolist(), "seen_mm": seen.tolist()}

    visible = max(_VISIBLE * nominal_mm, 6.0 * noise_mm)
    if max(float(np.ptp(seen)), float(np.ptp(dz))) < visible:
        return check  # too little travel for this check; the predicted uncertainty decides if it is enough
    if float(np.ptp(seen)) < visible:
        raise CalibrationInputError(
            f"{camera}: the images show no travel beyond {visible:.2g} mm, but the positions declared are {shown} mm.",
            code="position_wrong",
            remedy="Check that the stage moves the camera and that the images are those of the positions named.",
            **context,
        )
    agreement = float(np.corrcoef(dz, distance)[0, 1])
    if agreement < -0.9:
        raise CalibrationInputError(
            f"{camera}: the grid's image grows where dZ grows, so the sign of the positions is reversed"
            f"{' or the two are exchanged' if len(views) == 2 else ''}: {shown} mm.",
            code="positions_sign_reversed",
            remedy="Give dZ positive away from the target, or set the stage's sign for this camera.",
            **context,
        )
    in_order = float(np.corrcoef(np.sort(dz), np.sort(distance))[0, 1])
    left_mm = float(np.sqrt(np.mean(left**2))) / at_zero * nominal_mm
    if standoff <= 0.0 or (rms_mm > bent * float(np.ptp(dz)) and left_mm > 4.0 * noise_mm):
        best = np.sort(dz)[np.argsort(np.argsort(distance))]
        moved = [v.label for v, a, b in zip(views, dz, best, strict=True) if a != b]
        if in_order > 0.999 and moved and in_order > agreement + 1e-3:
            raise CalibrationInputError(
                f"{camera}: the images' distances are not in the order of the positions declared, {shown} mm; "
                f"{', '.join(moved)} seem exchanged.",
                code="positions_permuted",
                remedy="Give each image its own position.",
                **context,
            )
        worst = int(np.argmax(np.abs(left)))
        raise CalibrationInputError(
            f"{camera}: the images' distances do not fit the positions declared, {shown} mm; the worst is "
            f"{views[worst].label}.",
            code="position_wrong",
            remedy="Check the position of the view named, and that nothing but the camera moved.",
            **context,
        )
    factor = standoff / nominal_mm
    if not 0.5 < factor < 2.0:
        suspected = next(
            (text for f, text in _UNITS if 0.6 < factor / f < 1.6 or 0.6 < factor * f < 1.6),
            f"a factor of {factor:.3g}",
        )
        raise CalibrationInputError(
            f"{camera}: the positions declared imply a standoff of {standoff:.4g} mm against the nominal "
            f"{nominal_mm:g} mm; suspected cause: {suspected}.",
            code="positions_unit",
            remedy="Give positions in millimetres, or correct the nominal standoff.",
            **context,
        )
    return check
