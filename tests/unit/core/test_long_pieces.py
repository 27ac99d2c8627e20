"""Pieces of lines in images of many pixels: located as well as noise allows, from wherever they are started."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from stereorig.core.grid.profile import OUT, fit_pieces
from stereorig.core.grid.strip import IN, INPUTS

WIDTH_PX, BLUR_PX, NOISE, DEPTH = 17.6, 1.7, 3.0, 120.0
LENGTH_PX, ANGLE = 200.0, 0.2
SIZE = (260, 120)
MIDDLE = np.array([130.3, 59.8])
SUB = 4


def line_image(off_px: float) -> np.ndarray:
    """A dark line, blurred by a Gaussian, averaged over 4 x 4 samples a pixel."""
    along = np.array([np.cos(ANGLE), np.sin(ANGLE)])
    x, y = (np.arange(n * SUB) / SUB - 0.5 + 0.5 / SUB for n in SIZE)
    d = -(x[None, :] - MIDDLE[0]) * along[1] + (y[:, None] - MIDDLE[1]) * along[0] - off_px
    cover = ndtr((d + 0.5 * WIDTH_PX) / BLUR_PX) - ndtr((d - 0.5 * WIDTH_PX) / BLUR_PX)
    return np.asarray(200.0 - DEPTH * cover.reshape(SIZE[1], SUB, SIZE[0], SUB).mean(axis=(1, 3)))


def piece(width_px: float, blur_px: float) -> np.ndarray:
    """The piece, without lines that cross it near its ends."""
    along = np.array([np.cos(ANGLE), np.sin(ANGLE)])
    row = np.zeros(len(INPUTS))
    start, end = MIDDLE - 0.5 * (LENGTH_PX + 60.0) * along, MIDDLE + 0.5 * (LENGTH_PX + 60.0) * along
    given = {
        "x": MIDDLE[0],
        "y": MIDDLE[1],
        "dir_x": along[0],
        "dir_y": along[1],
        "half_length": 0.5 * LENGTH_PX,
        "start_x": start[0],
        "start_y": start[1],
        "start_nx": along[0],
        "start_ny": along[1],
        "end_x": end[0],
        "end_y": end[1],
        "end_nx": along[0],
        "end_ny": along[1],
        "width": width_px,
        "blur": blur_px,
        "room": 40.0,
    }
    for name, value in given.items():
        row[IN[name]] = value
    return row


def test_a_long_pieces_error_is_the_one_reported() -> None:
    rng = np.random.default_rng(5)
    rows = piece(WIDTH_PX, BLUR_PX)[None]
    errors, sigmas = [], []
    drawn = [(off, line_image(off)) for off in rng.uniform(-0.4, 0.4, 10)]
    for k in range(200):
        off, clean = drawn[k % 10]
        image = clean + rng.normal(0.0, NOISE, SIZE[::-1])
        out = fit_pieces(image.astype(np.float32), rows, dark_lines=True)[0]
        assert out[OUT["ok"]] == 1.0
        assert out[OUT["n_pixels"]] > 4000  # well beyond what a part of the pixels leads
        errors.append(out[OUT["c0"]] - off)
        sigmas.append(np.sqrt(out[OUT["var_c0"]]))
    ratio = np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas)
    assert 0.87 < ratio < 1.13  # 200 errors give their own size to 5 %
    # three sigma of the mean of 200: no bias
    assert abs(np.mean(errors)) < 3.0 * np.mean(sigmas) / np.sqrt(200)


def test_where_a_long_piece_is_started_changes_nothing() -> None:
    rng = np.random.default_rng(6)
    image = (line_image(0.3) + rng.normal(0.0, NOISE, SIZE[::-1])).astype(np.float32)
    starts = np.stack([piece(WIDTH_PX, BLUR_PX), piece(1.15 * WIDTH_PX, 1.3 * BLUR_PX)])
    # the same pixels for both: the strip's width follows from the start
    starts[:, IN["room"]] = 0.5 * WIDTH_PX + 8.0
    one, other = fit_pieces(image, starts[:1], dark_lines=True)[0], fit_pieces(image, starts[1:], dark_lines=True)[0]
    sigma = np.sqrt(one[OUT["var_c0"]])
    # another strip, guard and prior of the width: half a standard deviation at most
    assert abs(one[OUT["c0"]] - other[OUT["c0"]]) < 0.5 * sigma
