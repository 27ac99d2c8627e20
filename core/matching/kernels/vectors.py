"""Fixed-width vectors for the innermost loops, as a thin layer over LLVM's instruction builder.

numba compiles a loop over pixels well but has no means to load four neighbouring taps at once: it emits sixteen gathers
for a cubic spline, two to four times slower than rows. So the pixel loops are written in vectors of eight pixels with
the few operations below; LLVM turns them into the machine's instructions (SSE, AVX2, AVX-512, NEON).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils

LANES = 8
FLAGS = ("reassoc", "contract", "arcp", "nsz")  # not nnan/ninf: NaN must stay visible

FLOAT = ir.FloatType()
DOUBLE = ir.DoubleType()
INT = ir.IntType(32)
LONG = ir.IntType(64)


class Vec:
    """A vector of floats or doubles with the arithmetic that the loops need; Python numbers are spread."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _other(self, other: Vec | float) -> Any:
        if isinstance(other, Vec):
            return other.value
        return ir.Constant(self.value.type, [float(other)] * self.value.type.count)

    def _new(self, name: str, other: Vec | float, swap: bool = False) -> Vec:
        a, b = self.value, self._other(other)
        if swap:
            a, b = b, a
        return Vec(self.builder, getattr(self.builder, name)(a, b, flags=FLAGS))

    def __add__(self, other: Vec | float) -> Vec:
        return self._new("fadd", other)

    def __sub__(self, other: Vec | float) -> Vec:
        return self._new("fsub", other)

    def __mul__(self, other: Vec | float) -> Vec:
        return self._new("fmul", other)

    def __rsub__(self, other: float) -> Vec:
        return self._new("fsub", other, swap=True)

    __radd__ = __add__
    __rmul__ = __mul__

    def floor(self) -> Vec:
        """Largest whole number not above, lane by lane."""
        return self._call("floor")

    def _call(self, name: str) -> Vec:
        kind = self.value.type
        bits = 32 if kind.element == FLOAT else 64
        function = cgutils.get_or_insert_function(
            self.builder.module, ir.FunctionType(kind, [kind]), f"llvm.{name}.v{kind.count}f{bits}"
        )
        return Vec(self.builder, self.builder.call(function, [self.value]))

    def __truediv__(self, other: Vec | float) -> Vec:
        return self._new("fdiv", other)

    def __rtruediv__(self, other: float) -> Vec:
        return self._new("fdiv", other, swap=True)

    def to_int(self) -> Any:
        """Lanes as int32, truncated."""
        return self.builder.fptosi(self.value, ir.VectorType(INT, self.value.type.count))

    def pick(self, lanes: Sequence[int]) -> Vec:
        """The lanes named, in this order."""
        return join(self, self, lanes)

    def reduce(self, name: str) -> Any:
        """Smallest (``fmin``) or largest (``fmax``) lane, a scalar."""
        kind = self.value.type
        bits = 32 if kind.element == FLOAT else 64
        function = cgutils.get_or_insert_function(
            self.builder.module,
            ir.FunctionType(kind.element, [kind]),
            f"llvm.vector.reduce.{name}.v{kind.count}f{bits}",
        )
        return self.builder.call(function, [self.value])

    def sum(self) -> Any:
        """Sum of the lanes, a scalar."""
        vector, count = self, self.value.type.count
        while count > 1:
            count //= 2
            vector = vector.pick(range(count)) + vector.pick(range(count, 2 * count))
        return self.builder.extract_element(vector.value, INT(0))


def join(a: Vec, b: Vec, lanes: Sequence[int]) -> Vec:
    """Lanes of ``a`` (0, 1, ...) and of ``b`` (counted on) in the order named."""
    mask = ir.Constant(ir.VectorType(INT, len(lanes)), list(lanes))
    return Vec(a.builder, a.builder.shuffle_vector(a.value, b.value, mask))


def spread(builder: Any, scalar: Any, count: int = LANES) -> Vec:
    """A scalar in every lane."""
    kind = ir.VectorType(scalar.type, count)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, INT(0))
    mask = ir.Constant(ir.VectorType(INT, count), [0] * count)
    return Vec(builder, builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), mask))


def load(builder: Any, pointer: Any, count: int = LANES, element: Any = FLOAT) -> Vec:
    """``count`` neighbouring floats or doubles at any address."""
    typed = builder.bitcast(pointer, ir.VectorType(element, count).as_pointer())
    return Vec(builder, builder.load(typed, align=4))


def store(vector: Vec, pointer: Any) -> None:
    """Write the lanes to any address."""
    builder = vector.builder
    builder.store(vector.value, builder.bitcast(pointer, vector.value.type.as_pointer()), align=4)


def at(builder: Any, pointer: Any, index: Any) -> Any:
    """Pointer moved by ``index`` elements."""
    return builder.gep(pointer, [index], inbounds=True)


def transpose4(a: Vec, b: Vec, c: Vec, d: Vec) -> tuple[Vec, Vec, Vec, Vec]:
    """Transpose the 4 x 4 blocks in both halves of four vectors of eight."""
    low = [0, 8, 1, 9, 4, 12, 5, 13]
    high = [2, 10, 3, 11, 6, 14, 7, 15]
    ab, cd = join(a, b, low), join(c, d, low)
    AB, CD = join(a, b, high), join(c, d, high)
    first, second = [0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]
    return join(ab, cd, first), join(ab, cd, second), join(AB, CD, first), join(AB, CD, second)
