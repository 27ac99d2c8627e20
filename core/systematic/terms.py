"""All systematic terms of a field together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.matching.image import ImageData
from stereorig.core.strain.result import StrainField
from stereorig.core.systematic.interpolation import SmoothSlopes, interpolation_term
from stereorig.core.systematic.patch_order import patch_term
from stereorig.core.systematic.strain_window import window_term
from stereorig.core.systematic.term import Term


@dataclass(frozen=True)
class Systematic:
    """Systematic terms of a field, none of them in its standard uncertainties.

    Attributes
    ----------
    interpolation
        Bias of interpolation between the pixels of sharp texture.
    patch_order
        Bias of the patches on a surface or displacement of higher order.
    strain_window
        Bias of the strain's window; None for a field without strain.
    """

    interpolation: Term
    patch_order: Term
    strain_window: Term | None = None

    def document(self) -> dict[str, Any]:
        """Return them as plain values."""
        terms = {
            "interpolation": self.interpolation,
            "patch_order": self.patch_order,
            "strain_window": self.strain_window,
        }
        return {name: None if term is None else term.document() for name, term in terms.items()}


def terms_of(
    field: Field, pair: StereoPair, reference: SmoothSlopes, others: Sequence[ImageData], *, subset_px: int
) -> Systematic:
    """Estimate the systematic terms of a field as it was measured; parameters as of :func:`interpolation_term`."""
    return Systematic(
        interpolation_term(field, pair, reference, others, subset_px=subset_px),
        patch_term(field, pair, subset_px=subset_px),
    )


def with_strain(terms: Systematic, field: Field, strain: StrainField | None, *, subset_px: int) -> Systematic:
    """Return the terms with the strain's term, computed from ``field``."""
    if strain is None:
        return terms
    return replace(terms, strain_window=window_term(field, strain, subset_px=subset_px))
