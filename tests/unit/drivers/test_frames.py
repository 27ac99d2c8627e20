"""Frames refuse pixels that cannot be what they claim."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import Frame, FrameCounters


def test_twelve_significant_bits_fit_sixteen_bit_pixels() -> None:
    frame = Frame(np.full((4, 6), 4095, np.uint16), 12, 7, 100, 200)
    assert frame.pixels.shape == (4, 6)
    assert frame.trigger is None


@pytest.mark.parametrize(
    ("pixels", "bit_depth"),
    [
        (np.zeros((4, 6), np.uint8), 12),
        (np.zeros((4, 6), np.uint16), 0),
        (np.zeros((4, 6, 3), np.uint8), 8),
        (np.zeros((4, 6), np.float32), 8),
    ],
)
def test_pixels_that_cannot_hold_the_claimed_bits_are_refused(pixels: np.ndarray, bit_depth: int) -> None:
    with pytest.raises(CameraError) as caught:
        Frame(pixels, bit_depth, 0, 0, 0)
    assert caught.value.code == "frame_format"


def test_counters_list_every_reason_by_name() -> None:
    assert FrameCounters(delivered=3, dropped=1).as_dict() == {
        "delivered": 3,
        "overrun": 0,
        "dropped": 1,
        "incomplete": 0,
        "duplicates": 0,
        "out_of_order": 0,
    }
