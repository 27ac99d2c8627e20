"""The result over the grid of measurement points of one step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Floats
from stereorig.core.common.factor import Causes
from stereorig.core.field.points.patch import PatchChoice
from stereorig.core.field.points.smoothing_record import DenseRecord, Smoothing
from stereorig.core.field.points.starts import Starts
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.status import PointStatus


@dataclass(frozen=True, eq=False)
class References:
    """References that a step was matched against, if they include others than the first one.

    Attributes
    ----------
    step
        Number of the step whose images the step was matched against.
    steps
        (r, c) int32, the same for each point: it may be an older one for a point that was found again. For a point
        without numbers, the newest reference that shows it.
    noise_px2, pattern_px2
        (r, c, 2, 2) propagated covariance, px^2, of the points' positions in camera 1's image of this step: the part
        that the noise of this step's images does not cancel if later steps are matched against them, from the cameras'
        noise and from changes of the surface's pattern.
    added_share
        (r, c, 3, 3) B with L B L' the part of the covariance of U, V, W that references after the first one added, and
        L L' the whole, L a lower triangle; NaN without a point. None if it is not known: it is in no file.
    """

    step: int
    steps: NDArray[np.int32]
    noise_px2: Float
    pattern_px2: Float
    added_share: Float | None = None


@dataclass(frozen=True, eq=False)
class Rejected:
    """Numbers measured at (r, c) points that a check rejected; NaN elsewhere.

    Attributes
    ----------
    xyz_mm, uvw_mm
        (r, c, 3) position and, for a motion, displacement, system frame.
    zncc
        (r, c, k).
    epipolar_px
        (r, c).
    """

    xyz_mm: Float
    uvw_mm: Float | None
    zncc: Float
    epipolar_px: Float


class Unsure(NamedTuple):
    """Standard deviation of a field's usual match, px, and the largest that is allowed for it."""

    usual_px: float
    limit_px: float


