"""Strain as a step after a displacement: its settings as files and requests hold them, and its summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.field.result import Field
from core.strain import StrainField, StrainOptions, StrainStatus, surface_strain

_NAMES = ("exx", "eyy", "exy")


def strain_settings(options: StrainOptions | None) -> dict[str, Any] | None:
    """Return the options as settings; None: no strain."""
    if options is None:
        return None
    return {"window": options.window, "order": options.order, "tensor": options.tensor}


def strain_options(settings: Mapping[str, Any] | None) -> StrainOptions | None:
    """Return the options that :func:`strain_settings` wrote, or a request's."""
    return None if settings is None else StrainOptions(**settings)


def strain_of_step(field: Field, options: StrainOptions | None, *, subset_px: int) -> StrainField | None:
    """Strain of a step; None where it was not asked for, or the step is the reference."""
    if options is None or not field.has_motion:
        return None
    return surface_strain(field, options, subset_px=subset_px)


def summarise_strain(strain: StrainField) -> dict[str, Any]:
    """Summarise one step's strain.

    Returns
    -------
    dict
        Options, ``gauge_px``, ``gauge_mm``, ``points`` with strain and ``status`` (counts), and in microstrain of
        exx, eyy, exy: ``mean_microstrain``, ``sd_microstrain`` over the field, ``noise_floor_microstrain`` (median of
        the standard deviation that the points' covariances predict); of the patches' own strain ``patch``: its mean,
        and mean and sd of what it differs by. What cannot be told is None.
    """
    valid = strain.valid
    summary: dict[str, Any] = {
        **(strain_settings(strain.options) or {}),
        "gauge_px": strain.gauge_px,
        "gauge_mm": strain.gauge_mm if np.isfinite(strain.gauge_mm) else None,
        "points": int(valid.sum()),
        "status": {s.name.lower(): int((strain.status == s).sum()) for s in StrainStatus if (strain.status == s).any()},
        "mean_microstrain": _figures(strain.strain[valid], np.mean),
        "sd_microstrain": _figures(strain.strain[valid], np.std),
        "noise_floor_microstrain": _figures(strain.sigma[valid], np.median),
        "patch": None,
    }
    if strain.patch is not None:
        both = valid & np.isfinite(strain.patch).all(axis=-1)
        apart = strain.patch[both] - strain.strain[both]
        summary["patch"] = {
            "mean_microstrain": _figures(strain.patch[both], np.mean),
            "difference_mean_microstrain": _figures(apart, np.mean),
            "difference_sd_microstrain": _figures(apart, np.std),
        }
    return summary


def _figures(values: NDArray[np.float64], figure: Any) -> dict[str, float | None]:
    return {name: float(1e6 * figure(values[:, k])) if len(values) else None for k, name in enumerate(_NAMES)}
