"""Intersections from line points: three models of a line through its pieces.

``straight``: the lines of the grid are straight, and one smooth distortion, the same for all, bends them in the image.
In corrected coordinates v = u + sum_m D_m f_m(u) each line is straight; f_m holds Seidel's term for any aspect ratio,
r^2 u and (x^2 - y^2) u, its shift by a wrong centre, r^2 e_x and r^2 e_y, and, where the lines ask for them, higher
powers. The condition is linear in D and in each line's two numbers. Terms that map straight lines to straight lines
have no effect and are not needed.

``parabola``: each line by itself, offset = p0 + p1 t + p2 t^2.

``local``: on top of the straight model, each line is a polygon whose corners are the intersections.
"""

from __future__ import annotations

from stereorig.core.arrays import Bool
from stereorig.core.grid.lines.parabolas import fit_parabolas
from stereorig.core.grid.lines.points import LineFit, LinePoints
from stereorig.core.grid.lines.polygons import fit_polygons
from stereorig.core.grid.lines.straight import fit_straight
from stereorig.core.grid.view import LineModel

__all__ = ["LineFit", "LinePoints", "fit_lines"]


def fit_lines(
    points: LinePoints,
    *,
    counts: tuple[int, int],
    image_size_px: tuple[int, int],
    model: LineModel,
    node_sigma_px: float,
    used: Bool,
) -> LineFit:
    """Fit all lines and meet them.

    Parameters
    ----------
    points
        Line points; those with ``used`` False get a residual but no weight.
    counts
        (n_a, n_b) lines.
    image_size_px
        Columns and rows, for the distortion's centre and scale.
    model
        See the module.
    node_sigma_px
        Standard deviation across a line of the maker's node errors, which the models of whole lines average.
    used
        (n,) points to use.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a line has too few points.
    """
    if model == "parabola":
        return fit_parabolas(points, counts, node_sigma_px, used)
    fit, distortion, normal = fit_straight(points, counts, image_size_px, node_sigma_px, used)
    if model == "straight":
        return fit
    return fit_polygons(points, counts, fit, distortion, normal, used)
