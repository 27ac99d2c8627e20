"""A tile of points, fitted with the rows of the images that it needs: all that another process has of a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.arrays import Float
from core.cameras.stereo import StereoPair
from core.field.points.crew import MAX_BATCH, ToFit, fit_part
from core.field.points.fitter import Fitter, PointFits
from core.field.points.starts import image_positions
from core.matching.arguments import VisiblePixels
from core.matching.image import ImageData, prepare
from core.matching.options import SPLINE_ORDER, MatchOptions
from core.matching.rows import prepare_rows, reference_rows
from core.matching.slopes import SlopeFilter
from core.noise import NoiseModel
from core.progress import CancelToken, raise_if_cancelled

_AROUND_PX = 12.0
"""About the subsets at their starts: a fit's way, its taps, and rounding."""
_EVERY = 4  # point is looked at

Rows = tuple[int, int]


@dataclass(frozen=True, eq=False)
class TileSetting:
    """What all tiles of a step have in common, besides cameras and images.

    Attributes
    ----------
    options, min_zncc, keep_rejected
        Of the step's matcher.
    noise
        Of the images; None where it is not known.
    slopes
        The derivative for the whole of the reference image.
    """

    options: MatchOptions
    min_zncc: float
    keep_rejected: bool
    noise: tuple[NoiseModel | None, ...]
    slopes: SlopeFilter

    @staticmethod
    def of(fitter: Fitter) -> TileSetting | None:
        """Return the setting of a matcher's tiles; None where a tile's fits need more than it has."""
        images = images_of(fitter)
        slopes = fitter.ref1.slopes
        if slopes is None or any(image.blur is not None for image in images):
            return None
        noise = tuple(image.noise for image in images)
        return TileSetting(fitter.options, fitter.min_zncc, fitter.keep_rejected, noise, slopes)


@dataclass(frozen=True, eq=False)
class _TileFitter(Fitter):
    """A matcher of points whose visible pixels are given."""

    given: VisiblePixels | None = None

    def visible(self, xy_px: Float) -> VisiblePixels | None:  # noqa: ARG002
        return self.given


class TileFits:
    """Fits tiles of one step.

    Parameters
    ----------
    pair
        The calibrated cameras.
    pixels
        (rows, cols) grey levels of camera 1's and camera 2's reference image and, of a motion, current image.
    setting
        Of the tiles.
    """

    def __init__(self, pair: StereoPair, pixels: Sequence[NDArray[Any]], setting: TileSetting) -> None:
        self._pair, self._pixels, self._setting = pair, pixels, setting
        self._whole: list[ImageData] = []

    def fit(self, points: ToFit, visible: VisiblePixels | None, cancel: CancelToken | None = None) -> PointFits:
        """Fit a tile's points; ``visible`` are their visible pixels, None: all.

        Raises
        ------
        Cancelled
            If the token is set.
        """
        s = self._setting
        images = self._prepared(points)
        now = (images[2], images[3]) if len(images) > 2 else (None, None)
        out = None
        for first in range(0, len(points), MAX_BATCH):
            raise_if_cancelled(cancel)
            part = slice(first, first + MAX_BATCH)
            some = None if visible is None else VisiblePixels(visible.patches, visible.of_point[part])
            fitter = _TileFitter(
                pair=self._pair,
                ref1=images[0],
                ref2=images[1],
                cur1=now[0],
                cur2=now[1],
                options=s.options,
                min_zncc=s.min_zncc,
                keep_rejected=s.keep_rejected,
                given=some,
            )
            out = fitter.empty(len(points)) if out is None else out
            fits = fit_part(fitter, points.at(part))
            out.put(np.arange(first, first + len(fits.status)), fits)
        assert out is not None
        return out

    def _prepared(self, points: ToFit) -> list[ImageData]:
        s = self._setting
        if any(model is not None for model in s.noise):  # weights and variances are those of the whole image
            if not self._whole:
                pairs = zip(self._pixels, s.noise, strict=True)
                self._whole = [prepare(pixels, s.options.interpolation, model) for pixels, model in pairs]
            return self._whole
        order = SPLINE_ORDER[s.options.interpolation]
        rows = rows_of(self._pair, points, s.options.subset_px, [len(pixels) for pixels in self._pixels])
        reference = reference_rows(self._pixels[0], order, s.slopes, *rows[0])
        return [reference, *(prepare_rows(p, order, *r) for p, r in zip(self._pixels[1:], rows[1:], strict=True))]


def images_of(fitter: Fitter) -> list[ImageData]:
    """Return a matcher's images: camera 1's and camera 2's reference, and of a motion the current ones."""
    now = () if fitter.cur1 is None or fitter.cur2 is None else (fitter.cur1, fitter.cur2)
    return [fitter.ref1, fitter.ref2, *now]


def rows_of(pair: StereoPair, points: ToFit, subset_px: int, heights: Sequence[int]) -> list[Rows]:
    """Return first row, and one past the last one, of each image that the points' fits look at."""
    half = subset_px // 2 + 1
    y = points.xy_px[:, 1]
    found: list[tuple[float, float]] = [(float(y.min()) - half, float(y.max()) + half)]
    points = points.at(slice(None, None, _EVERY))
    own = pair.cam1.rays_cam(points.xy_px).xyz_mm
    seen: list[list[Float]] = [[] for _ in heights[1:]]
    for corner in ((-half, -half), (-half, half), (half, -half), (half, half)):
        rays = pair.cam1.rays_cam(points.xy_px + np.array(corner)).xyz_mm
        offset = rays[:, :2] - own[:, :2]
        w = points.w[:, :1] + (points.w[:, 1:3] * offset).sum(axis=1, keepdims=True)
        seen[0].append(image_positions(pair, w, rays)[1])
        if points.G is not None:
            column = points.G[:, :, 0] + np.einsum("nij,nj->ni", points.G[:, :, 1:3], offset)
            for k, there in enumerate(image_positions(pair, w, column), start=1):
                seen[k].append(there)
    for corners in seen:
        down = np.concatenate(corners)[:, 1]
        down = down[np.isfinite(down)]
        found.append((float(down.min()), float(down.max())) if len(down) else (0.0, 0.0))
    out = []
    for (low, high), height in zip(found, heights, strict=True):
        first = int(np.clip(np.floor(low - _AROUND_PX), 0, height - 1))
        out.append((first, int(np.clip(np.ceil(high + _AROUND_PX) + 1, first + 1, height))))
    return out
