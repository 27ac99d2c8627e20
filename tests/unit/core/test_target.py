"""The target's description and its frame."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.errors import TargetError
from stereorig.core.target import GridTarget


def test_inner_points_of_the_papers_grid() -> None:
    target = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03, node_tolerance_mm=0.004)
    points = target.inner_points_mm()
    assert points.shape == (9, 9, 2)
    np.testing.assert_allclose(points[0, 0], [-4.0, -4.0])
    np.testing.assert_allclose(points[8, 0], [4.0, -4.0])  # first index runs along X_sys
    np.testing.assert_allclose(points[4, 4], [0.0, 0.0])


def test_origin_lies_at_the_centre_of_the_full_set_for_even_and_unequal_counts() -> None:
    points = GridTarget(pitch_mm=2.0, lines=(10, 7), line_width_mm=0.1).all_points_mm()
    assert points.shape == (10, 7, 2)
    np.testing.assert_allclose(points.mean(axis=(0, 1)), [0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(points[0, 0], [-9.0, -6.0])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("pitch_mm", 0.0),
        ("pitch_mm", float("nan")),
        ("lines", (4, 11)),
        ("lines", (11,)),
        ("lines", (11.5, 11)),
        ("line_width_mm", 0.0),
        ("line_width_mm", 0.6),
        ("node_tolerance_mm", -0.001),
        ("node_tolerance_mm", float("nan")),
    ],
)
def test_numbers_that_make_no_grid_are_refused(field: str, value: object) -> None:
    good: dict[str, object] = {"pitch_mm": 1.0, "lines": (11, 11), "line_width_mm": 0.03}
    with pytest.raises(TargetError) as error:
        GridTarget(**(good | {field: value}))  # type: ignore[arg-type]
    assert error.value.code == "target_invalid"
    assert field in error.value.cause or field == "lines"
