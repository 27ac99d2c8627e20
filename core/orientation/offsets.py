"""Offsets of one step's points across their epipolar lines, with the inputs of their judgement, each computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration import COVARIANCE_NAMES
from stereorig.core.calibration.uncertainty import image_derivatives
from stereorig.core.cameras.stereo import Rays, StereoPair
from stereorig.core.common.derivatives import pseudoinverse
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.orientation.change import ChangeSlopes, Ends
from stereorig.core.orientation.consequence import Consequences
from stereorig.core.orientation.matched import MatchedPoints, across_line
from stereorig.core.orientation.noise import SharedNoise, effective_variance, robust_weights


def calibration_slopes(
    pair: StereoPair, points: MatchedPoints, names: Sequence[str] = COVARIANCE_NAMES, rays: Rays | None = None
) -> Float:
    """Return d(epipolar offset, px) / d(both cameras' parameters by name), (n, len(names)), at matched points.

    The point that camera 1 sees stays on its pixel's ray; its image in camera 2 moves off the position that was
    measured. Motion along the line does not count. ``rays`` are the points' rays, if they are known.
    """
    rays = pair.rays(points.xy1_px, points.xy2_px) if rays is None else rays
    xyz = pair.triangulate_rays(*rays).xyz_mm
    across = across_line(pair, rays[0], points.xy2_px)
    A1, A2 = pair.cam1.point_jacobian(xyz), pair.cam2.point_jacobian(xyz)
    by_parameters = image_derivatives(pair, xyz, names)
    by_image1 = np.einsum("nj,njk->nk", across, A2 @ pseudoinverse(A1))
    return np.asarray(
        np.einsum("nj,njk->nk", by_image1, by_parameters[:, :2]) - np.einsum("nj,njk->nk", across, by_parameters[:, 2:])
    )


@dataclass(frozen=True, eq=False)
class SmoothOffsets:
    """Smooth part of offsets: coefficients (6,) over orthonormal terms of the image, and their covariance.

    A coefficient is the root mean square that its term contributes over the points. ``degrees`` is the number of
    degrees of freedom of the covariance's size.
    """

    terms: Float
    coefficients: Float
    covariance: Float
    projector: Float
    degrees: float


@dataclass(frozen=True, eq=False)
class StepOffsets:
    """Matched points of one step, for several judgements.

    Attributes
    ----------
    pair, points
        The calibrated cameras and the points.
    names
        The cameras' parameters in the order of their covariance.
    stated_px
        (n,) the points' offsets if they are not those of their positions.
    ends
        As in :class:`stereorig.core.orientation.change.ChangeSlopes`.
    """

    pair: StereoPair
    points: MatchedPoints
    names: Sequence[str] = COVARIANCE_NAMES
    stated_px: Float | None = None
    ends: Ends | None = None

    @cached_property
    def offset_px(self) -> Float:
        """(n,) the offsets."""
        return self.pair.epipolar_residual_of_rays(*self.rays) if self.stated_px is None else self.stated_px

    @cached_property
    def finite(self) -> StepOffsets:
        """The points that have an offset."""
        good = np.isfinite(self.offset_px)
        if good.all():
            return self
        return StepOffsets(self.pair, self.points.at(good), self.names, self.offset_px[good], self.ends)

    @cached_property
    def rays(self) -> Rays:
        """The points' rays in both cameras, in these cameras' own frames."""
        return self.pair.rays(self.points.xy1_px, self.points.xy2_px)

    @cached_property
    def terms(self) -> Float:
        """(n, 6) orthonormal terms of the image: the mean, slope and curvature."""
        terms = np.linalg.qr(smooth_terms(self.points.xy1_px))[0] * np.sqrt(len(self.points.xy1_px))
        return np.asarray(terms * np.sign(terms[0, 0]))

    @cached_property
    def shared(self) -> SharedNoise:
        """Noise that the points share."""
        return SharedNoise.of(self.points)

    @cached_property
    def smooth(self) -> SmoothOffsets:
        """The smooth part of the offsets."""
        return self.smooth_part(self.offset_px)

    def smooth_part(self, offset_px: Float) -> SmoothOffsets:
        """Fit the mean, slope and curvature of offsets (n,) robustly."""
        terms, weights = self.terms, np.ones(len(offset_px))
        for _ in range(4):
            normal = np.linalg.pinv((terms * weights[:, None]).T @ terms)
            projector = normal @ (terms * weights[:, None]).T
            coefficients = projector @ offset_px
            weights, _ = robust_weights(offset_px - terms @ coefficients)
        variance = effective_variance(terms, weights, offset_px, self.shared)
        # the variance is the terms' mean one; noise that neighbours share weighs on the mean more than on the curvature
        covariance = self.shared.metric(projector.T)
        covariance *= variance * np.trace(normal) / np.trace(covariance)
        degrees = self.shared.degrees(float(np.trace(self.shared.metric(terms))) / len(terms))
        return SmoothOffsets(terms, coefficients, covariance, projector, degrees)

    @cached_property
    def by_parameters(self) -> Float:
        """(n, p) :func:`calibration_slopes`."""
        return calibration_slopes(self.pair, self.points, self.names, self.rays)

    @cached_property
    def change_slopes(self) -> ChangeSlopes:
        """Derivatives of the points over a change of the cameras."""
        return ChangeSlopes(self.pair, self.rays, self.ends)

    @cached_property
    def consequences(self) -> Consequences | None:
        """Consequences of any change for the points; None with too few."""
        return Consequences.of(self.change_slopes)
