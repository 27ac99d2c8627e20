"""Record of a dense field: the measurement of its vectors, and the error that neighbours share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

METHOD = "dense, shared windows"
"""Name of the method in files, documents and on the page."""

NEIGHBOURS = (
    "each vector is measured over the whole window about it; windows of neighbours overlap, and errors of two vectors "
    "dx, dy px apart correlate by the share of common pixels, (1 - |dx| / window) (1 - |dy| / window)"
)


@dataclass(frozen=True, kw_only=True)
class DenseRecord:
    """Record of a dense field's measurement.

    Attributes
    ----------
    step_px
        Distance of its vectors.
    window_px
        Width of the window that each is measured over: the ordinary field's subset.
    spacing_px
        Distance of the ordinary field's points, which made the prediction.
    variance_ratio
        Median of the ordinary field's variance over the variance from the vectors' own normal equations, (grey
        levels)^2: image noise and all errors that the ordinary field's tests found in addition. None if no vector has
        one.
    """

    step_px: int
    window_px: int
    spacing_px: float
    variance_ratio: float | None

    def document(self) -> dict[str, Any]:
        """Return the record as plain values."""
        return asdict(self)

    @staticmethod
    def from_document(document: Mapping[str, Any]) -> DenseRecord:
        """Return the record from :meth:`document`; unknown entries are left out."""
        known = {f.name for f in fields(DenseRecord)}
        return DenseRecord(**{name: value for name, value in document.items() if name in known})
