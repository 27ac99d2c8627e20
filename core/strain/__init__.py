"""Strain on the surface: local fits over a virtual strain gauge, and the stretch patch's own strain.

Plain data first, so that files can be read and written without loading more.
"""

from core.strain.options import StrainOptions
from core.strain.result import STRAIN_STATUS_MEANINGS, StrainField, StrainStatus
from core.strain.surface import surface_strain

__all__ = ["STRAIN_STATUS_MEANINGS", "StrainField", "StrainOptions", "StrainStatus", "surface_strain"]
