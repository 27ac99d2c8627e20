"""Checks that a grid's index is certain."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.errors import TargetError
from stereorig.core.grid.lattice import LineLattice, apply_homography, homography, polylines
from stereorig.core.grid.piece_table import PieceTable
from stereorig.core.grid.profile import OUT
from stereorig.core.grid.strip import IN
from stereorig.core.grid.view import GridOptions
from stereorig.core.robust import MAD_TO_SIGMA
from stereorig.core.target import GridTarget

Cause = Literal["", "dirt", "glare", "noise"]
_DEFECTS = {
    "glare": "is glaring (saturated or without contrast)",
    "noise": "is lost in the image's noise",
    "dirt": "is covered, dirty or unsharp",
}

_MIN_INSIDE_PX = 3.0
_LEAST_OBLIQUE_DEG = 3.0
_OBLIQUE_RAD = float(np.radians(64.0))  # off the normal; nearer to it, lines 12 px apart or more were all found
_DEPTH_RANGE = (0.4, 2.2)  # multiples of the neighbours' mean
_TYPICAL_RANGE = (0.4, 2.5)  # multiples of the image's; light falls off by less
_GROUND_SLOPE = 0.25  # rise of the ground from a line to the strip's rim, as part of the line's depth
_MIN_CERTAIN = 0.25  # standard deviation of a piece's position, as part of the line's width and blur
_RMS_RATIO = 3.0
# share of the pieces that are sound in any grid in use; and ratio of a sound grid's usual rms to theirs
_SOUND, _RMS_SPREAD = 0.2, 1.25
_GLARING_SHARE = 0.0005  # share of the image's pixels, in spots; a glare large enough to hide lines has such a core
_CLIPPED = 0.5  # share of the rms that remains if half of the noise is clipped
_NOISY = 0.4  # share of the lines' depth; with more noise pieces are lost
_GLARE_RISE = 0.5  # ground above its neighbours', as part of the lines' depth


def check_lattice(lattice: LineLattice, target: GridTarget, size_px: tuple[int, int]) -> None:
    """Raise an error for a lattice that is turned by 90 degrees, has other counts than the target, or leaves the image.

    Raises
    ------
    TargetError
        ``target_rotated``, ``target_line_count``, ``target_partly_seen``.
    """
    found, expected = lattice.counts, target.lines
    segments = polylines(lattice.nodes_px)
    if found == expected and inside(lattice.nodes_px, size_px).all():
        return
    if found == (expected[1], expected[0]) and found != expected:
        raise TargetError(
            f"{found[0]} lines are crossed along X_sys and {found[1]} along Y_sys, the target has {expected[0]} and"
            f" {expected[1]}: it is turned by 90 degrees",
            code="target_rotated",
            remedy="Turn the grid by 90 degrees, or swap the counts in the target's description.",
            found=list(found),
            expected=list(expected),
            segments_px=segments,
        )
    text = f"{found[0]} x {found[1]} lines found, {expected[0]} x {expected[1]} expected"
    short = found[0] < expected[0] or found[1] < expected[1]
    if found == expected or (short and _may_continue_outside(lattice, target, size_px)):
        raise TargetError(
            f"the grid leaves the image: {text}",
            code="target_partly_seen",
            remedy="Move the grid or the camera until all lines, out to the corners, lie inside the image.",
            found=list(found),
            expected=list(expected),
            segments_px=segments,
        )
    raise TargetError(
        text,
        code="target_line_count",
        remedy="Check the target's description; uncover and clean the whole grid, and remove other lines next to it.",
        found=list(found),
        expected=list(expected),
        strays=len(lattice.strays),
        segments_px=segments,
    )


def check_oblique(lattice: LineLattice) -> None:
    """Raise an error for lines along rows and columns, whose dark pixels beat with the sensor's lattice.

    On the paper's rig the dark pixels' error is 0.005 px at 3 degrees and 0.04 px at 0, ten times their stated noise.

    Raises
    ------
    TargetError
        ``target_rotated``.
    """
    rotation_deg = float(np.degrees(lattice.rotation_rad))
    off = abs((rotation_deg + 45.0) % 90.0 - 45.0)
    if off < _LEAST_OBLIQUE_DEG:
        raise TargetError(
            f"the lines lie {off:.1f} degrees from the image's rows; the paper's localiser needs"
            f" {_LEAST_OBLIQUE_DEG:g} degrees",
            code="target_rotated",
            remedy="Use the profile localiser, or turn the grid until its lines run at about 45 degrees to the rows.",
            rotation_deg=rotation_deg,
            segments_px=polylines(lattice.nodes_px),
        )


def inside(nodes_px: Float, size_px: tuple[int, int]) -> Bool:
    """Return (...) True for intersections inside the image with room for their lines."""
    low = nodes_px >= _MIN_INSIDE_PX
    high = nodes_px <= np.array(size_px) - 1.0 - _MIN_INSIDE_PX
    return np.asarray((low & high).all(axis=-1))


def _may_continue_outside(lattice: LineLattice, target: GridTarget, size_px: tuple[int, int]) -> bool:
    """Return True if the missing lines may be outside the image or cross its border."""
    na, nb = lattice.counts
    if not inside(lattice.nodes_px, size_px).all():
        return True
    for axis, (n, other) in enumerate(((na, nb), (nb, na))):
        if n >= target.lines[axis]:
            continue
        for end in (-1.0, float(n)):
            along = np.arange(other, dtype=np.float64)
            fixed = np.full(other, end)
            ij = np.stack([fixed, along] if axis == 0 else [along, fixed], axis=-1)
            if not inside(apply_homography(lattice.plane_to_image, ij), size_px).all():
                return True
    return False


def saturation_level(image: NDArray[Any]) -> float:
    """Grey level at which the sensor saturates; infinite if it is not known.

    A 16-bit file may hold 10, 12, 14 or 16 significant bits: the level is the one at which pixels pile up.
    """
    array = np.asarray(image)
    if array.dtype == np.uint8:
        return 255.0
    if array.dtype.kind != "u":
        return float("inf")
    top = int(array.max())
    full = {1023, 4095, 16383, 65535, 65520, 65472}
    return float(top) if top in full and np.count_nonzero(array == top) > 20 else float("inf")


def blame_glare(error: TargetError, grey: Float32, saturation: float) -> TargetError:
    """Return the same error, or the one for glare if saturated pixels can have hidden the lines."""
    expected, found = error.context.get("expected"), error.context.get("found")
    too_many = expected is not None and found is not None and sum(found) > sum(expected)
    # a spot that holds a 5 x 5 px square is no clipped noise
    share = float(cv2.erode((grey >= saturation).astype(np.uint8), np.ones((5, 5), np.uint8)).mean())
    if share < _GLARING_SHARE or too_many or error.code == "target_rotated":
        return error
    return TargetError(
        f"{error.cause}; {share:.2%} of the image is saturated, which can hide lines",
        code="target_glare",
        remedy="Take the reflection or the overexposure away: light the grid from behind, close the aperture.",
        **{**error.context, "saturated": share},
    )


def blame_tilt(error: TargetError, lattice: LineLattice) -> TargetError:
    """Return the same error, named after the camera's place if it sees the lines too obliquely to measure them."""
    if lattice.tilt_rad < _OBLIQUE_RAD:
        return error
    return TargetError(
        f"the camera sees the target at about {np.degrees(lattice.tilt_rad):.0f} degrees off its normal, which draws "
        f"its lines together: {error.cause}",
        code="target_too_small",
        remedy="Let the camera see the target from nearer to its normal, or larger.",
        **error.context,
    )


