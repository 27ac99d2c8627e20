"""Starts of a motion where growth did not reach: the neighbourhood's motion, put right by a search in both images.

Valid points nearby say how the body moved and stretched; the shape of an open point is known. So the current images are
sampled as the patch should look there, and the patch is searched for about the place that is predicted.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.starts import current_position
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.matching.image import ImageData
from stereorig.core.robust import BIWEIGHT_REACH, MAD_TO_SIGMA, biweight

_NEIGHBOURS = 24
_CANDIDATES = 512
_VISIBLE = 0.5
"""Correlation from which a patch counts as seen at the searched place; by chance it stays below 0.4."""
_FAR_PX = 4.0
_ELSEWHERE = 0.7
_LOOKED_FOR = 6


@dataclass(frozen=True, eq=False)
class LocalMotion:
    """Affine maps x' = A x + b of n points, camera 1's frame, mm.

    Attributes
    ----------
    A, b
        (n, 3, 3) and (n, 3).
    """

    A: Float
    b: Float

    def at(self, rays: Float, w: Float) -> Float:
        """Return ``G`` (n, 3, 3) of patches ``w`` (n, 3) on rays (n, 3)."""
        G = np.empty((len(w), 3, 3))
        G[:, :, 0] = np.einsum("nij,nj->ni", self.A, rays) + w[:, :1] * self.b
        for k in (1, 2):
            G[:, :, k] = self.A[:, :, k - 1] + w[:, k : k + 1] * self.b
        return G


def local_motion(points: PointFits, xy_px: Float, rays: Float, index: NDArray[np.intp]) -> LocalMotion:
    """Return the motion of the valid points nearest to the points ``index``, median by median."""
    valid = np.flatnonzero(points.ok)
    sparse = valid[:: max(1, len(valid) // _CANDIDATES)]
    near = np.asarray(cKDTree(xy_px[sparse]).query(xy_px[index], k=min(_NEIGHBOURS, len(sparse)))[1])
    of = sparse[near.reshape(len(index), -1)]
    A, x, now = _maps(points.w[of], points.G[of], rays[of])
    middle = np.median(A, axis=1)
    shift = np.median(now - np.einsum("nij,nkj->nki", middle, x), axis=1)
    return LocalMotion(middle, shift)


def predicted_motion(
    fitter: Fitter,
    points: PointFits,
    xy_px: Float,
    rays: Float,
    index: NDArray[np.intp],
    known_w: Float | None,
    *,
    min_zncc: float,
) -> PointFits:
    """Find the motion of the points ``index`` near the valid points' prediction; NOT_SEEDED for those without a match.

    Parameters
    ----------
    fitter
        The matcher of a motion.
    points
        All n points, some of them valid.
    xy_px, rays
        (n, 2) px, (n, 3) normalised.
    index
        (m,) of the points that are searched for.
    known_w
        (n, 3 or 6) the shape.
    min_zncc
        Correlation below which a match that no neighbour supports is taken for chance.
    """
    out = fitter.empty(len(index))
    if known_w is None or not points.ok.any():
        return out
    w = known_w[index][:, :3]
    local = np.flatnonzero(np.isfinite(w).all(axis=1))
    if len(local) == 0:
        return out
    w, of = w[local], index[local]
    G = local_motion(points, xy_px, rays, of).at(rays[of], w)
    starts, owner = [G], [np.arange(len(of))]
    seen, moved = _searched(fitter, xy_px[of], rays[of], w, G)
    starts.append(moved[seen])
    owner.append(np.flatnonzero(seen))
    who, first = np.concatenate(owner), np.concatenate(starts)
    fits = fitter.fit(xy_px[of[who]], w[who], first)
    away = fits.ok & fitter.far_from_start(xy_px[of[who]], fits, w[who], first, _FAR_PX)
    quality = np.where(away, -1.0, fits.quality)
    best = np.lexsort((quality, who))
    last = np.append(who[best][1:] != who[best][:-1], True)
    chosen = best[last]
    chosen = chosen[quality[chosen] >= min_zncc]
    out.put(local[who[chosen]], fits.take(chosen))
    return out


def seen_elsewhere(
    fitter: Fitter, points: PointFits, xy_px: Float, rays: Float, index: NDArray[np.intp], known_w: Float | None
) -> bool:
    """Return True if camera 1 clearly shows half of some points ``index`` away from the valid points' prediction.

    Then a part moved by itself, and features are worth their time. Points that it shows nowhere are hidden; points seen
    at their predicted place that did not match are hidden from camera 2.
    """
    if fitter.cur1 is None or known_w is None or len(index) == 0:
        return False
    if not points.ok.any():
        return True
    index = index[np.isfinite(known_w[index]).all(axis=1)]
    some = index[np.unique(np.linspace(0, len(index) - 1, min(len(index), _LOOKED_FOR)).astype(int))]
    w = known_w[some][:, :3]
    predicted = _images(fitter.pair, local_motion(points, xy_px, rays, some).at(rays[some], w)[:, :, 0] / w[:, :1])[0]
    half, elsewhere = fitter.options.subset_px, 0
    for place, xy in zip(predicted, xy_px[some], strict=True):
        own = _patch(fitter.ref1, xy, half)
        if own is None:
            continue
        score = np.asarray(cv2.matchTemplate(fitter.cur1.pixels, own, cv2.TM_CCOEFF_NORMED))
        r, c = np.unravel_index(int(np.argmax(score)), score.shape)
        away = np.linalg.norm(np.array([c + half, r + half]) - place) > half
        elsewhere += bool(score[r, c] > _ELSEWHERE and away)
    return bool(elsewhere > 0 and 2 * elsewhere >= len(some))


def _maps(w: Float, G: Float, rays: Float) -> tuple[Float, Float, Float]:
    """Affine maps (..., 3, 3) of patches, their normals turned with them, and positions before and now."""
    inverse = w[..., :1]
    x, now = rays / inverse, G[..., :, 0] / inverse
    before, after = [], []
    for k in (1, 2):
        unit = np.zeros(3)
        unit[k - 1] = 1.0
        before.append(unit / inverse - rays * w[..., k : k + 1] / inverse**2)
        after.append(G[..., :, k] / inverse - G[..., :, 0] * w[..., k : k + 1] / inverse**2)
    frames = []
    for a, b in (before, after):
        n = np.cross(a, b)
        frames.append(np.stack([a, b, n / np.linalg.norm(n, axis=-1, keepdims=True)], axis=-1))
    return frames[1] @ np.linalg.inv(frames[0]), x, now


def _searched(fitter: Fitter, xy_px: Float, rays: Float, w: Float, G: Float) -> tuple[Bool, Float]:
    """Return the places at which both current images show the patches, (n,), and ``G`` moved there."""
    assert fitter.cur1 is not None
    assert fitter.cur2 is not None
    pair, n = fitter.pair, len(xy_px)
    half = fitter.options.subset_px // 2
    reach = 2 * half
    span = np.arange(-half - reach, half + reach + 1, dtype=np.float64)
    ox, oy = np.meshgrid(span, span)
    seen, moved = np.zeros(n, bool), G.copy()
    for i in range(n):
        own = _patch(fitter.ref1, xy_px[i], half)
        if own is None:
            continue
        offset = pair.cam1.rays_cam(xy_px[i] + np.stack([ox, oy], axis=-1)).xyz_mm - rays[i]
        X, Y = offset[..., 0], offset[..., 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            now = np.moveaxis(G[i][:, 0, None, None] + G[i][:, 1, None, None] * X + G[i][:, 2, None, None] * Y, 0, -1)
            now = now / (w[i, 0] + w[i, 1] * X + w[i, 2] * Y)[..., None]
        found = [
            _found_in(image, xy, own) for image, xy in zip((fitter.cur1, fitter.cur2), _images(pair, now), strict=True)
        ]
        if found[0] is None or found[1] is None:
            continue
        p = pair.triangulate(found[0][None], found[1][None])
        position = pair.cam1.cam_from_sys.apply(p.xyz_mm)[0]
        if np.isfinite(position).all() and position[2] > 0.0:
            seen[i] = True
            moved[i, :, 0] = w[i, 0] * position
    return seen, moved


def _images(pair: StereoPair, position: Float) -> tuple[Float, Float]:
    """Return both cameras' images of positions (..., 3), camera 1's frame."""
    there = pair.cam2_from_cam1.apply(position.reshape(-1, 3)).reshape(position.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (
            np.asarray(pair.cam1.lens.image_from_normalised(position[..., :2] / position[..., 2:]).xy),
            np.asarray(pair.cam2.lens.image_from_normalised(there[..., :2] / there[..., 2:]).xy),
        )


def _found_in(image: ImageData, xy: Float, own: Float32) -> Float | None:
    """Return the place (2,) px of a patch in an image sampled at (k, k, 2); None if the image does not show it."""
    rows, cols = image.shape
    middle = xy[xy.shape[0] // 2, xy.shape[1] // 2]
    if not np.isfinite(xy).all() or not ((middle >= 0) & (middle <= (cols - 1, rows - 1))).all():
        return None
    maps = xy.astype(np.float32)
    window = cv2.remap(
        image.pixels,
        np.ascontiguousarray(maps[..., 0]),
        np.ascontiguousarray(maps[..., 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float(own.mean()),
    )
    score = np.asarray(cv2.matchTemplate(np.asarray(window, np.float32), own, cv2.TM_CCOEFF_NORMED))
    r, c = np.unravel_index(int(np.argmax(score)), score.shape)
    if not score[r, c] > _VISIBLE:
        return None
    half = own.shape[0] // 2
    return np.asarray(xy[r + half, c + half])


def _patch(image: ImageData, xy_px: Float, half: int) -> Float32 | None:
    x, y = (round(float(v)) for v in xy_px)
    rows, cols = image.shape
    if x < half or y < half or x + half >= cols or y + half >= rows:
        return None
    return np.ascontiguousarray(image.pixels[y - half : y + half + 1, x - half : x + half + 1], dtype=np.float32)


# Better starts for a step of a sequence, predicted from a sample of points.
#
# A sample spread over the field is fitted from the previous step's values. The changes of its unknowns are fitted by a
# smooth surface over the image, and all other points start from their previous values plus that. They then need half
# the iterations; where the motion is not smooth, their starts are no worse than without the prediction.

_QUADRATIC_FROM, _LINEAR_FROM = 36, 12
_ROUNDS = 4
_WORTH = 0.5  # share of the sample's own motion that may be left unexplained


def predict(
    pair: StereoPair, xy_px: Float, G: Float, sample: NDArray[np.intp], w_current: Float, G_current: Float
) -> Float:
    """Return start values of G (n, 3, k): the previous step's, moved as the sample moved.

    Parameters
    ----------
    pair
        The calibrated cameras.
    xy_px
        (n, 2) all points.
    G
        (n, 3, k) at the previous step, NaN if it is not known.
    sample
        (m,) indices of the points that were fitted.
    w_current, G_current
        (m, 3 or more), (m, 3, k) their fitted unknowns.
    """
    if len(sample) < _LINEAR_FROM:
        return G
    terms = smooth_terms(xy_px)[:, : 6 if len(sample) >= _QUADRATIC_FROM else 3]
    design, change = terms[sample], G_current - G[sample]
    weight = np.ones(len(sample))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(design * root, change.reshape(len(sample), -1) * root, rcond=None)[0]
        left = np.linalg.norm(
            (change.reshape(len(sample), -1) - design @ solution).reshape(change.shape)[..., 0], axis=1
        )
        reach = BIWEIGHT_REACH * MAD_TO_SIGMA * max(float(np.median(left)), 1e-15)
        weight = biweight((left / reach) ** 2)
    moved = G + (terms @ solution).reshape(G.shape)
    seen = [_images_at(pair, w_current, g) for g in (G_current, G[sample], moved[sample])]
    before, after = (float(np.median(np.linalg.norm(seen[0] - s, axis=-1).max(axis=0))) for s in seen[1:])
    return moved if after < _WORTH * before else G


def _images_at(pair: StereoPair, w: Float, G: Float) -> Float:
    """Current image coordinates of the points in both cameras, (2, m, 2) px."""
    here = current_position(w, G)
    there = pair.cam2_from_cam1.apply(here)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack(
            [
                camera.lens.image_from_normalised(p[:, :2] / p[:, 2:]).xy
                for camera, p in ((pair.cam1, here), (pair.cam2, there))
            ]
        )
