"""Detection of the grid in one image: coarse lattice, sub-pixel pieces, lines, intersections, and checks."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.errors import TargetError
from stereorig.core.grid.checks import (
    blame_glare,
    blame_tilt,
    check_lattice,
    check_oblique,
    check_pieces,
    check_regular,
    lines_kept,
    saturation_level,
)
from stereorig.core.grid.dark_pixels import THRESHOLD, dark_pixel_lines, meet_non_oblique
from stereorig.core.grid.directions import directions
from stereorig.core.grid.lattice import LineLattice, find_lattice, not_found, oriented, pitch_px
from stereorig.core.grid.lines import LineFit, fit_lines
from stereorig.core.grid.misfit import without_misfit
from stereorig.core.grid.piece_table import Kept, PieceTable, filled, line_points, piece_table, spread
from stereorig.core.grid.profile import OUT, fit_pieces
from stereorig.core.grid.seen import check_missing, completed
from stereorig.core.grid.threshold import LinePicture, checked_image, coarse_factors, line_picture
from stereorig.core.grid.view import GridOptions, GridView, LineModel, LineOffsets, Localiser
from stereorig.core.robust import MAD_TO_SIGMA
from stereorig.core.target import GridTarget

_OUTLIER = 6.0  # standard deviations at which a line point is an outlier
_ROUNDS = 3
_CLEAR_DEPTH = 3.0  # multiple of the noise, at which lines are lines for any target
_LEAST_SHOWN = 5  # lines each way
# share of the pieces between a line grid's intersections that must be lines, and of its cells that must not
_LINED = 0.8


def detect_grid(
    image: NDArray[Any], target: GridTarget, *, localiser: Localiser = "profile", options: GridOptions | None = None
) -> GridView:
    """Find the grid's intersections with no start values but the target's description.

    Parameters
    ----------
    image
        (rows, columns) gray image, any unsigned, signed or float type, as the camera gave it.
    target
        Description of the grid.
    localiser
        ``profile``: maximum-likelihood fit of a blurred line's profile. ``paper``: dark pixels weighted by their
        distance from the threshold, and non-oblique parabolas.
    options
        See :class:`GridOptions`.

    Returns
    -------
    GridView
        Intersections in pixels, indexed as in :class:`GridView`.

    Raises
    ------
    ImageError
        ``image_unsupported``, ``image_unusable``: no gray image.
    TargetError
        ``target_not_found``: no two families of lines. ``target_rotated``: counts swapped, or lines along rows and
        columns with the paper's localiser. ``target_line_count``: another number of lines than described.
        ``target_partly_seen``: the grid leaves the image. ``target_line_missing``: other lines are missing than
        declared. ``target_dirty``, ``target_glare``, ``target_noisy``: too few pieces of lines are left.
        ``target_too_small``: lines seen too obliquely. ``target_irregular``: lines that are no regular grid. The
        error's context holds the figures, and ``segments_px`` for a picture if there are any.

    Notes
    -----
    Lines may run at any angle. A grid without marks looks the same when turned by 90 or 180 degrees or mirrored, see
    :class:`GridView`: lines at about 45 degrees are indexed with X_sys right and down and Y_sys left and down, lines
    along the rows and columns with X_sys to the right and Y_sys down; ``GridOptions.orientation`` has the rule between.

    References
    ----------
    Helm, McNeill, Sutton, "Improved three-dimensional image correlation for surface displacement measurement", Opt.
    Eng. 35 (1996), doi:10.1117/1.600624, section 3.2.2.
    """
    opts = GridOptions() if options is None else options
    if localiser not in ("profile", "paper"):
        raise ValueError(f"localiser must be 'profile' or 'paper', got {localiser!r}")
    model: LineModel = opts.line_model or ("straight" if localiser == "profile" else "parabola")
    if localiser == "paper" and model != "parabola":
        raise ValueError(f"the paper's localiser fits parabolas; line_model {model!r} needs the profile localiser")
    grey = checked_image(image)
    size = (grey.shape[1], grey.shape[0])
    saturation = opts.saturation if opts.saturation is not None else saturation_level(image)
    try:
        lattice, picture = _coarse(grey, target, opts)
        check_lattice(lattice, target, size)
        check_missing(picture, grey, lattice, target)
        if localiser == "paper":
            check_oblique(lattice)
    except TargetError as error:
        raise blame_glare(error, grey, saturation) from error
    nodes = lattice.nodes_px
    try:
        # first from the coarse lines, with a search across; then from the fitted lines, with their blur
        coarse = _measure(grey, nodes, target, saturation, opts, model="straight", blur_px=None, floor_px=0.05)
        found = _measure(
            grey, coarse.nodes_px, target, saturation, opts, model=model, blur_px=coarse.blur_px, floor_px=0.015
        )
        nodes, covariance = found.fit.nodes_px, found.fit.covariance_px2
        if localiser == "paper":
            table, own = found.table.of_lines(found.kept)
            parabolas = dark_pixel_lines(grey, table, found.fits[own], found.good[own], dark_lines=target.dark_lines)
            nodes, covariance = meet_non_oblique(parabolas, nodes)
    except np.linalg.LinAlgError as error:
        raise TargetError(
            f"a line of the grid cannot be fitted: {error}",
            code="target_dirty",
            remedy="Clean the grid and focus on it.",
        ) from error
    except TargetError as error:
        raise blame_tilt(error, lattice) from error
    check_regular(found.fit.straight_px, nodes, target, found.kept)
    good, fits = found.good, found.fits
    residual = found.fit.residual_px[found.used]
    return GridView(
        target=target,
        xy_px=np.ascontiguousarray(spread(nodes, found.kept, target.lines)[1:-1, 1:-1]),
        covariance_px2=np.ascontiguousarray(spread(covariance, found.kept, target.lines)[1:-1, 1:-1]),
        localiser=localiser,
        line_model=model,
        image_size_px=size,
        noise=float(np.median(fits[good, OUT["rms"]])),
        contrast=float(np.median(np.abs(fits[good, OUT["amplitude"]]))),
        background=float(np.median(fits[good, OUT["ground"]])),
        blur_px=found.blur_px,
        line_width_px=float(np.median(fits[good, OUT["width"]])),
        pitch_px=pitch_px(filled(nodes, found.kept, target.lines)),
        threshold=THRESHOLD if localiser == "paper" else picture.threshold,
        rotation_rad=lattice.rotation_rad,
        fit_rms_px=float(np.sqrt(np.mean(residual**2))),
        pieces_px=found.table.ends_px(),
        pieces_used=good,
        line_offsets=_inner_offsets(found.fit.line_offsets, found.kept, target.lines),
    )


def find_grid(image: NDArray[Any], target: GridTarget, *, options: GridOptions | None = None) -> Float:
    """Find the grid's inner intersections coarsely, for a live picture: within about half a pixel of the image's own.

    Parameters
    ----------
    image, target, options
        As for :func:`detect_grid`.

    Returns
    -------
    Float
        (n_a - 2, n_b - 2, 2) px, indexed as :func:`detect_grid` does.

    Raises
    ------
    ImageError, TargetError
        As :func:`detect_grid`, without its checks for dirt and glare on single pieces.
    """
    opts = GridOptions() if options is None else options
    grey = checked_image(image)
    lattice, _ = _coarse(grey, target, opts)
    check_lattice(lattice, target, (grey.shape[1], grey.shape[0]))
    return np.ascontiguousarray(lattice.nodes_px[1:-1, 1:-1])


def lines_shown(image: NDArray[Any]) -> Float | None:
    """Return the intersections (m_a, m_b, 2) of a line grid of any counts in an image, None without one."""
    grey = checked_image(image)
    for dark in (True, False):
        for width in (0.03, 0.1):
            target = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=width, dark_lines=dark)
            for factor in coarse_factors((grey.shape[1], grey.shape[0]), target)[:2]:
                picture = line_picture(grey, target, factor)
                if picture.threshold < _CLEAR_DEPTH * picture.noise:
                    continue
                try:
                    nodes = find_lattice(picture, directions(picture)).nodes_px
                except (TargetError, np.linalg.LinAlgError):
                    continue
                if min(nodes.shape[:2]) >= _LEAST_SHOWN and _lines_between(picture, nodes):
                    return nodes
    return None


def _lines_between(picture: LinePicture, nodes_px: Float) -> bool:
    """Return True if nearly all pieces between intersections are dark and nearly all cells are not."""
    middles = [0.5 * (nodes_px[1:] + nodes_px[:-1]), 0.5 * (nodes_px[:, 1:] + nodes_px[:, :-1])]
    cells = 0.25 * (nodes_px[1:, 1:] + nodes_px[1:, :-1] + nodes_px[:-1, 1:] + nodes_px[:-1, :-1])
    # a coarse line may be a pixel off
    mask = cv2.dilate(picture.mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)

    def share(places: Float, values: Bool) -> float:
        at = np.rint((places.reshape(-1, 2) + 0.5) / picture.factor - 0.5).astype(int)
        inside = ((at >= 0) & (at < np.array(values.shape[::-1]))).all(axis=1)
        x, y = at[inside].T
        return float(values[y, x].mean()) if inside.any() else 0.0

    lined = min(share(middle, mask) for middle in middles)
    return lined > _LINED and share(cells, picture.mask) < 1.0 - _LINED


def _inner_offsets(offsets: LineOffsets | None, kept: Kept, counts: tuple[int, int]) -> LineOffsets | None:
    """Return the offsets of the inner intersections, without covariance on lines that are not measured."""
    if offsets is None:
        return None
    a, b = (own[(own > 0) & (own < n - 1)] for own, n in zip(kept, counts, strict=True))
    i, j = (np.flatnonzero(np.isin(own, inner)) for own, inner in zip(kept, (a, b), strict=True))
    n_a, n_b = counts[0] - 2, counts[1] - 2
    normal_a, normal_b = (np.tile(direction, (n_a, n_b, 1)) for direction in np.eye(2))
    covariance_a, covariance_b = np.zeros((n_a, n_b, n_b)), np.zeros((n_b, n_a, n_a))
    normal_a[np.ix_(a - 1, b - 1)] = offsets.normal_a[np.ix_(i, j)]
    normal_b[np.ix_(a - 1, b - 1)] = offsets.normal_b[np.ix_(i, j)]
    covariance_a[np.ix_(a - 1, b - 1, b - 1)] = offsets.covariance_a[np.ix_(i, j, j)]
    covariance_b[np.ix_(b - 1, a - 1, a - 1)] = offsets.covariance_b[np.ix_(j, i, i)]
    return LineOffsets(normal_a=normal_a, normal_b=normal_b, covariance_a=covariance_a, covariance_b=covariance_b)


def _coarse(grey: Float32, target: GridTarget, options: GridOptions) -> tuple[LineLattice, LinePicture]:
    """Find the lattice at the scale that shows all its lines; else the one with the most of them."""
    best: tuple[LineLattice, LinePicture] | None = None
    pictures: list[LinePicture] = []
    failure: TargetError | None = None
    for factor in coarse_factors((grey.shape[1], grey.shape[0]), target):
        picture = line_picture(grey, target, factor)
        # the depth filled by chance is well below the noise's own standard deviation
        if picture.threshold < picture.noise / max(factor, 1.0):
            failure = failure or not_found(
                f"no lines: the deepest structures are {picture.clearness:.3g} times as deep as the noise of"
                f" {picture.noise:.3g} grey levels",
                remedy="Show the whole target in focus; if it is there, average several images or give more light.",
            )
            continue
        pictures.append(picture)
        try:
            lattice = oriented(find_lattice(picture, directions(picture)), options.orientation, target.lines)
        except TargetError as error:
            failure = failure or error
            continue
        if lattice.counts == target.lines:
            return lattice, picture
        if best is None or sum(lattice.counts) > sum(best[0].counts):
            best = lattice, picture
    # lines that are missing or covered: the pieces of one line may be far apart, and lines may be skipped
    for picture in pictures if best is None or (np.array(best[0].counts) <= target.lines).all() else ():
        try:
            lattice = find_lattice(picture, directions(picture), broken=True)
        except TargetError:
            continue
        whole = completed(picture, grey, oriented(lattice, options.orientation, target.lines), target)
        if whole is not None:
            return whole, picture
    if best is None:
        raise failure if failure is not None else not_found("nothing was tried")
    return best


class _Measured(NamedTuple):
    """Pieces of all lines with their fits; the lines kept, their fit, and the points that it used."""

    table: PieceTable
    fits: Float
    good: Bool
    kept: Kept
    fit: LineFit
    used: Bool
    nodes_px: Float
    blur_px: float


def _measure(
    grey: Float32,
    nodes_px: Float,
    target: GridTarget,
    saturation: float,
    options: GridOptions,
    *,
    model: LineModel,
    blur_px: float | None,
    floor_px: float,
) -> _Measured:
    """Fit the pieces between given intersections, check them, and fit the lines.

    ``floor_px``: a piece with a residual of a few times this at most is no outlier, at any noise.
    """
    node_sigma_px = target.node_tolerance_mm / np.sqrt(3.0) * pitch_px(nodes_px) / target.pitch_mm
    table = piece_table(nodes_px, target, blur_px=blur_px)
    fits = fit_pieces(grey, table.rows, dark_lines=target.dark_lines)
    # a parabola through two pieces has no noise of its own
    least = 4 if model == "parabola" else 2
    try:
        good, cause = check_pieces(table, fits, target, saturation, strict=True)
        lines_kept(table, good, cause, target, options, least_pieces=least)
    except TargetError:
        # no piece of a very dirty grid may be sound, but those little spoilt have their spoilt noise as theirs
        good, cause = check_pieces(table, fits, target, saturation, strict=False)
    if blur_px is not None:
        fits = without_misfit(grey, table.rows, fits, family=table.family, good=good)
    every = line_points(table, fits, good)
    size = (grey.shape[1], grey.shape[0])
    fitting = good
    for _ in range(_ROUNDS):
        kept = lines_kept(table, fitting, cause, target, options, least_pieces=least)
        pp = every.of_lines(kept, target.lines)
        used = fitting[pp.piece]
        fit = fit_lines(
            pp.points,
            counts=(len(kept[0]), len(kept[1])),
            image_size_px=size,
            model=model,
            node_sigma_px=node_sigma_px,
            used=used,
        )
        z = np.abs(fit.residual_px) / np.sqrt(fit.variance_px2 + floor_px**2)
        # a grid worse than described spreads all points: their own standard deviation is the scale then
        limit = _OUTLIER * max(1.0, MAD_TO_SIGMA * float(np.median(z[used])))
        spoilt = np.unique(pp.piece[z > limit])
        before, fitting = fitting, good.copy()
        fitting[spoilt] = False
        if (fitting == before).all():
            break
        cause = np.where(good & ~fitting, "dirt", cause)
    used_pieces = np.zeros(len(good), dtype=bool)
    used_pieces[pp.piece[used]] = True
    blur = float(np.median(fits[used_pieces, OUT["blur"]]))
    nodes = filled(fit.nodes_px, kept, target.lines)
    return _Measured(table, fits, used_pieces, kept, fit, used, nodes, blur)