def check_pieces(
    table: PieceTable, fits: Float, target: GridTarget, saturation: float, *, strict: bool
) -> tuple[Bool, NDArray[np.str_]]:
    """Distinguish good pieces from spoilt ones.

    ``strict``: by the noise of the best pieces; else by the noise of most pieces, which dirt on most of them raises.

    Returns
    -------
    good, cause
        (n,) and (n,) of :data:`Cause`.
    """
    sign = -1.0 if target.dark_lines else 1.0
    ok = fits[:, OUT["ok"]] > 0.0
    depth = np.where(ok, sign * fits[:, OUT["amplitude"]] * fits[:, OUT["peak"]], np.nan)
    xy = table.rows[:, [IN["x"], IN["y"]]]
    typical = smooth(xy, depth, xy)
    if (ok & np.isfinite(depth)).any():
        # a quadratic is of little use in places without lines
        middle = densest(depth[np.isfinite(depth)])
        typical = np.clip(typical, _TYPICAL_RANGE[0] * middle, _TYPICAL_RANGE[1] * middle)
    ground = smooth(xy, fits[:, OUT["ground"]], xy)
    rms = fits[:, OUT["rms"]]
    usual = float(np.nanmedian(rms))
    if strict:
        usual = min(usual, _RMS_SPREAD * float(np.nanquantile(rms, _SOUND)))
    with np.errstate(invalid="ignore"):
        fits_shape = rms < _RMS_RATIO * usual + 0.02 * np.abs(typical)
        seen = (depth > _DEPTH_RANGE[0] * typical) & (depth < _DEPTH_RANGE[1] * typical)
        certain = np.sqrt(fits[:, OUT["var_c0"]]) < _MIN_CERTAIN * (fits[:, OUT["width"]] + fits[:, OUT["blur"]])
        # clipped peaks of the noise do no harm, on both sides of a line alike; a level of which most is clipped does
        level = fits[:, OUT["ground"]] + (0.0 if target.dark_lines else depth)
        saturated = (fits[:, OUT["brightest"]] >= saturation) & ~(level + _CLIPPED * rms < saturation)
        glaring = saturated | (~seen & (fits[:, OUT["ground"]] - ground > _GLARE_RISE * np.abs(typical)))
        # next to the edge of a cover the ground is no plane, and the fit finds the edge in place of the line
        reach = 0.5 * table.rows[:, IN["width"]] + 5.0 * np.hypot(table.rows[:, IN["blur"]], 12.0**-0.5) + 1.0
        level_ground = np.abs(fits[:, OUT["ground_d"]]) * reach < _GROUND_SLOPE * typical
    good = ok & fits_shape & seen & certain & level_ground & ~saturated
    for family, present in enumerate(target.present_lines):
        good &= (table.family != family) | np.isin(table.line, present)
    noisy = usual > _NOISY * np.abs(typical)
    cause = np.where(good, "", np.where(glaring, "glare", np.where(noisy, "noise", "dirt")))
    return good, cause


