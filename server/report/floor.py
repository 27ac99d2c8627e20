"""Noise floor and bias of every quantity, from steps in which nothing moved."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField
from stereorig.server.report.items import UM, UM_PER_M

LENGTHS = ("U", "V", "W", "X", "Y", "Z")
STRAINS = ("exx", "eyy", "exy")
_STATIC = re.compile(r"\s*static\b", re.IGNORECASE)
_MAX_BYTES = 96 << 20


def static_steps(stated: Sequence[int] | None, labels: Mapping[int, str], reference: int) -> tuple[list[int], str]:
    """Return the static steps, and the source that names them.

    Parameters
    ----------
    stated
        The steps that the metadata name; None: they name none.
    labels
        By measured step.
    reference
        Not one of them: everything is measured against it.
    """
    if stated is not None:
        return sorted(n for n in set(stated) if n in labels and n != reference), "as stated (static_steps)"
    found = sorted(n for n, label in labels.items() if _STATIC.match(label) and n != reference)
    return found, "by their labels, which begin with the word static" if found else ""


@dataclass(frozen=True)
class Floor:
    """One quantity over the static steps; lengths in mm, strains as pure numbers. Unknown values are None.

    Attributes
    ----------
    bias
        Mean over points and steps; None for positions, whose true values are not known.
    bias_range
        Minimum and maximum mean of a step.
    temporal_sd
        Standard deviation from step to step, root mean square over the points; None with fewer than two steps.
    spatial_sd
        Standard deviation over the points of a step, root mean square over the steps; for positions, of a step's
        difference from the mean of the steps.
    points, steps
        Their numbers.
    """

    bias: float | None
    bias_range: tuple[float, float] | None
    temporal_sd: float | None
    spatial_sd: float | None
    points: int
    steps: int


@dataclass(frozen=True)
class Quantity:
    """The noise of a quantity: over the static steps, and as the points' covariances predict it."""

    name: str
    floor: Floor | None
    reported: float | None

    @property
    def is_position(self) -> bool:
        """True for a position, whose true value is not known."""
        return self.name in "XYZ"

    @property
    def factor(self) -> float:
        """Factor from a length in mm or a pure number to ``unit``."""
        return 1e6 if self.name in STRAINS else 1e3

    @property
    def unit(self) -> str:
        """Unit in which it reads well."""
        return UM_PER_M if self.name in STRAINS else UM


class FloorKeeper:
    """Takes static steps one by one; keeps as many as fit into its memory."""

    def __init__(self) -> None:
        self._kept: dict[str, list[NDArray[np.float32]]] = {}
        self._origin: Float | None = None
        self._bytes = 0
        self.steps: list[int] = []
        self.left_out: list[int] = []

    def add(self, n: int, field: Field, strain: StrainField | None) -> None:
        """Add a step."""
        if self._bytes > _MAX_BYTES:
            self.left_out.append(n)
            return
        self.steps.append(n)
        xyz = field.xyz_mm
        if field.uvw_mm is not None:
            for k, name in enumerate("UVW"):
                self._put(name, field.uvw_mm[..., k])
            xyz = xyz + field.uvw_mm
        if self._origin is None:
            self._origin = np.array(np.where(np.isfinite(xyz), xyz, 0.0))
        for k, name in enumerate("XYZ"):
            # single precision is enough for the differences
            self._put(name, xyz[..., k] - self._origin[..., k])
        if strain is not None:
            for k, name in enumerate(STRAINS):
                self._put(name, np.where(strain.valid, strain.strain[..., k], np.nan))

    def _put(self, name: str, values: Float) -> None:
        kept = values.astype(np.float32)
        self._bytes += kept.nbytes
        self._kept.setdefault(name, []).append(kept)

    def result(self) -> dict[str, Floor]:
        """Return the figures by quantity, empty without a static step."""
        found = {}
        for name, layers in self._kept.items():
            shapes = {layer.shape for layer in layers}
            if len(layers) != len(self.steps) or len(shapes) != 1:
                continue  # no strain in some of them, or other points
            stack = np.stack(layers).astype(np.float64).reshape(len(layers), -1)
            stack = stack[:, np.isfinite(stack).all(axis=0)]
            found[name] = _floor(stack, position=name in "XYZ")
        return found


def _floor(stack: Float, *, position: bool) -> Floor:
    steps, points = stack.shape
    temporal = spatial = bias = None
    ends: tuple[float, float] | None = None
    if points and steps >= 2:
        temporal = float(np.sqrt(np.mean(np.var(stack, axis=0, ddof=1))))
    if points >= 2 and (not position or steps >= 2):
        # the mean of the steps has a share of each step's noise
        deviations = (stack - stack.mean(axis=0)) * np.sqrt(steps / (steps - 1)) if position else stack
        spatial = float(np.sqrt(np.mean(np.var(deviations, axis=1, ddof=1))))
    if points and not position:
        means = stack.mean(axis=1)
        bias, ends = float(means.mean()), (float(means.min()), float(means.max()))
    return Floor(bias, ends, temporal, spatial, points, steps)


def reported_sigma(field: Field, strain: StrainField | None) -> dict[str, float | None]:
    """Return the median of the points' standard deviations in a step, by quantity."""
    sigma = field.sigma_mm
    names = ("X", "Y", "Z", "U", "V", "W")[: sigma.shape[-1]]
    reported: dict[str, float | None] = {name: _median(sigma[..., k][field.valid]) for k, name in enumerate(names)}
    if strain is not None:
        reported |= {name: _median(strain.sigma[..., k][strain.valid]) for k, name in enumerate(STRAINS)}
    return reported


def _median(values: NDArray[Any]) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None
