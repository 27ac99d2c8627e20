"""Common features of the images of a field without a start, and the cause that their matches show.

Run only if nothing was seeded. Features are matched over whole images, without the cameras' geometry, and matches that
agree with their neighbours are kept. Features are matched over whole images, without the cameras' geometry, and those
kept that agree with their neighbours. Their distance from the epipolar lines, as the images are and as if one of them
or both had been turned or mirrored, names the cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import SeedError
from stereorig.core.field.points.features import Box, Features, detect
from stereorig.core.field.points.images import MeasureImage, features_of
from stereorig.core.field.seeding.image_faults import mosaic_share, period_px
from stereorig.core.field.seeding.scattered_matches import ScatteredMotion, scattered_motion
from stereorig.core.field.seeding.search_region import scales

Finding = Literal[
    "few_features",
    "mosaic",
    "turned",
    "mirrored",
    "off_epipolar_lines",
    "different_surfaces",
    "other_specimen",
    "repeating",
    "cameras_agree",
]

_MIN_FEATURES = 50
_MIN_MATCHES = 20  # agreeing with their neighbours; two unrelated textures give none to a few
_ON_LINE_PX = 1.0  # median of matches whose geometry is the cameras': features are found to some tenths of a pixel
_UNDONE_PX = 2.0  # the same of an image that is turned back: SIFT's positions are off by a quarter of a pixel
_CLEARLY = 0.3  # share of the distance without any change, at most, for an image that was turned
_FAR_FEWER = 5
_MOSTLY = 0.5

Shape = tuple[int, int]


@dataclass(frozen=True)
class _Change:
    """A change that an image may have undergone since the calibration: mirrored left to right, then turned."""

    quarter_turns: int = 0
    mirrored: bool = False

    @property
    def text(self) -> str:
        """The change in words."""
        degrees = ("", "90 degrees counter-clockwise", "180 degrees", "90 degrees clockwise")[self.quarter_turns]
        turned = degrees and f"turned by {degrees}"
        return " and ".join(part for part in ("mirrored" if self.mirrored else "", turned) if part)

    def undo(self, xy_px: Float, shape: Shape) -> Float:
        """Return positions (n, 2) of the changed image of (rows, cols) in the original image."""
        x, y = xy_px.T
        rows, cols = shape
        for _ in range(self.quarter_turns):  # undoes np.rot90 by one quarter, counter-clockwise
            x, y = rows - 1 - y, x
            rows, cols = cols, rows
        if self.mirrored:
            x = cols - 1 - x
        return np.stack([x, y], axis=1)


_AS_IT_IS = _Change()
_TURNS = tuple(_Change(k) for k in (2, 1, 3))
_FLIPS = (_Change(mirrored=True), *(_Change(k, mirrored=True) for k in (2, 1, 3)))


@dataclass(frozen=True)
class Diagnosis:
    """Cause found for a field without a start.

    Attributes
    ----------
    finding
        Its name, see ``Finding``.
    text, remedy
        A sentence with the figures, and the remedy.
    features
        Features found in camera 1's and camera 2's image of the step.
    matches
        Number of features matched between the cameras that agree with their neighbours.
    epipolar_px
        Median distance of these from their epipolar lines; None without enough of them.
    matches_in_time
        Matches of camera 1's reference with its current image that agree with their neighbours; None for a shape.
    """

    finding: Finding
    text: str
    remedy: str
    features: tuple[int, int]
    matches: int
    epipolar_px: float | None
    matches_in_time: int | None


def diagnose(
    pair: StereoPair,
    reference: tuple[MeasureImage, MeasureImage],
    current: Sequence[MeasureImage] = (),
    *,
    region_px: tuple[float, float, float, float] | None = None,
    repeating: bool = False,
) -> Diagnosis:
    """Say why nothing could be matched.

    Parameters
    ----------
    pair
        The calibrated cameras.
    reference, current
        Both cameras' reference images, and their current ones; none of a shape.
    region_px
        (x0, y0, x1, y1) of camera 1's reference image that was to be measured.
    repeating
        True if the texture repeats itself nearly everywhere there.
    """
    one, two = (current[0], current[1]) if current else reference
    scale = scales((_whole(one), _whole(two)), (one.shape, two.shape))[0]
    found1, found2 = features_of([(one, _whole(one)), (two, _whole(two))], scale)
    features = len(found1.xy_px), len(found2.xy_px)
    direct = scattered_motion(found1, found2)
    off = _median_off(pair, direct)
    in_time = None
    if current:
        box = _whole(reference[0]) if region_px is None else _box(region_px, reference[0])
        before, now = features_of([(reference[0], box), (one, _whole(one))], scale)
        in_time = len(scattered_motion(before, now).xy_px)

    def result(finding: Finding, text: str, remedy: str, matched: ScatteredMotion = direct) -> Diagnosis:
        return Diagnosis(finding, text, remedy, features, len(matched.xy_px), off, in_time)

    names = tuple(f"camera {k}'s {'current ' if current else ''}image" for k in (1, 2))
    raw = [(name, s) for name, image in zip(names, (one, two), strict=True) if (s := mosaic_share(image.pixels))]
    if raw:
        return result(
            "mosaic",
            f"{' and '.join(name for name, _ in raw)} look{'s' * (len(raw) == 1)} like a raw Bayer mosaic: the pixels "
            f"of each square of 2 x 2 differ by {raw[0][1]:.0%} of the mean",
            "Give the camera's grey or developed (demosaiced) images, not its raw ones.",
        )
    few = [f"{name} shows {n}" for name, n in zip(names, features, strict=True) if n < _MIN_FEATURES]
    if few:
        return result(
            "few_features",
            f"{' and '.join(few)} feature{'s' if min(features) != 1 else ''}: too little texture, or defocused",
            "Check focus, exposure and light, and that the specimen carries a pattern that the cameras resolve.",
        )
    looser = max(1.0, scale / 2.0)
    limit, undone = _ON_LINE_PX * looser, _UNDONE_PX * looser
    shapes = one.shape, two.shape
    period = period_px(one.pixels) if region_px is None else period_px(_part(one, _box(region_px, one)))
    if period is not None and (len(direct.xy_px) < _MIN_MATCHES or off is None or off > limit):
        return result(
            "repeating",
            f"the texture repeats itself every {period:.1f} px, so that no match tells one period from the next",
            _NO_PERIOD,
        )
    if len(direct.xy_px) < _MIN_MATCHES:
        mirrored = _mirrored_matches(found1, two, scale)
        if len(mirrored.xy_px) >= _MIN_MATCHES and len(mirrored.xy_px) > 2 * len(direct.xy_px):
            flips = [(flip, _AS_IT_IS) for flip in _FLIPS] + [(_AS_IT_IS, flip) for flip in _FLIPS]
            changed = _that_fits(pair, mirrored, flips, shapes, undone)
            which = "one of the two images is mirrored" if changed is None else _text(changed, names)
            return result(
                "mirrored",
                f"{which}: {len(mirrored.xy_px)} feature matches agree with their neighbours so, {len(direct.xy_px)} "
                "as they are",
                _TURN_BACK,
                mirrored,
            )
        fewer = int(np.argmin(features))
        blurred = f"; {names[fewer]} may be defocused" if features[fewer] * _FAR_FEWER < max(features) else ""
        return result(
            "different_surfaces",
            f"of {features[0]} and {features[1]} features in {names[0]} and {names[1]} {len(direct.xy_px)} match and "
            f"agree with their neighbours: the cameras do not show the same surface{blurred}",
            "Check that both images are of one moment and one specimen, in focus, and that the views overlap.",
        )
    if off is None or off > limit:
        far = "far" if off is None else f"{off:.3g} px (median)"
        changes = [*_each_and_both(_TURNS), *((flip, flip) for flip in _FLIPS)]
        changed = _that_fits(pair, direct, changes, shapes, min(undone, _CLEARLY * (np.inf if off is None else off)))
        if changed is None:
            lost = in_time is not None and in_time < _MIN_MATCHES
            also = f"; {in_time} match the region's texture at the reference: another specimen, too" if lost else ""
            return result(
                "off_epipolar_lines",
                f"{len(direct.xy_px)} feature matches between the cameras agree with their neighbours, but lie {far} "
                "from their epipolar lines: the calibration is of another rig, or a camera was moved or refocused"
                f"{also}",
                "Give these cameras' own calibration, or calibrate again.",
            )
        return result(
            "mirrored" if changed[0].mirrored else "turned",
            f"{_text(changed, names)}: {len(direct.xy_px)} feature matches lie {far} from their epipolar lines, and on "
            "them once this is undone",
            _TURN_BACK,
        )
    agree = f"{len(direct.xy_px)} feature matches between the cameras lie {off:.2g} px (median) from their lines"
    if in_time is not None and in_time < _MIN_MATCHES:
        return result(
            "other_specimen",
            f"{agree}, but {in_time} match the region's texture at the reference: another specimen, or the region left "
            "the view or lost its pattern",
            "Check that the step is of this test, or start a new test with it as reference.",
        )
    if repeating:
        return result(
            "repeating", f"{agree}, but the texture repeats itself, and a start may be wrong by a period", _NO_PERIOD
        )
    return result(
        "cameras_agree",
        f"{agree}, so the calibration fits, but no subset of the region correlates",
        "Take a larger subset, check the focus and that the region lies on the surface that both cameras see, or give "
        "a seed point.",
    )


_NO_PERIOD = "Use a random pattern, or give a seed point with its position in camera 2."
_TURN_BACK = "Give the images as the cameras that were calibrated deliver them."


def seed_error(found: Diagnosis, noise_variance: float | None = None) -> SeedError:
    """Return the error for a field without a start, with the cause found.

    Parameters
    ----------
    found
        The diagnosis.
    noise_variance
        Variance in camera 1's noise model, grey levels squared, if there is one.
    """
    remedy = found.remedy
    if noise_variance is not None and found.finding == "cameras_agree":
        remedy += (
            f" The noise model says {noise_variance**0.5:.1f} grey levels: with too much, texture passes for noise; "
            "try without it."
        )
    context: dict[str, Any] = {
        "features": list(found.features),
        "matches": found.matches,
        "epipolar_px": found.epipolar_px,
    }
    if found.matches_in_time is not None:
        context["matches_in_time"] = found.matches_in_time
    return SeedError(
        f"no point of the region could be matched between the images from any start: {found.text}.",
        remedy=remedy,
        finding=found.finding,
        **{name: value for name, value in context.items() if value is not None},
    )


def _whole(image: MeasureImage) -> Box:
    return (0, 0, image.shape[1], image.shape[0])


def _box(region_px: tuple[float, float, float, float], image: MeasureImage) -> Box:
    rows, cols = image.shape
    x0, y0, x1, y1 = region_px
    return max(int(x0), 0), max(int(y0), 0), min(int(np.ceil(x1)) + 1, cols), min(int(np.ceil(y1)) + 1, rows)


def _part(image: MeasureImage, box: Box) -> Any:
    return image.pixels[box[1] : box[3], box[0] : box[2]]


def _each_and_both(changes: Sequence[_Change]) -> list[tuple[_Change, _Change]]:
    """Pairs of changes: of one image, of the other one, or of both in the same way."""
    one, two = [(change, _AS_IT_IS) for change in changes], [(_AS_IT_IS, change) for change in changes]
    return [*one, *two, *((change, change) for change in changes)]


def _off_lines(
    pair: StereoPair, matched: ScatteredMotion, changed: tuple[_Change, _Change], shapes: tuple[Shape, Shape]
) -> Float:
    """Distances (n,) from the epipolar lines with changes undone; infinite without a line."""
    xy1 = changed[0].undo(matched.xy_px, shapes[0])
    xy2 = changed[1].undo(matched.xy_current_px, shapes[1])
    off = np.full(len(xy1), np.inf)
    rays = pair.cam1.rays_cam(xy1).valid & pair.cam2.rays_cam(xy2).valid
    if rays.any():
        with np.errstate(invalid="ignore"):
            off[rays] = np.abs(pair.epipolar_residual_px(xy1[rays], xy2[rays]))
    return np.where(np.isfinite(off), off, np.inf)


def _in_front(
    pair: StereoPair, matched: ScatteredMotion, changed: tuple[_Change, _Change], shapes: tuple[Shape, Shape]
) -> Bool:
    points = pair.triangulate(
        changed[0].undo(matched.xy_px, shapes[0]), changed[1].undo(matched.xy_current_px, shapes[1])
    )
    with np.errstate(invalid="ignore"):
        depths = [camera.cam_from_sys.apply(points.xyz_mm)[:, 2] > 0.0 for camera in (pair.cam1, pair.cam2)]
    return np.asarray(points.valid & depths[0] & depths[1])


def _that_fits(
    pair: StereoPair,
    matched: ScatteredMotion,
    changes: Sequence[tuple[_Change, _Change]],
    shapes: tuple[Shape, Shape],
    limit_px: float,
) -> tuple[_Change, _Change] | None:
    """Return the change with the smallest distances from the lines, if within the limit and in front of the cameras."""
    off = [float(np.median(_off_lines(pair, matched, changed, shapes))) for changed in changes]
    for k in sorted(range(len(off)), key=off.__getitem__):
        if off[k] <= limit_px and _in_front(pair, matched, changes[k], shapes).mean() > _MOSTLY:
            return changes[k]
    return None


def _median_off(pair: StereoPair, matched: ScatteredMotion) -> float | None:
    if len(matched.xy_px) < _MIN_MATCHES:
        return None
    off = float(np.median(_off_lines(pair, matched, (_AS_IT_IS, _AS_IT_IS), ((0, 0), (0, 0)))))
    return off if np.isfinite(off) else None


def _mirrored_matches(found1: Features, two: MeasureImage, scale: int) -> ScatteredMotion:
    """Matches of camera 1's image with the mirror image of camera 2's, at their positions in camera 2's as it is."""
    flipped = detect(np.ascontiguousarray(cv2.flip(two.pixels, 1)), scale=scale)
    matched = scattered_motion(found1, flipped)
    cols = two.shape[1]
    back = matched.xy_current_px * np.array([-1.0, 1.0]) + np.array([cols - 1.0, 0.0])
    return ScatteredMotion(matched.xy_px, back, matched.scale)


def _text(changed: tuple[_Change, _Change], names: tuple[str, ...]) -> str:
    some = [name for name, change in zip(names, changed, strict=True) if change != _AS_IT_IS]
    what = changed[1] if changed[0] == _AS_IT_IS else changed[0]
    return f"{' and '.join(some)} {'are' if len(some) > 1 else 'is'} {what.text}"
