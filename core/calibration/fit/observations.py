"""One view's observed positions as rows of the adjustment, with the covariance of their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.inputs import CalibrationView
from stereorig.core.names import CAMERAS


@dataclass(frozen=True)
class Lines:
    """Errors of intersections as offsets across their lines.

    Attributes
    ----------
    shape
        (n_a, n_b) intersections.
    basis
        (n, 2, 2) unit normals of either family as rows.
    precision_a, precision_b
        (n_a, n_b, n_b) and (n_b, n_a, n_a) inverse covariances of the offsets along each line, zero where not found.
    """

    shape: tuple[int, int]
    basis: Float
    precision_a: Float
    precision_b: Float

    def project(self, values: Float) -> Float:
        """Return offsets (n, 2, ...) across the lines of image vectors (n, 2, ...)."""
        return np.asarray(np.einsum("nij,nj...->ni...", self.basis, values))

    def weigh(self, values: Float) -> Float:
        """Multiply offsets (n, 2, p) by the inverse covariance."""
        (n_a, n_b), p = self.shape, values.shape[-1]
        out = np.empty_like(values)
        a = values[:, 0].reshape(n_a, n_b, p)
        b = values[:, 1].reshape(n_a, n_b, p).swapaxes(0, 1)
        out[:, 0] = (self.precision_a @ a).reshape(-1, p)
        out[:, 1] = (self.precision_b @ b).swapaxes(0, 1).reshape(-1, p)
        return out


@dataclass(frozen=True)
class ViewRows:
    """Observations of one view.

    Attributes
    ----------
    camera
        0 or 1.
    dz_mm, frame
        Stage position, or number of the free pose.
    label
        Name for messages.
    xy_px
        (n, 2), NaN where not found.
    found
        (n,).
    weight
        (n,) mean 1 over the points of the camera; 0 where not found.
    lines
        Full covariance along lines, in units of the same reference variance; None if points are independent.
    correlation
        Observed coordinates per independent one.
    """

    camera: int
    dz_mm: float | None
    frame: int | None
    label: str
    xy_px: Float
    found: Bool
    weight: Float
    lines: Lines | None = None
    correlation: float = 1.0

    @property
    def count(self) -> int:
        """Number of observed coordinates."""
        return 2 * int(self.found.sum())

    def moved(self, shift_px: Float) -> ViewRows:
        """Return the view with its positions moved by (n, 2)."""
        return replace(self, xy_px=self.xy_px + shift_px)

    def without(self, points: Bool) -> ViewRows:
        """Return the view without some of its points (n,)."""
        found = self.found & ~points
        lines = self.lines
        if lines is not None:
            lines = _without(lines, found)
        return replace(
            self,
            xy_px=np.where(found[:, None], self.xy_px, np.nan),
            found=found,
            weight=np.where(found, self.weight, 0.0),
            lines=lines,
        )


def collect(views: Sequence[CalibrationView]) -> list[ViewRows]:
    """Return the rows of all views, in their order; the weights of each camera's have the mean 1."""
    rows: list[ViewRows | None] = [None] * len(views)
    for c, name in enumerate(CAMERAS):
        own = [k for k, v in enumerate(views) if v.camera == name]
        if own:
            for k, row in zip(own, _of_camera([views[k] for k in own], c), strict=True):
                rows[k] = row
    return [row for row in rows if row is not None]


def _of_camera(views: Sequence[CalibrationView], c: int) -> list[ViewRows]:
    xy = [v.xy_px.reshape(-1, 2) for v in views]
    found = [np.asarray(np.isfinite(p).all(axis=-1)) for p in xy]
    if all(v.sigma_px is not None for v in views):
        sigma = [np.broadcast_to(np.asarray(v.sigma_px), v.xy_px.shape[:2]).ravel() for v in views]
        sigma = [np.where(np.isfinite(s) & f, s, np.inf) for s, f in zip(sigma, found, strict=True)]
        # a localiser that claims much less noise at some nodes would otherwise decide the fit there
        floor = 0.5 * float(np.median(np.concatenate([s[f] for s, f in zip(sigma, found, strict=True)])))
        weight = [1.0 / np.maximum(s, floor) ** 2 for s in sigma]
    else:
        weight = [f.astype(np.float64) for f in found]
    reference = float(np.mean(np.concatenate([w[f] for w, f in zip(weight, found, strict=True)])))
    correlation = float(np.mean([v.correlation for v in views]))
    out = []
    for view, p, f, w in zip(views, xy, found, weight, strict=True):
        lines = None if view.offsets is None else _lines(view, f, 1.0 / reference)
        out.append(
            ViewRows(
                camera=c,
                dz_mm=view.dz_mm,
                frame=view.frame,
                label=view.label,
                xy_px=np.where(f[:, None], p, np.nan),
                found=f,
                weight=np.where(f, w / reference, 0.0),
                lines=lines,
                correlation=correlation,
            )
        )
    return out


def _lines(view: CalibrationView, found: Bool, reference_variance: float) -> Lines:
    offsets = view.offsets
    assert offsets is not None
    n_a, n_b = view.xy_px.shape[:2]
    seen = found.reshape(n_a, n_b)
    basis = np.stack([offsets.normal_a, offsets.normal_b], axis=-2).reshape(-1, 2, 2)
    a = [_precision(offsets.covariance_a[i], seen[i]) for i in range(n_a)]
    b = [_precision(offsets.covariance_b[j], seen[:, j]) for j in range(n_b)]
    return Lines((n_a, n_b), basis, reference_variance * np.stack(a), reference_variance * np.stack(b))


def _precision(covariance: Float, seen: Bool) -> Float:
    out = np.zeros_like(covariance)
    if seen.any():
        out[np.ix_(seen, seen)] = np.linalg.inv(covariance[np.ix_(seen, seen)])
    return out


def _without(lines: Lines, found: Bool) -> Lines:
    seen = found.reshape(lines.shape)

    def reduced(precision: Float, mask: Bool) -> Float:
        had = np.diagonal(precision) > 0.0
        covariance = np.zeros_like(precision)
        covariance[np.ix_(had, had)] = np.linalg.inv(precision[np.ix_(had, had)])
        return _precision(covariance, mask & had)

    a = np.stack([reduced(p, seen[i]) for i, p in enumerate(lines.precision_a)])
    b = np.stack([reduced(p, seen[:, j]) for j, p in enumerate(lines.precision_b)])
    return replace(lines, precision_a=a, precision_b=b)
