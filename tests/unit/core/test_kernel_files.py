"""Kernels that are kept on disk: no other kernel is built from one, which would round otherwise once it was loaded."""

from __future__ import annotations

import pytest
from numba import njit
from numba.core.errors import TypingError

from stereorig.core.compiling import ENTRIES
from stereorig.core.matching.kernels.drivers import run_points
from stereorig.core.matching.odd_filters import _filter_rows


def test_no_kernel_can_call_one_that_is_kept_on_disk() -> None:
    assert {run_points["shape"][1], _filter_rows} <= set(ENTRIES.values())

    @njit
    def caller(rows):  # type: ignore[no-untyped-def]
        return _filter_rows(rows)

    with pytest.raises(TypingError, match="_filter_rows"):
        caller(1.0)
