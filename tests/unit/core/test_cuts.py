"""Lines that part a surface: what meets them is found exactly, by an independent count in whole numbers."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from stereorig.core.errors import RegionError
from stereorig.core.field.region.cuts import Cuts, as_arrays, crosses, from_arrays

Point = tuple[int, int]


def share_a_point(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Solve a + s (b - a) = c + t (d - c) in fractions; parallel ones by their ends along each other."""
    ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], d[0] - c[0], d[1] - c[1]
    wx, wy = c[0] - a[0], c[1] - a[1]
    det = ux * vy - uy * vx
    if det != 0:
        s, t = Fraction(wx * vy - wy * vx, det), Fraction(wx * uy - wy * ux, det)
        return 0 <= s <= 1 and 0 <= t <= 1
    if (ux, uy) == (0, 0):
        if (vx, vy) == (0, 0):
            return a == c
        return share_a_point(c, d, a, a) if wx * vy - wy * vx == 0 else False
    if wx * uy - wy * ux != 0:
        return False
    ends = sorted(Fraction((p[0] - a[0]) * ux + (p[1] - a[1]) * uy, ux * ux + uy * uy) for p in (c, d))
    return bool(ends[0] <= 1 and ends[1] >= 0)


def test_crosses_agrees_with_fractions_on_a_small_lattice() -> None:
    """On a lattice of six by six points touching ends, common lines and single points all come up."""
    rng = np.random.default_rng(3)
    for _ in range(60):
        line = rng.integers(0, 6, (rng.integers(2, 5), 2))
        if not np.ptp(line, axis=0).any():
            continue
        a, b = rng.integers(0, 6, (2, 200, 2))
        b[:20] = a[:20]
        found = crosses(a, b, Cuts([line]))
        pieces = [(tuple(map(int, c)), tuple(map(int, d))) for c, d in pairwise(line)]
        lines = zip(a.tolist(), b.tolist(), strict=True)
        expected = [any(share_a_point(tuple(p), tuple(q), c, d) for c, d in pieces) for p, q in lines]
        np.testing.assert_array_equal(found, expected)


def test_crossing_has_no_direction_and_broadcasts() -> None:
    rng = np.random.default_rng(4)
    cuts = Cuts([[(10.5, 3.25), (40.0, 33.3), (60.0, 20.0)], [(0.0, 50.0), (70.0, 50.0)]])
    a, b = rng.uniform(0, 70, (2, 20_000, 2))
    met = crosses(a, b, cuts)
    assert 0.3 < met.mean() < 0.9
    np.testing.assert_array_equal(met, crosses(b, a, cuts))
    one = crosses(a[:4, None], b[None, :5], cuts)
    assert one.shape == (4, 5)
    np.testing.assert_array_equal(one[2], crosses(np.tile(a[2], (5, 1)), b[:5], cuts))
    assert not crosses(a, b, None).any()
    assert not crosses(a, b, Cuts([])).any()
    assert not crosses([[np.nan, 1.0]], [[5.0, 90.0]], cuts).any()


@pytest.mark.parametrize(
    "line", [[(1.0, 2.0)], [(1.0, 2.0), (1.0, 2.0)], [(1.0, 2.0), (np.inf, 3.0)], [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)], 7]
)
def test_a_line_that_is_none_is_refused(line: object) -> None:
    with pytest.raises(RegionError) as caught:
        Cuts([line])  # type: ignore[list-item]
    assert caught.value.code == "cut_invalid"
    assert caught.value.remedy


def test_cuts_come_back_from_arrays() -> None:
    cuts = Cuts([[(1.0, 2.0), (3.0, 4.5)], [(5.0, 6.0), (7.0, 8.0), (9.0, 1.0)]])
    back = from_arrays(*as_arrays(cuts))
    assert [line.tolist() for line in back.lines_px] == [line.tolist() for line in cuts.lines_px]
    assert cuts.pieces_px.tolist() == [[1.0, 2.0, 3.0, 4.5], [5.0, 6.0, 7.0, 8.0], [7.0, 8.0, 9.0, 1.0]]
