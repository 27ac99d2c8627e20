"""Options and results of grid detection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.target import GridTarget

Localiser = Literal["profile", "paper"]
LineModel = Literal["straight", "parabola", "local"]
Orientation = Literal["diagonal", "upright"]


@dataclass(frozen=True, kw_only=True)
class GridOptions:
    """Options of grid detection.

    Attributes
    ----------
    line_model
        Model of a line through its pieces. ``straight``: all lines are straight but for one common lens distortion,
        found from the lines themselves; it averages the maker's node errors best. ``parabola``: one non-oblique
        parabola a line, as in the paper. ``local``: each intersection from the pieces next to it only, which keeps the
        node errors visible to an adjustment that solves for them. None takes ``straight`` for the profile localiser,
        ``parabola`` for the paper's.
    saturation
        Grey level at which the sensor saturates; None finds it from the type and the image itself.
    max_bad_fraction
        Part of all line pieces that dirt, glare or a cover may spoil: 66 pieces of an 11 x 11 grid are three for each
        line, which has two numbers.
    max_bad_on_line
        Part of one line's pieces that may be spoilt; a line of which more is has no intersections.
    orientation
        Which of the four ways of indexing a grid without marks is taken. ``diagonal``: X_sys runs right and down, at
        more than 0 and up to 90 degrees from the rows. ``upright``: X_sys is the direction nearest to the rows, to the
        right, at more than -45 and up to 45 degrees. Between 0 and 45 degrees both are the same. None: X_sys at more
        than -23 and up to 67 degrees, so that small differences of two cameras' rolls change the index nowhere but
        there; a caller that knows how the other camera saw the grid names the orientation. See
        :func:`stereorig.core.grid.lattice.oriented`.
    """

    line_model: LineModel | None = None
    saturation: float | None = None
    max_bad_fraction: float = 0.7
    max_bad_on_line: float = 0.7
    orientation: Orientation | None = None


@dataclass(frozen=True, kw_only=True)
class LineOffsets:
    """Noise of the ``local`` model's inner intersections, line by line.

    Each line is a polygon whose corners are its intersections: neighbouring corners share the pieces between them, so
    that their offsets across the line are correlated (about -0.2). Offsets of different lines are independent. With the
    rows N = [normal_a; normal_b] at an intersection,

        N (xy_found - xy_true) = (offset across its line of family a, offset across its line of family b).

    Attributes
    ----------
    normal_a, normal_b
        (n_a - 2, n_b - 2, 2) unit vector in the image across the line of family a, and of family b, at each
        intersection [i along X_sys, j along Y_sys].
    covariance_a
        (n_a - 2, n_b - 2, n_b - 2) px^2: of inner line i of family a, between its offsets at intersections j and j'.
    covariance_b
        (n_b - 2, n_a - 2, n_a - 2) px^2: of inner line j of family b, between its offsets at intersections i and i'.
        Both with the corners on the outermost lines marginalised.
    """

    normal_a: Float
    normal_b: Float
    covariance_a: Float
    covariance_b: Float


@dataclass(frozen=True, kw_only=True)
class GridView:
    """The grid detected in one image.

    A grid without marks looks the same when turned by 90 or 180 degrees or mirrored: no single image distinguishes
    them. The indices here follow the image (X_sys to the right and Y_sys down, turned clockwise by ``rotation_rad``,
    see ``GridOptions.orientation``), so both cameras give the same physical corner the same index as long as both
    images are upright. A turned or mirrored image is detected in the calibration, whose angles then disagree with the
    nominal rig.

    Attributes
    ----------
    target
        The description it was found by.
    xy_px
        (n_a - 2, n_b - 2, 2) inner intersections, indexed [i along X_sys, j along Y_sys]; NaN on a line that is missing
        or of which too little is seen.
    covariance_px2
        (n_a - 2, n_b - 2, 2, 2) of each intersection, from the image's own noise; without the maker's node errors.
    localiser, line_model
        Localiser and line model used.
    image_size_px
        Columns, rows.
    noise
        Grey levels, standard deviation of the line profiles' residuals.
    contrast
        Grey levels, median depth of a line of full width against its ground.
    background
        Grey levels, median of the ground next to the lines.
    blur_px
        Median standard deviation of lens blur and line edge, without the pixel's own integration.
    line_width_px
        Median width of a line, across it.
    pitch_px
        Median distance of neighbouring intersections.
    threshold
        Part of the local contrast at which the image was made binary.
    rotation_rad
        Rotation of the grid in the image, near alpha of Eq. (1): the turn of X_sys from the rows, clockwise as one sees
        the image.
    fit_rms_px
        Rms residual of the line pieces across the lines after the line model's fit.
    pieces_px
        (n, 2, 2) end points of the line pieces used, for pictures.
    pieces_used
        (n,) False for a piece that dirt or glare spoilt.
    line_offsets
        Joint covariance of the intersections of each line under the ``local`` model; None under the other models,
        whose intersections all share the lines' few numbers.
    """

    target: GridTarget
    xy_px: Float
    covariance_px2: Float
    localiser: Localiser
    line_model: LineModel
    image_size_px: tuple[int, int]
    noise: float
    contrast: float
    background: float
    blur_px: float
    line_width_px: float
    pitch_px: float
    threshold: float
    rotation_rad: float
    fit_rms_px: float
    pieces_px: Float
    pieces_used: Bool
    line_offsets: LineOffsets | None = None

    @property
    def sigma_px(self) -> Float:
        """Standard deviation of each intersection per axis, (n_a - 2, n_b - 2, 2)."""
        return np.sqrt(np.stack([self.covariance_px2[..., 0, 0], self.covariance_px2[..., 1, 1]], axis=-1))

    @property
    def object_points_mm(self) -> Float:
        """Nominal positions of the intersections, (n_a - 2, n_b - 2, 2) X_sys, Y_sys, mm."""
        return self.target.inner_points_mm()
