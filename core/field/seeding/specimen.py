"""The specimen in a pair of images without a given region: texture in camera 1 that camera 2 sees and matches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import RegionError
from stereorig.core.field.points.features import Box
from stereorig.core.field.points.images import MeasureImage, different, features_of
from stereorig.core.field.region.textured import TextureMap, texture_map
from stereorig.core.field.seeding.diagnosis import diagnose, seed_error
from stereorig.core.field.seeding.epipolar_search import sweep
from stereorig.core.field.seeding.scattered_matches import ScatteredShape, scattered_shape
from stereorig.core.field.seeding.search_region import scales
from stereorig.core.robust import spread_indices

_WEAKEST = 0.06  # share of the texture at the matches: texture blurred to four times its width has less
_DARKEST = 0.1  # share of their grey level, down to which a texture may be weaker as the light is
_MIN_STRUCTURED = 0.2  # noise alone gives 0 within 0.1, a texture of speckles of 3 px half and more
_MIN_MATCHES = 12
_MIN_PART = 0.05  # share of the largest part's area
_MIN_PART_SUBSETS = 4.0  # area of a part in subsets
_MIN_PART_MATCHES = 4
_REACH_SUBSETS = 2.0  # from the nearest match
_REACH_SPACINGS = 4.0
_APART_SUBSETS = 3.0  # distance of searches in places without matches: on a steep face features may find none
_SEARCHES = 60
_SEARCHED_PX = 25
_CORRELATES = 0.7  # the best of thousands of places in a texture that is another one reaches 0.5
_NEAREST = 5
_SPOT = 0.1  # share of a subset
_TOLERANCE_PX = 1.5  # tolerance of outlines


@dataclass(frozen=True, eq=False)
class Specimen:
    """The specimen in camera 1's image.

    Attributes
    ----------
    mask
        (rows, cols) True on the specimen.
    outlines_px, holes_px
        Corners (n, 2) of its parts, the largest first, and of the holes in them, within some pixels of the mask.
    matches
        Feature matches with camera 2 that are on it.
    text
        Sentence about the search, with figures.
    """

    mask: Bool
    outlines_px: tuple[Float, ...]
    holes_px: tuple[Float, ...]
    matches: int
    text: str

    @property
    def share(self) -> float:
        """Share of the image."""
        return float(self.mask.mean())

    def rectangle_px(self, subset_px: int) -> tuple[float, float, float, float]:
        """Return (x0, y0, x1, y1) about the mask within the range of subsets that are inside the image.

        Raises
        ------
        RegionError
            ``region_not_found`` if none does.
        """
        rows, cols = self.mask.shape
        margin = subset_px // 2 + 2
        on_rows, on_cols = (np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0))
        x0, y0 = max(int(on_cols[0]), margin), max(int(on_rows[0]), margin)
        x1, y1 = min(int(on_cols[-1]), cols - 1 - margin), min(int(on_rows[-1]), rows - 1 - margin)
        if x1 - x0 < subset_px or y1 - y0 < subset_px:
            raise _not_found(f"what was found lies too near to the image's border for subsets of {subset_px} px")
        return float(x0), float(y0), float(x1), float(y1)


def find_specimen(pair: StereoPair, image1: MeasureImage, image2: MeasureImage, *, subset_px: int) -> Specimen:
    """Find the specimen: texture in camera 1's image that has a match in camera 2's.

    Parameters
    ----------
    pair
        The calibrated cameras.
    image1, image2
        Camera 1's and camera 2's image.
    subset_px
        Width of the subsets that are to be measured, odd.

    Returns
    -------
    Specimen
        The largest connected parts with a texture of both directions, not much weaker than at the matches, that camera
        2 sees, without the half subset by which a square sees texture beyond its edge.

    Raises
    ------
    ImageError
        ``image_blank``, ``same_image``.
    SeedError
        ``not_seeded`` if there are no matches to go by.
    RegionError
        ``region_not_found`` if nothing remains.
    """
    for image in (image1, image2):
        image.refuse_blank()
    different(image1, image2)
    scale = scales((_whole(image1), _whole(image2)), (image1.shape, image2.shape))[0]
    shape = scattered_shape(pair, *features_of([(image1, _whole(image1)), (image2, _whole(image2))], scale))
    if len(shape.xy_px) < _MIN_MATCHES:
        raise seed_error(diagnose(pair, (image1, image2)))
    found = texture_map(image1.pixels, subset_px)
    textured = _is_textured(found, shape.xy_px)
    seen = _is_seen(pair, (image1, image2), shape, found, textured, subset_px)
    across = subset_px / found.stride_px
    white = _eroded(_filled(textured, _SPOT * across**2), max(round(0.5 * across), 1)) & seen
    mask = _parts(_whole_pixels(white, image1.shape, found.stride_px), shape.xy_px, subset_px)
    if not mask.any():
        raise _not_found(f"no textured area of a few subsets of {subset_px} px is seen by both cameras")
    outlines, holes = _outlines(mask)
    on_it = int(_value_at(mask, shape.xy_px).sum())
    parts = f"{len(outlines)} part{'s' if len(outlines) > 1 else ''}"
    return Specimen(
        mask,
        outlines,
        holes,
        on_it,
        f"texture that camera 2 sees: {parts}, {mask.mean():.1%} of camera 1's image, with {on_it} of "
        f"{len(shape.xy_px)} feature matches; what has less than {_WEAKEST:g} of their texture counts as background",
    )


def _whole(image: MeasureImage) -> Box:
    return (0, 0, image.shape[1], image.shape[0])


def _is_textured(found: TextureMap, matches_px: Float) -> Bool:
    """(r, c) True where the texture is not much weaker than at the matches; in the dark by as much as the light is."""
    index = found.at(matches_px)
    typical = float(np.median(found.strength.ravel()[index]))
    light = float(np.median(found.mean.ravel()[index]))
    dimmed = np.clip(found.mean / max(light, 1e-12), _DARKEST, 1.0) ** 2
    return np.asarray((found.strength > _WEAKEST * typical * dimmed) & (found.structured > _MIN_STRUCTURED))


def _is_seen(
    pair: StereoPair,
    images: tuple[MeasureImage, MeasureImage],
    shape: ScatteredShape,
    found: TextureMap,
    textured: Bool,
    subset_px: int,
) -> Bool:
    """(r, c) True where matches are near, or a search finds one, and camera 2's image has a texture at their depth."""
    shape1, shape2, found2 = images[0].shape, images[1].shape, texture_map(images[1].pixels, subset_px)
    stride = max(subset_px // 2 // found.stride_px, 1)  # depths need no more
    rows, cols = found.strength[::stride, ::stride].shape
    y, x = np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij")
    xy = np.stack([x, y], axis=-1).reshape(-1, 2) * float(stride * found.stride_px)
    xy = np.minimum(xy, np.array(shape1[::-1]) - 1.0)
    tree = cKDTree(shape.xy_px)
    between = np.asarray(tree.query(shape.xy_px, k=2)[0])[:, 1]
    reach = max(_REACH_SUBSETS * subset_px, _REACH_SPACINGS * float(np.quantile(between, 0.95)))
    distance, nearest = tree.query(xy, k=_NEAREST)
    w0 = np.median(shape.w0[nearest], axis=1)
    there = pair.image2_at_depth(xy, 1.0 / w0)
    high = np.array(shape2[::-1]) - 1.0
    with np.errstate(invalid="ignore"):
        seen = ((there >= 0.0) & (there <= high)).all(axis=1)
    on = np.zeros(len(xy), bool)
    on[seen] = _is_textured(found2, there[seen]).ravel()[found2.at(there[seen])]
    far = np.asarray(distance)[:, 0] >= reach
    on[far] = False
    far &= textured.ravel()[found.at(xy)]
    on[far] = _found_by_search(pair, images, xy[far], subset_px)
    # one square whose depth is guessed wrongly makes no hole
    closed = cv2.morphologyEx(on.reshape(rows, cols).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    size = found.strength.shape[::-1]
    whole = np.repeat(np.repeat(closed, stride, axis=0), stride, axis=1)
    return np.asarray(cv2.copyMakeBorder(whole, 0, 1, 0, 1, cv2.BORDER_REPLICATE)[: size[1], : size[0]] > 0)


def _found_by_search(pair: StereoPair, images: tuple[MeasureImage, MeasureImage], xy_px: Float, subset_px: int) -> Bool:
    """(n,) True where the nearest of some searches along epipolar lines finds a match."""
    if len(xy_px) == 0:
        return np.zeros(0, bool)
    cell = np.floor(xy_px / (_APART_SUBSETS * subset_px)).astype(int)
    _, first, inverse = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    middle = np.array([xy_px[inverse.ravel() == k].mean(axis=0) for k in range(len(first))])
    tried = xy_px[np.unique(cKDTree(xy_px).query(middle)[1])]
    tried = tried[np.unique(spread_indices(len(tried), min(_SEARCHES, len(tried))))]
    one, two = images
    good = np.zeros(len(tried), bool)
    for k, xy in enumerate(tried):
        zncc = sweep(pair, one.pixels, two.pixels, xy, subset_px=max(subset_px, _SEARCHED_PX), candidates=1)[1]
        good[k] = len(zncc) > 0 and zncc[0] > _CORRELATES
    return np.asarray(good[cKDTree(tried).query(xy_px)[1]])


def _filled(white: Bool, area: float) -> Bool:
    """Fill spots smaller than an area, in samples: a single large speckle is no hole."""
    _, label, stats, _ = cv2.connectedComponentsWithStats((~white).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < area
    small[0] = False
    return np.asarray(white | small[label])


def _eroded(white: Bool, half: int) -> Bool:
    """Remove the rim that a square sees beyond the texture's edge, in all directions; the image's border is no edge."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * half + 1, 2 * half + 1))
    return np.asarray(cv2.erode(white.astype(np.uint8), kernel, borderType=cv2.BORDER_REPLICATE) > 0)


def _whole_pixels(white: Bool, shape: tuple[int, int], stride_px: int) -> Bool:
    """Samples to pixels (rows, cols): each pixel is its nearest sample."""
    rows, cols = (
        np.minimum(np.rint(np.arange(n) / stride_px).astype(int), m - 1)
        for n, m in zip(shape, white.shape, strict=True)
    )
    return np.asarray(white[rows[:, None], cols[None, :]])


def _parts(mask: Bool, matches_px: Float, subset_px: int) -> Bool:
    """Keep the large connected parts that hold matches."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if count < 2:
        return np.zeros_like(mask)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0.0
    held = np.bincount(_value_at(label, matches_px), minlength=count)
    keep = (held >= _MIN_PART_MATCHES) & (area >= _MIN_PART_SUBSETS * subset_px**2)
    if not keep.any():
        return np.zeros_like(mask)
    keep &= area >= _MIN_PART * area[keep].max()
    keep[0] = False
    return np.asarray(keep[label])


def _value_at(values: NDArray[np.generic], xy_px: Float) -> NDArray[np.generic]:
    rows, cols = values.shape
    x, y = np.rint(xy_px).astype(int).T
    return np.asarray(values[np.clip(y, 0, rows - 1), np.clip(x, 0, cols - 1)])


def _outlines(mask: Bool) -> tuple[tuple[Float, ...], tuple[Float, ...]]:
    """Corners of the parts' outlines, the largest first, and of their holes'."""
    contours, hierarchy = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    outer: list[tuple[float, Float]] = []
    holes: list[Float] = []
    for contour, (_, _, _, parent) in zip(contours, hierarchy[0], strict=True):
        corners = cv2.approxPolyDP(contour, _TOLERANCE_PX, True).reshape(-1, 2).astype(np.float64)
        if len(corners) < 3:
            continue
        if parent < 0:
            outer.append((float(cv2.contourArea(contour)), corners))
        else:
            holes.append(corners)
    outer.sort(key=lambda part: -part[0])
    return tuple(corners for _, corners in outer), tuple(holes)


def _not_found(why: str) -> RegionError:
    return RegionError(
        f"no specimen was found: {why}.",
        code="region_not_found",
        remedy="Give the region (--roi, or a rectangle, polygon or mask), or a smaller subset.",
    )
