"""The layout of result files: the variables of a field and their units."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.field.points.result import Field

FORMAT_VERSION = 2
COMPARISONS = ("cam1_ref__cam2_ref", "cam1_ref__cam1_cur", "cam1_ref__cam2_cur")
COVARIANCE_NAMES = ("x_mm", "y_mm", "z_mm", "u_mm", "v_mm", "w_mm")
#: Propagated to steps that are matched against this one: name in variables and in `References` -> its cause
PROPAGATED_FROM = {"noise": "the cameras' noise", "pattern": "changes of the surface's pattern"}
#: Entries of a symmetric matrix that a file holds
ENTRIES = {"xx": (0, 0), "yy": (1, 1), "xy": (0, 1)}


class Variable(NamedTuple):
    """One two-dimensional variable: its attribute of a Field, and its description."""

    name: str
    attribute: str
    component: int | None
    units: str
    long_name: str
    dtype: str = "f8"


SHAPE = (
    Variable("x_px", "x_px", None, "pixel", "column of the point in camera 1's reference image"),
    Variable("y_px", "y_px", None, "pixel", "row of the point in camera 1's reference image"),
    Variable("x_mm", "xyz_mm", 0, "mm", "reference position of the material point, X_sys"),
    Variable("y_mm", "xyz_mm", 1, "mm", "reference position of the material point, Y_sys"),
    Variable("z_mm", "xyz_mm", 2, "mm", "reference position of the material point, Z_sys"),
    Variable("normal_x", "normal_sys", 0, "1", "surface normal, X_sys component"),
    Variable("normal_y", "normal_sys", 1, "1", "surface normal, Y_sys component"),
    Variable("normal_z", "normal_sys", 2, "1", "surface normal, Z_sys component"),
    Variable("theta_rad", "theta_rad", None, "rad", "angle of the patch's normal to X_cam1, Eq. (12)"),
    Variable("phi_rad", "phi_rad", None, "rad", "angle of the patch's normal to Y_cam1, Eq. (12)"),
    Variable("zp_mm", "zp_mm", None, "mm", "where camera 1's axis meets the patch's plane, Eq. (12)"),
    Variable(
        "epipolar_px",
        "epipolar_px",
        None,
        "pixel",
        "full offset across the epipolar line in camera 2; half of it is left in each image when both share it",
        "f4",
    ),
    Variable("noise_grey", "noise_grey", None, "count", "noise of the reference image, from the residuals", "f4"),
)
MOTION = (
    Variable("u_mm", "uvw_mm", 0, "mm", "displacement from the reference, X_sys component"),
    Variable("v_mm", "uvw_mm", 1, "mm", "displacement from the reference, Y_sys component"),
    Variable("w_mm", "uvw_mm", 2, "mm", "displacement from the reference, Z_sys component"),
    Variable("rotation_x_rad", "rotation_rad", 0, "rad", "rotation vector of the patch, X_sys component"),
    Variable("rotation_y_rad", "rotation_rad", 1, "rad", "rotation vector of the patch, Y_sys component"),
    Variable("rotation_z_rad", "rotation_rad", 2, "rad", "rotation vector of the patch, Z_sys component"),
    Variable("stretch_11", "stretch", 0, "1", "in-plane stretch of the patch, e11 in its tangent frame"),
    Variable("stretch_22", "stretch", 1, "1", "in-plane stretch of the patch, e22 in its tangent frame"),
    Variable("stretch_12", "stretch", 2, "1", "in-plane stretch of the patch, e12 in its tangent frame"),
)
CURVATURE = (
    Variable(
        "curvature_1",
        "curvature_per_mm",
        0,
        "mm-1",
        "larger principal curvature of the reference's surface, positive where it bulges towards the cameras",
    ),
    Variable(
        "curvature_2",
        "curvature_per_mm",
        1,
        "mm-1",
        "smaller principal curvature of the reference's surface, positive where it bulges towards the cameras",
    ),
)
#: how a common factor is packed
COLUMN_BY_COLUMN = {"compression": "zlib", "complevel": 1, "shuffle": True}
#: entries of the reference's part of the displacements' covariance, as they are packed
FROZEN = ("uu", "uv", "uw", "vv", "vw", "ww")


def packed(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the upper triangles (..., n (n + 1) / 2) of symmetric matrices (..., n, n), row by row."""
    i, j = np.triu_indices(covariance.shape[-1])
    return covariance[..., i, j]


def unpacked(triangles: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Return the symmetric matrices (..., n, n) of :func:`packed`."""
    i, j = np.triu_indices(n)
    out = np.empty((*triangles.shape[:-1], n, n))
    out[..., i, j] = out[..., j, i] = triangles
    return out


def field_variable(result: Field, name: str) -> tuple[NDArray[np.float64], str, str] | None:
    """Return values (r, c), unit and meaning of a variable as a result file would hold it; None for others."""
    for v in SHAPE + MOTION + CURVATURE:
        values = getattr(result, v.attribute) if v.name == name else None
        if values is not None:
            return values if v.component is None else values[..., v.component], v.units, v.long_name
    return None
