"""A systematic term of a field: its size by quantity, and how it was estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from stereorig.core.arrays import Float

_TRIMMED = 0.02  # single wrong points, and steps at cracks and edges
_MIN_POINTS = 16
_SURE = 2.0  # standard deviations


@dataclass(frozen=True)
class Figure:
    """Size of a term for one quantity.

    Attributes
    ----------
    rms, largest
        Root mean square over the points, less the noise of the estimate, and the largest; None if the noise hides it.
    below
        Upper limit of the root mean square, two standard deviations of the estimate above it.
    """

    rms: float | None
    largest: float | None
    below: float


@dataclass(frozen=True)
class Term:
    """A systematic term.

    Attributes
    ----------
    figures
        Figures by quantity with its unit (``match_px``, ``u_um``, ``exx_microstrain``); empty if they cannot be
        computed.
    text
        The method of the estimate, or the reason why it is missing.
    """

    text: str
    figures: Mapping[str, Figure] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {"text": self.text, "figures": {name: asdict(figure) for name, figure in self.figures.items()}}


def figure_of(values: Float, variances: Float, *, independent: float = 1.0) -> Figure | None:
    """Return the size of a term that was estimated at points with noise.

    Parameters
    ----------
    values
        (n,) estimates; those that are not finite do not count.
    variances
        (n,) of their noise.
    independent
        Share of the estimates whose noise is independent.

    Returns
    -------
    Figure or None
        None if too few are left.
    """
    known = np.isfinite(values) & np.isfinite(variances)
    if known.sum() < _MIN_POINTS:
        return None
    value, noise = values[known], np.maximum(variances[known], np.finfo(np.float64).tiny)
    order = np.argsort(value**2 / noise)[: known.sum() - int(np.ceil(_TRIMMED * known.sum()))]
    value, noise = value[order], noise[order]
    count = max(independent * len(value), 1.0)
    square = float(np.mean(value**2 - noise))
    # standard deviation of a mean of squares of noise; if the term itself is larger, its own spread is no error
    spread = _SURE * float(np.sqrt(2.0 * np.mean(noise**2) + 4.0 * np.mean(noise) * max(square, 0.0))) / np.sqrt(count)
    below = float(np.sqrt(max(square, 0.0) + spread))
    if square <= spread:
        return Figure(None, None, below)
    return Figure(float(np.sqrt(square)), float(np.abs(value).max()), below)