@dataclass(frozen=True)
class Field:
    """Shape, and displacement if a motion was measured, at (r, c) points.

    A point whose status is neither ``OK`` nor ``EXTRAPOLATED`` has NaN in every number but ``x_px, y_px``.

    Attributes
    ----------
    x_px, y_px
        (r, c) positions of the points in camera 1's reference image.
    status
        (r, c) int8, :class:`stereorig.core.status.PointStatus`.
    xyz_mm
        (r, c, 3) surface point at the reference, system frame.
    normal_sys
        (r, c, 3) unit normal of the patch, system frame.
    theta_rad, phi_rad, zp_mm
        (r, c) the plane of Eq. (12), camera 1's frame.
    zncc
        (r, c, k) zero-mean normalised correlation; k = 1 for shape (camera 2's reference image), k = 3 for motion
        (camera 2's reference, camera 1's and camera 2's current image).
    epipolar_px
        (r, c) offset across the epipolar line in camera 2.
    iterations
        (r, c) int32.
    noise_grey
        (r, c) standard deviation of noise, grey levels of the reference image, estimated from the point's own
        residuals.
    covariance
        (r, c, 3, 3) of X, Y, Z, or (r, c, 6, 6) of X, Y, Z, U, V, W; mm^2, system frame: the points' own, of their
        matching.
    uvw_mm
        (r, c, 3) displacement since the reference, or None for a shape.
    rotation_rad
        (r, c, 3) rotation vector of the patch, system frame, or None.
    stretch
        (r, c, 3) in-plane stretch e11, e22, e12 in the patch's tangent frame, or None.
    curvature_per_mm
        (r, c, 2) principal curvatures of the reference's surface, the larger first, positive for a bulge towards the
        cameras; None unless the patches were curved.
    patch
        Patch that the field was measured with, and the reason; None in a field from an older file.
    patch_degree
        (r, c) int8: 1 for a plane patch, 2 for a quadratic one, 0 without a point; None if all have the field's patch.
    references
        References that the step was matched against; None if all points were matched against the first reference.
    smoothing
        Smoothing of the displacement; None: it is as measured.
    cuts
        Cracks and borders of holes, which no subset or neighbour crosses; None without any.
    common
        (r, c, 3 or 6, k) common factor F, mm for unit causes: the uncertainty that the points share, from the
        calibration. The whole covariance of points i and j is their matching's covariance plus F_i F_j'. None if the
        calibration's covariance is not known.
    causes
        Causes of its columns.
    frozen
        (r, c, 3, 3) part of the own covariance of U, V, W by noise of the reference pair, the same in all steps of a
        test; mm^2. The covariances of X, Y, Z, and of both with each other, are such noise as a whole. None if it is
        not known separately.
    rejected
        Numbers measured at rejected points; None unless they were asked for.
    dense
        Record of a dense field's measurement; None in an ordinary field.
    starts
        The matcher's own unknowns, (r, c, ...), from which the next step of a sequence starts; not part of a result
        file, None in a field that was read from one.
    failed_seeds_px
        (x, y) of the seeds that were given and did not match; the field was then measured from others.
    unsure
        The usual match's standard deviation and the limit if it is above it, else None; not part of a result file.
    """

    x_px: Float
    y_px: Float
    status: NDArray[np.int8]
    xyz_mm: Float
    normal_sys: Float
    theta_rad: Float
    phi_rad: Float
    zp_mm: Float
    zncc: Float
    epipolar_px: Float
    iterations: NDArray[np.int32]
    noise_grey: Float
    covariance: Float
    uvw_mm: Float | None = None
    rotation_rad: Float | None = None
    stretch: Float | None = None
    curvature_per_mm: Float | None = None
    patch: PatchChoice | None = None
    patch_degree: NDArray[np.int8] | None = None
    references: References | None = None
    smoothing: Smoothing | None = None
    cuts: Cuts | None = None
    common: Floats | None = None
    causes: Causes | None = None
    frozen: Float | None = None
    rejected: Rejected | None = None
    dense: DenseRecord | None = None
    starts: Starts | None = None
    failed_seeds_px: tuple[tuple[float, float], ...] = ()
    unsure: Unsure | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid of points."""
        return self.x_px.shape[0], self.x_px.shape[1]

    @property
    def has_motion(self) -> bool:
        """True if displacements were measured."""
        return self.uvw_mm is not None

    @property
    def valid(self) -> Bool:
        """(r, c) True where the point is valid."""
        return np.asarray((self.status == PointStatus.OK) | (self.status == PointStatus.EXTRAPOLATED))

    @property
    def total_covariance(self) -> Float:
        """(r, c, n, n) the points' own covariance plus the common part, if that is known."""
        if self.common is None:
            return self.covariance
        return np.asarray(self.covariance + self.common @ np.swapaxes(self.common, -1, -2))

    @property
    def knows_reference(self) -> bool:
        """True if the reference pair's part of the own covariance is known separately."""
        return not self.has_motion or self.frozen is not None

    @property
    def frozen_covariance(self) -> Float | None:
        """(r, c, n, n) the reference pair's part of the own covariance; None if it is not known separately."""
        if not self.has_motion:
            return self.covariance
        if self.frozen is None:
            return None
        out = self.covariance.copy()
        out[..., 3:, 3:] = self.frozen
        return out

    @property
    def reference_alone(self) -> Field | None:
        """The field with only the reference pair's noise in its covariance; None if that is not known separately."""
        frozen = self.frozen_covariance
        return None if frozen is None else replace(self, covariance=frozen, frozen=None, common=None, causes=None)

    @cached_property
    def common_variance(self) -> Floats | None:
        """(r, c, 3 or 6) variances of the common part; None if it is not known."""
        return None if self.common is None else np.einsum("...nk,...nk->...n", self.common, self.common)

    @cached_property
    def sigma_mm(self) -> Float:
        """(r, c, 3 or 6) standard deviations, the root of the total covariance's diagonal."""
        own = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        return np.sqrt(own if self.common_variance is None else own + self.common_variance)
