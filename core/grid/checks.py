"""Checks that a grid's index is certain."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float, Float32
from core.errors import TargetError
from core.grid.lattice import Lattice, apply_homography, homography
from core.grid.piece_table import PieceTable
from core.grid.profile import OUT
from core.grid.strip import IN
from core.grid.view import GridOptions
from core.robust import MAD_TO_SIGMA
from core.target import GridTarget

Cause = Literal["", "dirt", "glare"]

_MIN_INSIDE_PX = 3.0
_LEAST_OBLIQUE_DEG = 3.0
_DEPTH_RANGE = (0.4, 2.2)  # of the neighbours' mean
_MIN_CERTAIN = 0.25  # standard deviation of a piece's position, as part of the line's width and blur
_RMS_RATIO = 3.0
_GLARING_SHARE = 0.0005  # of the image's pixels, in spots; a glare large enough to hide lines has such a core
_GLARE_RISE = 0.5  # ground above its neighbours', as part of the lines' depth


def check_lattice(lattice: Lattice, target: GridTarget, size_px: tuple[int, int]) -> None:
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
    if found == expected or (short and _could_go_on_outside(lattice, target, size_px)):
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
        remedy="Check the target's description; uncover and clean the whole grid, and remove other lines beside it.",
        found=list(found),
        expected=list(expected),
        strays=len(lattice.strays),
        segments_px=segments,
    )


def check_oblique(lattice: Lattice) -> None:
    """Raise an error for lines along rows and columns, whose dark pixels beat with the sensor's lattice.

    On the paper's rig the dark pixels' error is 0.005 px at 3 degrees and 0.04 px at 0, ten times what they tell.

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


def _could_go_on_outside(lattice: Lattice, target: GridTarget, size_px: tuple[int, int]) -> bool:
    """Return True if the missing lines may lie outside the image or cross its border."""
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


def polylines(nodes_px: Float) -> list[list[float]]:
    """Return the lattice's lines from end to end, [x0, y0, x1, y1] each, for a picture."""
    ends = [(line[0], line[-1]) for line in nodes_px] + [(line[0], line[-1]) for line in np.swapaxes(nodes_px, 0, 1)]
    return [[round(float(v), 1) for v in (*p, *q)] for p, q in ends]


def saturation_level(image: NDArray[Any]) -> float:
    """Grey level at which the sensor saturates; infinite where it is not known.

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
    """Return the same error, named after the glare where saturated pixels can have hidden the lines."""
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


def check_pieces(
    table: PieceTable, fits: Float, target: GridTarget, saturation: float
) -> tuple[Bool, NDArray[np.str_]]:
    """Distinguish good pieces from spoilt ones.

    Returns
    -------
    good, cause
        (n,) and (n,) of ``""``, ``"dirt"``, ``"glare"``.
    """
    sign = -1.0 if target.dark_lines else 1.0
    ok = fits[:, OUT["ok"]] > 0.0
    depth = np.where(ok, sign * fits[:, OUT["amplitude"]] * fits[:, OUT["peak"]], np.nan)
    typical = _smooth(table, depth)
    ground = _smooth(table, fits[:, OUT["ground"]])
    rms = fits[:, OUT["rms"]]
    with np.errstate(invalid="ignore"):
        fits_shape = rms < _RMS_RATIO * np.nanmedian(rms) + 0.02 * np.abs(typical)
        seen = (depth > _DEPTH_RANGE[0] * typical) & (depth < _DEPTH_RANGE[1] * typical)
        certain = np.sqrt(fits[:, OUT["var_c0"]]) < _MIN_CERTAIN * (fits[:, OUT["width"]] + fits[:, OUT["blur"]])
        # clipped peaks of the noise do no harm; a level that is itself within the noise of the limit does
        level = fits[:, OUT["ground"]] + (0.0 if target.dark_lines else depth)
        saturated = (fits[:, OUT["brightest"]] >= saturation) & ~(level + rms < saturation)
        glaring = saturated | (~seen & (fits[:, OUT["ground"]] - ground > _GLARE_RISE * np.abs(typical)))
    good = ok & fits_shape & seen & certain & ~saturated
    cause = np.where(good, "", np.where(glaring, "glare", "dirt"))
    return good, cause


def _smooth(table: PieceTable, values: Float) -> Float:
    """Quadratic over the image through the values, robust to outliers (two rounds of clipping), (n,)."""
    x, y = table.rows[:, IN["x"]], table.rows[:, IN["y"]]
    u, v = (x - x.mean()) / x.std(), (y - y.mean()) / y.std()
    J = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    keep = np.isfinite(values)
    middle = float(np.median(values[keep])) if keep.any() else np.nan
    keep &= np.abs(values - middle) < 0.7 * abs(middle)
    out = np.full(len(values), middle)
    for _ in range(3):
        if np.count_nonzero(keep) < 30:
            break
        out = J @ np.linalg.lstsq(J[keep], values[keep], rcond=None)[0]
        off = np.abs(values - out)
        keep = np.isfinite(values) & (off < 4.0 * MAD_TO_SIGMA * np.median(off[keep]) + 1e-3 * abs(middle))
    return out


def check_coverage(table: PieceTable, good: Bool, cause: NDArray[np.str_], options: GridOptions) -> None:
    """Raise an error for a grid of which too much is spoilt.

    Raises
    ------
    TargetError
        ``target_dirty`` or ``target_glare``, whichever spoils more.
    """
    bad = ~good
    share = float(bad.mean())
    index = table.line_index()
    per_line = np.bincount(index, weights=bad) / np.bincount(index)
    if share <= options.max_bad_fraction and per_line.max() <= options.max_bad_on_line:
        return
    glare = np.count_nonzero(cause == "glare") >= np.count_nonzero(cause == "dirt")
    worst = int(np.argmax(per_line))
    na = table.counts[0]
    name = f"line {worst} of family a" if worst < na else f"line {worst - na} of family b"
    defect = "is glaring (saturated or without contrast)" if glare else "is covered, dirty or unsharp"
    raise TargetError(
        f"{np.count_nonzero(bad)} of {len(bad)} pieces of lines cannot be used (at most"
        f" {options.max_bad_fraction:.0%}), {per_line[worst]:.0%} of {name} (at most"
        f" {options.max_bad_on_line:.0%}); most of it {defect}",
        code="target_glare" if glare else "target_dirty",
        remedy="Take the reflection or the overexposure away: light the grid from behind, close the aperture."
        if glare
        else "Clean the grid, take away what covers it, and focus on it.",
        bad=int(np.count_nonzero(bad)),
        pieces=len(bad),
        worst_line=name,
        segments_px=[[round(float(v), 1) for v in ends.ravel()] for ends in table.ends_px()[bad]],
    )


def check_regular(straight_px: Float, nodes_px: Float, target: GridTarget) -> None:
    """Raise an error for numbered lines that are no image of a regular grid.

    Raises
    ------
    TargetError
        ``target_irregular``.
    """
    na, nb = target.lines
    grid = np.stack(np.meshgrid(np.arange(na), np.arange(nb), indexing="ij"), axis=-1).astype(np.float64).reshape(-1, 2)
    image = straight_px.reshape(-1, 2)
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
