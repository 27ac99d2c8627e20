"""Strain as a step after a displacement: its settings as files and requests hold them, and its summary."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.points.result import Field
from stereorig.core.field.points.smoothing_record import Smoothing
from stereorig.core.field.smoothed import smoothed_displacement
from stereorig.core.robust import median
from stereorig.core.settings import StrainOrder
from stereorig.core.strain import StrainField, StrainOptions, StrainStatus, surface_strain
from stereorig.server.formats.results.budgets import spread_points, strain_budgets

_NAMES = ("exx", "eyy", "exy")


def smoothed_step(field: Field, window: int | None, *, subset_px: float) -> Field:
    """Return a step's field with its displacement smoothed; unchanged without a window, or for a shape."""
    if not window or not field.has_motion:
        return field
    return smoothed_displacement(field, window, subset_px=subset_px)


def smoothing_note(smoothing: Smoothing, gauge_px: float | None, *, strain_window: int | None) -> str:
    """Return a text that states the spatial resolution of a smoothed displacement, and of strain from it."""
    mm = "" if smoothing.resolution_mm is None else f" ({smoothing.resolution_mm:.3g} mm)"
    text = (
        f"displacements are smoothed over {smoothing.window} points: their spatial resolution is "
        f"{smoothing.resolution_px:g} px{mm}, {smoothing.subset_px:g} px without smoothing"
    )
    if gauge_px is None or strain_window is None:
        return text
    plain = (strain_window - 1) * smoothing.spacing_px + smoothing.subset_px
    return f"{text}; the strain gauge grows from {plain:g} to {gauge_px:g} px"


def strain_of_step(field: Field, options: StrainOptions | None, *, subset_px: int) -> StrainField | None:
    """Strain of a step; None without options, or for the reference."""
    if options is None or not field.has_motion:
        return None
    return surface_strain(field, options, subset_px=subset_px)


@dataclass(frozen=True)
class PatchStrain:
    """Strain of the patches themselves, and its difference from that over the window; microstrain by component."""

    mean_microstrain: dict[str, float | None]
    difference_mean_microstrain: dict[str, float | None]
    difference_sd_microstrain: dict[str, float | None]


@dataclass(frozen=True)
class StrainSummary:
    """One step's strain in a few numbers; unknown values are None.

    Attributes
    ----------
    window, order, tensor
        Its options.
    gauge_px, gauge_mm
        Width of the strain gauge; of smoothed displacements with the smoothing's window.
    points, status
        Number of points with strain, and the counts by state.
    mean_microstrain, sd_microstrain
        Over the field, of exx, eyy, exy.
    noise_floor_microstrain
        Median of the standard deviation that the points' covariances predict.
    budget_median_microstrain
        By component, the medians of its parts, as `budget_median_mm` has them.
    patch
        Strain of the patches themselves.
    """

    window: int
    order: StrainOrder
    tensor: str
    gauge_px: float
    gauge_mm: float | None
    points: int
    status: dict[str, int]
    mean_microstrain: dict[str, float | None]
    sd_microstrain: dict[str, float | None]
    noise_floor_microstrain: dict[str, float | None]
    budget_median_microstrain: dict[str, dict[str, float]]
    patch: PatchStrain | None

    def document(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self)


def summarise_strain(strain: StrainField, field: Field) -> StrainSummary:
    """Summarise one step's strain, and the field that it was made of."""
    valid, patch = strain.valid, None
    budgets = strain_budgets(field, strain, spread_points(valid))
    if strain.patch is not None:
        both = valid & np.isfinite(strain.patch).all(axis=-1)
        difference = strain.patch[both] - strain.strain[both]
        patch = PatchStrain(
            mean_microstrain=_figures(strain.patch[both], np.mean),
            difference_mean_microstrain=_figures(difference, np.mean),
            difference_sd_microstrain=_figures(difference, np.std),
        )
    return StrainSummary(
        window=strain.options.window,
        order=strain.options.order,
        tensor=strain.options.tensor,
        gauge_px=strain.gauge_px,
        gauge_mm=strain.gauge_mm if np.isfinite(strain.gauge_mm) else None,
        points=int(valid.sum()),
        status={s.name.lower(): int((strain.status == s).sum()) for s in StrainStatus if (strain.status == s).any()},
        mean_microstrain=_figures(strain.strain[valid], np.mean),
        sd_microstrain=_figures(strain.strain[valid], np.std),
        noise_floor_microstrain=_figures(strain.sigma[valid], median),
        budget_median_microstrain={
            name: {part: 1e6 * value for part, value in one.median.items()} for name, one in budgets.items()
        },
        patch=patch,
    )


def _figures(values: NDArray[np.float64], figure: Any) -> dict[str, float | None]:
    return {name: float(1e6 * figure(values[:, k])) if len(values) else None for k, name in enumerate(_NAMES)}
