"""Strain on the surface: local fits over a virtual strain gauge, and the stretch patch's own strain."""

from typing import TYPE_CHECKING

from stereorig.core.lazy import names_of

if TYPE_CHECKING:
    from stereorig.core.strain.options import StrainOptions
    from stereorig.core.strain.result import STRAIN_STATUS_MEANINGS, StrainField, StrainStatus
    from stereorig.core.strain.surface import surface_strain

__all__ = ["STRAIN_STATUS_MEANINGS", "StrainField", "StrainOptions", "StrainStatus", "surface_strain"]

__getattr__, __dir__ = names_of(
    __name__,
    {
        "options": ("StrainOptions",),
        "result": ("STRAIN_STATUS_MEANINGS", "StrainField", "StrainStatus"),
        "surface": ("surface_strain",),
    },
)
