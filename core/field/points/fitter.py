"""The matcher bound to its images, with the checks of single points."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.scales import far_from_start, plausible
from stereorig.core.field.region.visibility import Visibility
from stereorig.core.matching.arguments import VisiblePixels, WarpedImages
from stereorig.core.matching.fit import fit_motion, fit_shape
from stereorig.core.matching.image import ImageData
from stereorig.core.matching.options import MatchOptions
from stereorig.core.status import PointStatus

MAX_EPIPOLAR_PX = 3.0
_RATE_FROM, _RATE_QUANTILE = 30, 0.9
_KEPT = ("w", "G", "epipolar_px", "zncc")
#: of a point that is measured again: nothing of what was rejected before
NOT_KEPT: dict[str, Any] = dict.fromkeys(f"rejected_{name.lower()}" for name in _KEPT)


@dataclass(eq=False)
class PointFits:
    """Unknowns and figures at n points, writable; numbers are NaN where ``status`` is not OK.

    Attributes
    ----------
    w, G
        (n, 3), (n, 3, 3), or (n, 6), (n, 3, 6) of curved patches; G of NaN for a shape.
    zncc
        (n, k) with k = 1 (shape) or 3 (motion).
    epipolar_px, epipolar_sigma_px, noise
        (n,).
    covariance
        (n, 2, 2) or (n, 5, 5), as the matching gives it.
    iterations
        (n,) int32.
    status
        (n,) int8.
    rate
        (n,) convergence rate of a motion, as the matching gives it.
    rejected_w, rejected_g, rejected_epipolar_px, rejected_zncc
        The same numbers at the moment a check rejected the point, NaN for other points; None: not kept.
    """

    w: Float
    G: Float
    zncc: Float
    epipolar_px: Float
    epipolar_sigma_px: Float
    noise: Float
    covariance: Float
    iterations: NDArray[np.int32]
    status: NDArray[np.int8]
    rate: Float
    rejected_w: Float | None = None
    rejected_g: Float | None = None
    rejected_epipolar_px: Float | None = None
    rejected_zncc: Float | None = None

    def keep_rejected(self) -> PointFits:
        """Keep the numbers of points that are rejected from now on; returns itself."""
        for name in _KEPT:
            setattr(self, f"rejected_{name.lower()}", np.full(getattr(self, name).shape, np.nan))
        return self

    @staticmethod
    def empty(n: int, comparisons: int, terms: int = 3) -> PointFits:
        """Return n points not yet reached; ``terms`` is 6 for curved patches."""
        q = 2 if comparisons == 1 else 5
        return PointFits(
            w=np.full((n, terms), np.nan),
            G=np.full((n, 3, terms), np.nan),
            zncc=np.full((n, comparisons), np.nan),
            epipolar_px=np.full(n, np.nan),
            epipolar_sigma_px=np.full(n, np.nan),
            noise=np.full(n, np.nan),
            covariance=np.full((n, q, q), np.nan),
            iterations=np.zeros(n, np.int32),
            status=np.full(n, PointStatus.NOT_SEEDED, np.int8),
            rate=np.full(n, np.nan),
        )

    @property
    def ok(self) -> Bool:
        """(n,) True where a point has numbers."""
        return np.asarray(self.status == PointStatus.OK)

    @property
    def quality(self) -> Float:
        """(n,) the worst comparison's correlation, -1 for points without one."""
        return np.where(self.ok, np.nan_to_num(self.worst_zncc, nan=-1.0), -1.0)

    @property
    def worst_zncc(self) -> Float:
        """(n,) the worst comparison's correlation, NaN if one is not known."""
        # along columns: along rows of three numbers it takes twenty times as long
        return np.asarray(np.ascontiguousarray(self.zncc.T).min(axis=0))

    @property
    def plane(self) -> Bool:
        """(n,) True where the patch is plane: without second-order terms, or all of them exactly zero."""
        return np.asarray((self.w[:, 3:] == 0.0).all(axis=1) & (self.G[:, :, 3:] == 0.0).all(axis=(1, 2)))

    def put(self, index: NDArray[np.intp], other: PointFits) -> None:
        """Write ``other``'s points to indices ``index``; numbers kept of rejected points stay until these are ok."""
        for f in fields(self):
            if not f.name.startswith("rejected_"):
                getattr(self, f.name)[index] = getattr(other, f.name)
        if self.rejected_w is None:
            return
        for name in _KEPT:
            mine, theirs = getattr(self, f"rejected_{name.lower()}"), getattr(other, f"rejected_{name.lower()}")
            mine[index[other.ok]] = np.nan
            if theirs is not None:
                there = np.isfinite(other.rejected_epipolar_px)  # type: ignore[arg-type]
                mine[index[there]] = theirs[there]

    def put_plane(self, index: NDArray[np.intp], other: PointFits) -> None:
        """Write ``other``'s points, of plane patches, to the same indices here; their second-order terms are zero."""
        for f in fields(self):
            mine, theirs = getattr(self, f.name), getattr(other, f.name)
            if mine is not None and theirs is not None:
                if mine.shape != theirs.shape:
                    mine[index] = 0.0
                    mine = mine[..., : theirs.shape[-1]]
                mine[index] = theirs[index]

    def take(self, index: NDArray[np.intp]) -> PointFits:
        """Return a copy of the points ``index``."""
        arrays: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        part: dict[str, Any] = {name: None if a is None else a[index] for name, a in arrays.items()}
        return PointFits(**part)

    def reject(self, which: Bool, status: PointStatus) -> None:
        """Reject points: their numbers become NaN, their status the reason."""
        self.status[which] = status
        if self.rejected_w is not None:
            known = np.asarray(which) & np.isfinite(self.epipolar_px)
            for name in _KEPT:
                getattr(self, f"rejected_{name.lower()}")[known] = getattr(self, name)[known]
        for name in ("w", "G", "epipolar_px", "epipolar_sigma_px", "covariance"):
            getattr(self, name)[which] = np.nan


