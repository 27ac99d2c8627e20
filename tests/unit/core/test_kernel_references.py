"""Kernels count no references of the arrays that they look at."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.errors import NumbaError

from stereorig.core.matching.kernels.naming import inner, kernel, outer


def ir_of(compiled: Callable[[Any], Any]) -> str:
    """A kernel with views that outlive a branch, as compiled."""

    @compiled
    def added(row, space, k):
        first = space[k]
        for j in range(row.shape[0]):
            other = space[j]
            if other[0] > 5.0:
                return False
            row[j] = first[0] + other[0]
        return True

    @compiled
    def over_rows(out, space):
        for i in range(out.shape[0]):
            row = out[i]
            for k in range(2):
                if not added(row, space, k):
                    break
                row = space[i]

    out, plain = np.zeros((3, 2)), np.zeros((3, 2))
    over_rows(out, np.ones((3, 2)))
    over_rows.py_func(plain, np.ones((3, 2)))
    np.testing.assert_array_equal(out, plain)
    (text,) = over_rows.inspect_llvm().values()
    return str(text)


def test_views_are_not_counted() -> None:
    assert "NRT_incref" in ir_of(njit), "what is looked for"
    assert "NRT_incref" not in ir_of(outer)


def test_a_kernel_that_makes_an_array_is_refused() -> None:
    @inner
    def lengthened(n):
        return np.empty(n)

    @kernel("test")
    def longest(n):
        return lengthened(n).shape[0]

    @outer
    def called(n):
        return longest(n)

    with pytest.raises(NumbaError, match="empty"):
        called(3)
