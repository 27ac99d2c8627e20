"""Variables computed from a result file's variables and read as if it held them: the size of the displacement."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.server.formats.results.layout import COVARIANCE_NAMES, unpacked
from stereorig.server.formats.results.variables import SIGMA, SIZE, described

MAGNITUDE = SIZE.name
_UVW = ("u_mm", "v_mm", "w_mm")
# name -> unit, meaning
DERIVED = {name: (SIZE.units, described(name).long_name) for name in (MAGNITUDE, SIGMA + MAGNITUDE)}


def derived_names(held: Any) -> list[str]:
    """Return the names that can be derived from the variables of an open file, or of a step; those it holds are not."""
    known = [*_UVW, "covariance"]
    return [name for name in DERIVED if name not in held] if all(name in held for name in known) else []


def magnitude(
    uvw_mm: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the size of displacements and its standard deviation.

    Parameters
    ----------
    uvw_mm
        (..., 3) displacements, mm.
    covariance
        (..., 3, 3) their covariances, mm^2.

    Returns
    -------
    size_mm, sigma_mm
        (...) mm. The direction of a vector of no length is not known: its standard deviation is NaN.
    """
    size = np.linalg.norm(uvw_mm, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = uvw_mm / size[..., None]
        variance = np.einsum("...i,...ij,...j->...", along, covariance, along)
        return size, np.sqrt(np.maximum(variance, 0.0))


def derive(held: Any, name: str) -> NDArray[np.float32]:
    """Return (r, c) values of a derived variable; the open file must hold the variables that it is computed from."""
    uvw = np.stack([np.asarray(held[one][...], dtype=np.float64) for one in _UVW], axis=-1)
    covariance = np.asarray(held["covariance"][...], dtype=np.float64)
    if covariance.ndim == uvw.ndim:
        covariance = unpacked(covariance, len(COVARIANCE_NAMES))
    size, sigma = magnitude(uvw, covariance[..., 3:, 3:])
    return (size if name == MAGNITUDE else sigma).astype(np.float32)
