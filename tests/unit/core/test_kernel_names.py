"""Kernels of one factory must not share a name: from the disk cache, one would be taken for the other."""

from __future__ import annotations

from collections import Counter

from stereorig.core.matching.kernels.linear import make_factor
from stereorig.core.matching.kernels.motion import make_motion
from stereorig.core.matching.kernels.point import make_compare, make_point
from stereorig.core.matching.kernels.reference import make_reference
from stereorig.core.matching.kernels.shape import make_shape


def test_every_kernel_has_a_name_of_its_own() -> None:
    made = [*(make_point(degree, images) for degree in (1, 2) for images in (1, 3))]
    made += [(make_compare(degree), *make_reference(degree)) for degree in (1, 2)]
    made += [(make_shape(degree).point, make_motion(degree).point) for degree in (1, 2)]
    made += [(make_factor(row),) for row in (4, 8, 16, 28)]
    kernels = {id(part): part.py_func for parts in made for part in parts if hasattr(part, "py_func")}
    # the same code for the same row length may share a name
    names = Counter(f"{f.__module__}.{f.__qualname__}" for f in kernels.values() if "make_factor" not in f.__qualname__)
    assert len(names) > 30
    assert [name for name, count in names.items() if count > 1] == []
    rows = {f.__qualname__ for f in kernels.values() if "make_factor" in f.__qualname__}
    assert len(rows) == 4
