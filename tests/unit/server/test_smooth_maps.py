"""Maps between the points: the page's rule, and colours on one scale whatever the steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stereorig.core.field.region.cuts import Cuts
from stereorig.server.exports.request import ExportRequest
from stereorig.server.exports.run import export
from stereorig.server.exports.source import find_source
from stereorig.server.formats.figures.colours import colour_map
from stereorig.server.formats.figures.options import COLOURS, FigureStyle
from stereorig.server.formats.figures.smooth import between_points
from tests.support.export_results import write_results

EACH = 4
X_PX, Y_PX = np.meshgrid(np.arange(50.0, 130.0, 10.0), np.arange(40.0, 100.0, 10.0))
PLANE = 2.0 * X_PX - 3.0 * Y_PX + X_PX * Y_PX / 100.0  # which bilinear cells keep


def places() -> tuple[Any, Any]:
    """Where the samples lie."""
    share = (np.arange(EACH) + 0.5) / EACH * 10.0
    x = (np.arange(50.0, 120.0, 10.0)[:, None] + share).ravel()
    y = (np.arange(40.0, 90.0, 10.0)[:, None] + share).ravel()
    return np.meshgrid(x, y)


def test_between_four_points_a_bilinear_field_is_kept() -> None:
    x, y = places()
    found = between_points(PLANE, X_PX, Y_PX, None, EACH)
    np.testing.assert_allclose(found, 2.0 * x - 3.0 * y + x * y / 100.0, rtol=1e-12)


def test_three_corners_carry_their_half_and_nothing_else_is_filled_in() -> None:
    values = (2.0 * X_PX - 3.0 * Y_PX).copy()
    values[2, 3] = np.nan  # at (80, 60)
    x, y = places()
    found = between_points(values, X_PX, Y_PX, None, EACH)
    # of each of the four cells about it, the half at the missing point is empty
    lost = np.abs(x - 80.0) + np.abs(y - 60.0) < 10.0 - 1e-9
    np.testing.assert_array_equal(np.isnan(found), lost)
    np.testing.assert_allclose(found[~lost], (2.0 * x - 3.0 * y)[~lost], rtol=1e-12)


def test_nothing_reaches_over_a_cut() -> None:
    values = np.where(X_PX < 85.0, 0.0, 1.0)
    line = Cuts([[(84.0, 0.0), (84.0, 65.0)]])
    x, y = places()
    found = between_points(values, X_PX, Y_PX, line, EACH)
    beside = y < 60.0  # above the cell in which it ends
    assert set(np.unique(found[beside & np.isfinite(found)])) == {0.0, 1.0}
    assert np.isnan(found[beside & (np.abs(x - 85.0) < 4.9)]).any()
    assert np.isfinite(found[(y > 70.0)]).all()  # below it the field is whole


def test_a_point_without_neighbours_is_a_dot() -> None:
    values = np.full(X_PX.shape, np.nan)
    values[2, 3] = 7.0
    x, y = places()
    found = between_points(values, X_PX, Y_PX, None, EACH)
    assert found[np.isfinite(found)].tolist() == [7.0] * 4
    assert np.hypot(x - 80.0, y - 60.0)[np.isfinite(found)].max() < 2.5


@pytest.mark.parametrize("name", COLOURS)
def test_bands_have_one_colour_each_and_a_map_can_be_reversed(name: str) -> None:
    smooth = colour_map(name).colors
    bands = colour_map(name, 5).colors
    assert len(np.unique(bands, axis=0)) == 5
    np.testing.assert_allclose(bands[[0, -1]], np.asarray(smooth)[[0, -1]])
    np.testing.assert_allclose(colour_map(name, reverse=True).colors, smooth[::-1])


def test_the_diverging_map_is_lightest_at_zero_and_equally_dark_at_both_ends() -> None:
    # relative luminance of the sRGB standard
    colours = np.asarray(colour_map("diverging").colors)
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    light = linear @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light[:128]) > 0).all()
    assert (np.diff(light[128:]) < 0).all()
    assert light[0] == pytest.approx(light[-1], abs=0.03)  # OKLab's lightness is not quite luminance


def test_the_frames_of_a_film_are_the_figures_of_its_steps(tmp_path: Path) -> None:
    write_results(tmp_path / "panel", 4)
    source = find_source(tmp_path / "panel")
    style = FigureStyle(limits=(-0.01, 0.01), width_px=400)
    out = tmp_path / "out"
    out.mkdir()
    (film,) = export(source, ExportRequest("gif", variables=["u_mm"], style=style), out)
    pictures = list(export(source, ExportRequest("png", variables=["u_mm"], style=style), out))
    with Image.open(film) as opened:
        assert opened.n_frames == len(pictures) == 3  # type: ignore[attr-defined]
        for k, path in enumerate(pictures):
            opened.seek(k)
            seen = np.asarray(opened.convert("RGB")).astype(int)
            wanted = np.asarray(Image.open(path).convert("RGB")).astype(int)[: seen.shape[0], : seen.shape[1]]
            # a palette of 255 for each frame: a colour is off by a step or two of it
            assert np.abs(seen - wanted).mean() < 3.0
        # the bar is no stair: as many colours as it has to be smooth for the eye
        right = int(0.8 * wanted.shape[1])
        at = right + int(np.argmax((np.ptp(wanted[:, right:], axis=2) > 12).sum(axis=0)))
        count = [len(np.unique(of[:, at], axis=0)) for of in (seen, wanted)]
        assert count[1] > 150
        assert count[0] > 0.25 * count[1]
