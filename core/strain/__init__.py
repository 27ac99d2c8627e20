"""Strain on the surface: local fits over a virtual strain gauge, and the stretch patch's own strain.

Plain data first, so that files can be read and written without loading more.
"""

from stereorig.core.strain.options import StrainOptions
from stereorig.core.strain.result import STRAIN_STATUS_MEANINGS, StrainField, StrainStatus
from stereorig.core.strain.surface import surface_strain

__all__ = ["STRAIN_STATUS_MEANINGS", "StrainField", "StrainOptions", "StrainStatus", "surface_strain"]
