"""The variables that gauges read: from the field in its new frame if it has them, else from its result file."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Floats
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.strain.result import StrainField
from stereorig.server.base.errors import NotFoundError
from stereorig.server.formats.results.derived import DERIVED, MAGNITUDE, magnitude
from stereorig.server.formats.results.layout import COVARIANCE_NAMES
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.variables import along_axes, field_variable
from stereorig.server.results.reader import FileVariable, read_variable

if TYPE_CHECKING:
    from stereorig.core.strain.mean import MeanStrainVariance


@dataclass(frozen=True)
class OwnSigma:
    """One component's own standard deviation (r, c), the reference pair's part, its common factor (r, c, k)."""

    own: Float
    reference: Float | None
    common: Floats | None


class Variables:
    """Variables by name: from the field as it is now, else from the file as it was written.

    Parameters
    ----------
    measured
        The field as measured, in the frame that is read in.
    turned
        True if its axes are not the file's: components of strain are then computed again along them.
    """

    def __init__(
        self, path: Path, field: Field, shared: SharedPixels, *, measured: Field, turned: bool = False
    ) -> None:
        self.path, self.field, self.shared, self.measured, self._turned = path, field, shared, measured, turned
        self._read: dict[str, tuple[FileVariable, Float | None]] = {}

    def get(self, name: str) -> tuple[FileVariable, Float | None]:
        """Return values and standard deviations, (r, c) each; the latter None if they are not known."""
        if name not in self._read:
            self._read[name] = self._find(name)
        return self._read[name]

    @cached_property
    def strain(self) -> StrainField | None:
        """Strain along the axes that are read in; None where the file has none."""
        from stereorig.core.strain import surface_strain  # slow to load, and not every start needs it

        strain = read_strain(self.path)
        if strain is None or not self._turned or not self.measured.has_motion:
            return strain
        return surface_strain(self.measured, strain.options, subset_px=strain.subset_px)

    def mean_strain_variance(self, inside: NDArray[np.bool_]) -> MeanStrainVariance | None:
        """Return the uncertainty of the means of exx, eyy, exy over an area; None without strain."""
        from stereorig.core.strain.mean import mean_strain_variance  # slow to load, and not every start needs it

        strain = self.strain
        if strain is None:
            return None
        return mean_strain_variance(self.measured, strain.options, inside, subset_px=strain.subset_px)

    def own_sigma(self, name: str) -> OwnSigma | None:
        """Return a component's own standard deviations; None for others."""
        k = component_of(name)
        if k is None or k >= self.field.covariance.shape[-1]:
            return None
        frozen = self.field.frozen_covariance
        own, at_reference = (
            None if c is None else np.sqrt(np.maximum(c[..., k, k], 0.0)) for c in (self.field.covariance, frozen)
        )
        assert own is not None
        return OwnSigma(own, at_reference, None if self.field.common is None else self.field.common[..., k, :])

    def known(self, names: Sequence[str]) -> list[str]:
        """Return those that this step has: a shape has no displacement."""
        known = []
        for name in names:
            with contextlib.suppress(NotFoundError):
                self.get(name)
                known.append(name)
        return known

    def _find(self, name: str) -> tuple[FileVariable, Float | None]:
        sigma = self._sigma(name)
        if name.startswith("sigma_"):
            own = self._sigma(name.removeprefix("sigma_"))
            if own is not None:
                return FileVariable(own, "mm", f"standard deviation of {name[6:]}"), None
        of_field = field_variable(self.field, name)
        if of_field is not None:
            return FileVariable(*of_field), sigma
        if name in DERIVED and self.field.uvw_mm is not None:  # of the field as it is now, its rigid motion removed
            size, of_size = magnitude(self.field.uvw_mm, self.field.total_covariance[..., 3:, 3:])
            held = np.where(self.field.valid, size if name == MAGNITUDE else of_size, np.nan)
            return FileVariable(held, *DERIVED[name]), of_size if name == MAGNITUDE else None
        variable = read_variable(self.path, name)
        values = self._along_axes.get(name, variable.values)
        if values.shape != self.field.shape or not np.issubdtype(values.dtype, np.number):
            raise InputError(
                f"{name} of {self.path.name} is no scalar over the points.",
                code="field_not_scalar",
                remedy="Choose a variable with one number a point.",
            )
        held = np.where(self.field.valid, values.astype(np.float64), np.nan)
        return FileVariable(held, variable.units, variable.long_name), sigma

    @cached_property
    def _along_axes(self) -> dict[str, Float]:
        """Components of strain along the axes that are read in; empty where the file has them so."""
        made = self.strain if self._turned and self.measured.has_motion else None
        if made is None:
            return {}
        return along_axes(made)

    def _sigma(self, name: str) -> Float | None:
        k = component_of(name)
        if k is not None:
            return self.field.sigma_mm[..., k] if k < self.field.covariance.shape[-1] else None
        try:
            own = f"sigma_{name}"
            values = self._along_axes[own] if own in self._along_axes else read_variable(self.path, own).values
        except NotFoundError:
            return None
        return np.asarray(values, dtype=np.float64) if values.shape == self.field.shape else None


def component_of(name: str) -> int | None:
    """Return the index of a variable in the points' covariance; None for others."""
    return COVARIANCE_NAMES.index(name) if name in COVARIANCE_NAMES else None