def smooth(xy_px: Float, values: Float, at_px: Float) -> Float:
    """Quadratic over the image through the values, robust to outliers (two rounds of clipping), at positions (n, 2)."""
    middle_px, scale_px = xy_px.mean(axis=0), xy_px.std(axis=0)

    def design(at: Float) -> Float:
        u, v = ((at - middle_px) / scale_px).T
        return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)

    J = design(xy_px)
    keep = np.isfinite(values)
    middle = densest(values[keep]) if keep.any() else np.nan
    keep &= np.abs(values - middle) < 0.7 * abs(middle)
    coefficients = np.array([middle, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(3):
        if np.count_nonzero(keep) < 30:
            break
        coefficients = np.linalg.lstsq(J[keep], values[keep], rcond=None)[0]
        off = np.abs(values - J @ coefficients)
        keep = np.isfinite(values) & (off < 4.0 * MAD_TO_SIGMA * np.median(off[keep]) + 1e-3 * abs(middle))
    return np.asarray(design(at_px) @ coefficients)


def densest(values: Float) -> float:
    """Middle of the narrowest interval that holds a third: the sound pieces' value where most are spoilt."""
    ordered = np.sort(values)
    held = max(len(ordered) // 3, 1)
    widths = ordered[held - 1 :] - ordered[: len(ordered) - held + 1]
    first = int(np.argmin(widths))
    return float(np.median(ordered[first : first + held]))


def lines_kept(
    table: PieceTable,
    good: Bool,
    cause: NDArray[np.str_],
    target: GridTarget,
    options: GridOptions,
    *,
    least_pieces: int = 2,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the numbers of the lines, of either family, of which enough is left: ``least_pieces`` or more.

    Raises
    ------
    TargetError
        ``target_dirty``, ``target_glare`` or ``target_noisy``, by the cause that spoils most, if too little is left.
    """
    index, na = table.line_index(), table.counts[0]
    present = np.zeros(sum(table.counts), dtype=bool)
    present[target.present_lines[0]] = present[na + target.present_lines[1]] = True
    left, pieces = np.bincount(index, weights=good), np.bincount(index)
    whole = present & (left >= np.maximum((1.0 - options.max_bad_on_line) * pieces - 1e-6, least_pieces))
    bad = ~good & present[index]
    n, kept = int(present[index].sum()), (np.flatnonzero(whole[:na]), np.flatnonzero(whole[na:]))
    enough = all(len(k) >= max(5, -(-count // 2)) for k, count in zip(kept, table.counts, strict=True))
    if enough and bad.sum() <= options.max_bad_fraction * n:
        return kept
    worst = max(_DEFECTS, key=lambda d: np.count_nonzero(bad & (cause == d)))
    defect = _DEFECTS[worst]
    lines = f"{len(kept[0])} x {len(kept[1])} lines of {table.counts[0]} x {table.counts[1]}"
    raise TargetError(
        f"{np.count_nonzero(bad)} of {n} pieces of lines cannot be used (at most {options.max_bad_fraction:.0%}), and"
        f" {lines} are left; most of it {defect}",
        code="target_glare" if worst == "glare" else "target_noisy" if worst == "noise" else "target_dirty",
        remedy="Take the reflection or the overexposure away: light the grid from behind, close the aperture."
        if worst == "glare"
        else "Average several images at each position, give more light, or lower the camera's gain."
        if worst == "noise"
        else "Clean the grid, take away what covers it, and focus on it.",
        bad=int(np.count_nonzero(bad)),
        pieces=n,
        segments_px=[[round(float(v), 1) for v in ends.ravel()] for ends in table.ends_px()[bad]],
    )


def check_regular(
    straight_px: Float, nodes_px: Float, target: GridTarget, kept: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> None:
    """Raise an error for lines of the numbers ``kept`` that are no image of a regular grid.

    Raises
    ------
    TargetError
        ``target_irregular``.
    """
    grid = np.stack(np.meshgrid(*kept, indexing="ij"), axis=-1).astype(np.float64).reshape(-1, 2)
    image = straight_px.reshape(-1, 2)
    found = np.isfinite(image).all(axis=-1)
    grid, image = grid[found], image[found]
    H = homography(grid, image)
    off = np.linalg.norm(apply_homography(H, grid) - image, axis=-1)
    step = np.linalg.norm(apply_homography(H, grid + np.array([1.0, 0.0])) - apply_homography(H, grid), axis=-1)
    worst = float((off / step).max())
    limit = 0.03 + 4.0 * target.node_tolerance_mm / target.pitch_mm
    if worst > limit:
        raise TargetError(
            f"the lines are no regular grid: one intersection lies {worst:.3f} pitches off the others' lattice"
            f" (at most {limit:.3f})",
            code="target_irregular",
            remedy="Check that the target is the one described, that it is flat, and that no other lines lie on it.",
            worst_pitches=worst,
            segments_px=polylines(nodes_px),
        )