class FitsPoints(Protocol):
    """The matcher as growth uses it; :class:`Fitter` is one."""

    @property
    def comparisons(self) -> int:
        """1 for a shape, 3 for a motion."""

    @property
    def terms(self) -> int:
        """Numbers in a point's ``w``."""

    def fit(self, xy_px: Float, w: Float, G: Float | None) -> PointFits:
        """Refine points from start values."""

    def far_from_start(self, xy_px: Float, fits: PointFits, w: Float, G: Float | None, limit_px: float) -> Bool:
        """Return (n,) True where a fit ended far from its start."""


@dataclass(frozen=True, eq=False)
class Fitter:
    """Four prepared images (two for a shape), a calibrated pair, options: fits batches of points.

    Attributes
    ----------
    min_zncc
        Correlation below which no comparison counts as a match.
    keep_rejected
        Keep the numbers of points that a check rejects.
    visibility
        The points' visibility; None: all of every subset.
    """

    pair: StereoPair
    ref1: ImageData
    ref2: ImageData
    cur1: ImageData | None
    cur2: ImageData | None
    options: MatchOptions
    min_zncc: float
    visibility: Visibility | None = None
    keep_rejected: bool = False

    @property
    def comparisons(self) -> int:
        """1 for a shape, 3 for a motion."""
        return 1 if self.cur1 is None else 3

    @property
    def terms(self) -> int:
        """Numbers in a point's ``w`` and in each row of its ``G``: 3 for a plane patch, 6 for a curved one."""
        return 6 if self.options.patch == "quadratic" else 3

    def empty(self, n: int) -> PointFits:
        """Return n points not yet reached."""
        points = PointFits.empty(n, self.comparisons, self.terms)
        return points.keep_rejected() if self.keep_rejected else points

    def shape_only(self) -> Fitter:
        """Return the fitter of the reference's shape."""
        return replace(self, cur1=None, cur2=None)

    def curved(self) -> Fitter:
        """Return the same matcher with curved patches."""
        return replace(self, options=replace(self.options, patch="quadratic"))

    def by_patch(self, points: PointFits, index: NDArray[np.intp]) -> list[tuple[Fitter, NDArray[np.intp]]]:
        """Return the matchers that measured the points ``index`` (m,), each with its points' places in ``index``."""
        plane = points.plane[index] if self.terms == 6 and self.comparisons == 3 else np.zeros(len(index), bool)
        if not plane.any():
            return [(self, np.arange(len(index)))]
        flat = replace(self, options=replace(self.options, patch="affine"))
        return [(flat, np.flatnonzero(plane)), (self, np.flatnonzero(~plane))]

    def converging(self, rate: Float) -> Fitter:
        """Return the same matcher for points that converge as a sample (m,) of them did, see :func:`learned_rate`."""
        return replace(self, options=replace(self.options, first_rate=learned_rate(rate, None, self.options)))

    def fit(self, xy_px: Float, w: Float, G: Float | None, warped: WarpedImages | None = None) -> PointFits:
        """Refine points from start values and reject those that fail the checks of a single point.

        With ``warped`` images of a motion the starts are the prediction that these show.
        """
        n = len(xy_px)
        visible = self.visible(xy_px)
        w, G = self._terms_of(w), None if G is None else self._terms_of(G)
        if self.cur1 is None or self.cur2 is None:
            s = fit_shape(self.pair, self.ref1, self.ref2, xy_px, w, self.options, visible)
            fits = PointFits(
                s.w,
                np.full((n, 3, self.terms), np.nan),
                s.zncc,
                s.epipolar_px,
                s.epipolar_sigma_px,
                s.noise,
                s.covariance,
                s.iterations,
                s.status,
                np.full(n, np.nan),
            )
        else:
            images = self.ref1, self.ref2, self.cur1, self.cur2
            m = fit_motion(self.pair, *images, xy_px, w, G, self.options, visible, warped)
            fits = PointFits(
                m.w,
                m.G,
                m.zncc,
                m.epipolar_px,
                m.epipolar_sigma_px,
                m.noise,
                m.covariance,
                m.iterations,
                m.status,
                m.rate,
            )
        if self.keep_rejected:
            fits.keep_rejected()
        with np.errstate(invalid="ignore"):
            low = fits.ok & ~(fits.worst_zncc >= self.min_zncc)
            fits.reject(low, PointStatus.LOW_CORRELATION)
            off = fits.ok & ~(np.abs(fits.epipolar_px) <= MAX_EPIPOLAR_PX)
            fits.reject(off, PointStatus.EPIPOLAR_MISMATCH)
        ok = np.flatnonzero(fits.ok)
        rays = self.pair.cam1.rays_cam(xy_px).xyz_mm[ok]
        good = plausible(self.pair, rays, fits.w[ok], None if self.cur1 is None else fits.G[ok])
        fits.reject(_mask(n, ok[~good]), PointStatus.NOT_CONVERGED)
        return fits

    def visible(self, xy_px: Float) -> VisiblePixels | None:
        """Return the visible pixels of points; None: all of them."""
        return None if self.visibility is None else self.visibility.at(xy_px)

    def far_from_start(self, xy_px: Float, fits: PointFits, w: Float, G: Float | None, limit_px: float) -> Bool:
        """Return (n,) True where a fit ended further than ``limit_px`` from its start in any image."""
        rays = self.pair.cam1.rays_cam(xy_px).xyz_mm
        return far_from_start(self.pair, rays, fits.w, fits.G, w, None if self.cur1 is None else G, limit_px)

    def _terms_of(self, start: Float) -> Float:
        """A start without the terms that the patch does not have, zeros for those that the start does not have."""
        if start.shape[-1] >= self.terms:
            return start[..., : self.terms]
        return np.concatenate([start, np.zeros((*start.shape[:-1], self.terms - start.shape[-1]))], axis=-1)


def learned_rate(rate: Float, known: float | None, options: MatchOptions) -> float:
    """Return the convergence rate assumed after a point's first step, from other points' ``rate`` (m,), NaN if unknown.

    Nine in ten of them converged at least that fast. The result is never slower than the default, and with few points
    the ``known`` rate is kept.
    """
    finite = rate[np.isfinite(rate)]
    if len(finite) < _RATE_FROM:
        return options.first_rate if known is None else known
    return min(float(np.quantile(finite, _RATE_QUANTILE)), options.first_rate)


def _mask(n: int, index: NDArray[np.intp]) -> Bool:
    mask = np.zeros(n, bool)
    mask[index] = True
    return mask
