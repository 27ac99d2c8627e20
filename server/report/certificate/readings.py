"""Readings of a certificate from one result file: rigid motion, scatter and strain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.certify.evidence import CheckedLength, ScatterEvidence
from stereorig.core.certify.measured import Measured, mean_strain_of, measured_of, motion_of
from stereorig.core.certify.noise_floor import independent_values
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.extensometer import Extensometer, extensometer
from stereorig.core.gauge.reading import Reading
from stereorig.core.gauge.rigid import RigidMotion, rigid_motion
from stereorig.core.strain.mean import mean_strain_variance
from stereorig.core.strain.result import StrainField
from stereorig.server.formats.results.reading import read_field, read_head
from stereorig.server.formats.results.strain import read_strain

_LENGTHS = ("u_mm", "v_mm", "w_mm")
_STRAINS = ("exx", "eyy", "exy")


@dataclass(frozen=True, eq=False)
class Readings:
    """One step, read.

    Attributes
    ----------
    n, path
        The step and its result file.
    field, strain, shared
        Content of the file.
    motion
        Its rigid motion; None of the reference's shape.
    """

    n: int
    path: Path
    field: Field
    strain: StrainField | None
    shared: SharedPixels
    motion: RigidMotion | None

    @property
    def moved(self) -> Measured:
        """(6,) small rotation and translation.

        Raises
        ------
        InputError
            ``certificate_step_unmeasured`` of a shape.
        """
        if self.motion is None:
            raise InputError(
                f"Step {self.n} has a shape and no displacement.",
                code="certificate_step_unmeasured",
                remedy="Measure displacements, and name other steps than the reference.",
            )
        return motion_of(self.motion, self.field.causes)

    @property
    def mean_strain(self) -> Measured | None:
        """(3,) means of exx, eyy, exy; None without strain."""
        strain = self.strain
        if strain is None or not strain.valid.any():
            return None
        inside = np.ones(self.field.shape, dtype=bool)
        variance = mean_strain_variance(self.field, strain.options, inside, subset_px=strain.subset_px)
        return mean_strain_of(strain.strain[strain.valid].mean(axis=0), variance)

    @property
    def scatter(self) -> dict[str, ScatterEvidence]:
        """Scatter of every quantity over the points, displacements about the rigid motion."""
        field, strain, found = self.field, self.strain, {}
        valid = field.valid
        left = self._left()
        for k, name in enumerate(_LENGTHS if left is not None and field.uvw_mm is not None else ()):
            assert left is not None
            assert field.uvw_mm is not None
            own = field.covariance[..., 3 + k, 3 + k][valid]
            mean = float(field.uvw_mm[..., k][valid].mean())
            found[name] = self._scatter(mean, left[..., k][valid], own, self.shared.subset_px)
        if strain is not None:
            good = strain.valid
            for k, name in enumerate(_STRAINS):
                values = strain.strain[..., k][good]
                if values.size > 1:
                    own = strain.covariance[..., k, k][good]
                    found[name] = self._scatter(float(values.mean()), values, own, strain.gauge_px)
        return found

    def _left(self) -> Float | None:
        """(r, c, 3) displacements without the rigid motion's, in the moved frame."""
        field, motion = self.field, self.motion
        if motion is None or field.uvw_mm is None:
            return None
        arm = field.xyz_mm - motion.centre_mm
        return np.asarray(arm + field.uvw_mm - motion.translation_mm - arm @ motion.rotation.T)

    def _scatter(self, mean: float, values: Float, variance: Float, width_px: float) -> ScatterEvidence:
        count = int(values.size)
        spacing = float(self.field.x_px[0, 1] - self.field.x_px[0, 0]) if self.field.shape[1] > 1 else width_px
        return ScatterEvidence(
            mean=mean,
            sd=float(values.std(ddof=1)),
            reported=float(np.sqrt(np.mean(variance))),
            points=count,
            independent=independent_values(count, spacing, max(width_px, spacing)),
        )

    def gauge(self, a_px: tuple[float, float], b_px: tuple[float, float]) -> Extensometer:
        """Read a virtual extensometer.

        Raises
        ------
        InputError
            ``certificate_gauge_missing`` where an end has no valid points.
        """
        found = extensometer(self.field, a_px, b_px, shared=self.shared)
        if found.missing:
            raise InputError(
                f"The length between {a_px} and {b_px} px has no value in step {self.n}: {found.missing}.",
                code="certificate_gauge_missing",
                remedy="Choose ends where the surface was measured.",
            )
        return found


def read_step(n: int, path: Path) -> Readings:
    """Read a step's result file.

    Raises
    ------
    MeasurementError
        ``too_few_points`` for a rigid motion.
    """
    field, head = read_field(path), read_head(path)
    shared = SharedPixels.of(field, float(head.settings["subset_px"]))
    motion = rigid_motion(field, shared=shared) if field.has_motion else None
    return Readings(n, path, field, read_strain(path), shared, motion)


def measured_reading(reading: Reading) -> Measured:
    """Return one number with the parts of its uncertainty."""
    budget = reading.budget
    reference = 0.0 if budget.reference is None else budget.reference**2
    own = (0.0 if budget.matching is None else budget.matching**2) + reference
    common = None if reading.common is None else np.asarray(reading.common)[None]
    return measured_of(np.array([reading.value]), np.array([[own]]), np.array([[reference]]), common, reading.causes)


def length_between(name: str, found: Reading, *, known_mm: float, sigma_mm: float, artefact: str) -> CheckedLength:
    """Return a known length with the reading of a virtual extensometer."""
    return CheckedLength(name, measured_reading(found), known_mm, sigma_mm, artefact)
