"""The layout of result files: versions, names, packed forms, and settings as they hold them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import FileFormatError
from stereorig.core.settings import StoredSettings

FORMAT_VERSION = 2
COMPARISONS = ("cam1_ref__cam2_ref", "cam1_ref__cam1_cur", "cam1_ref__cam2_cur")
COVARIANCE_NAMES = ("x_mm", "y_mm", "z_mm", "u_mm", "v_mm", "w_mm")
#: Propagated to steps that are matched against this one: name in variables and in `References` -> its cause
PROPAGATED_FROM = {"noise": "the cameras' noise", "pattern": "changes of the surface's pattern"}
#: Entries of a symmetric matrix that a file holds
ENTRIES = {"xx": (0, 0), "yy": (1, 1), "xy": (0, 1)}
#: meaning of the variable ``patch_degree``: only fields with both kinds have it
PATCH_DEGREE = "degree of the point's patch: 1 plane, 2 quadratic where strain is localised, 0 without a point"
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


#: names that 0.3.0 has no more; read as today's, a file with them would get defaults
_GONE = ("step_px", "roi")


def stored_settings(document: Mapping[str, Any]) -> StoredSettings:
    """Return the settings that an analysis was made with.

    Raises
    ------
    FileFormatError
        ``format_too_old``.
    """
    for name in _GONE:
        if name in document:
            raise FileFormatError(
                f"The settings have {name}: a program before version 0.3.0 wrote them.",
                code="format_too_old",
                remedy="Measure the images again, or read the results with the program that wrote them.",
            )
    return StoredSettings.model_validate(document)
