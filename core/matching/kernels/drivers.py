"""The compiled entry points: a range of points, one work space a call.

They release the GIL and are called from several threads on ranges of their own. A point's result depends on nothing
but its own input, so neither ranges nor threads change a digit.

Only these are cached on disk. numba looks at the date of the cached function's own file alone, and all kernels are
inlined here; so the cache's key gets a stamp of all their sources, through a closure variable, and a change in any of
them compiles anew. The kernels themselves are globals: as closure variables they would enter the key too, and theirs
differs from process to process.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from core.matching.kernels.motion import make_motion
from core.matching.kernels.naming import entry
from core.matching.kernels.shape import make_shape


def _stamp() -> int:
    here = Path(__file__).parent
    sources = [*sorted(here.glob("*.py")), here.parents[1] / "status.py"]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).digest()
    return int.from_bytes(digest[:7], "big")


_plane_shape, _shape_space, _observed_plane_shape, _observed_shape_space = make_shape(1)
_plane_motion, _motion_space, _observed_plane_motion, _observed_motion_space = make_motion(1)
_curved_shape, _curved_shape_space, _observed_curved_shape, _observed_curved_shape_space = make_shape(2)
_curved_motion, _curved_motion_space, _observed_curved_motion, _observed_curved_motion_space = make_motion(2)


def _wrappers(stamp: int) -> tuple[dict[int, Any], ...]:
    @entry
    def run_plane_shape(
        first, last, reference, visible, image2, lens1, lens2, R, t, xy, start, setting, space, out, status, iterations
    ):
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        patches, which = visible
        for i in range(first, last):
            status[i], iterations[i] = _plane_shape(
                reference, patches, which[i], image2, lens1, lens2, R, t, xy[i], start[i], setting, space, out[i]
            )

    @entry
    def run_plane_motion(
        first,
        last,
        reference,
        visible,
        image2,
        image1t,
        image2t,
        lens1,
        lens2,
        R,
        t,
        xy,
        start_w,
        start_g,
        setting,
        space,
        out,
        status,
        iterations,
    ):
        if stamp < 0:
            return
        patches, which = visible
        for i in range(first, last):
            status[i], iterations[i] = _plane_motion(
                reference,
                patches,
                which[i],
                image2,
                image1t,
                image2t,
                lens1,
                lens2,
                R,
                t,
                xy[i],
                start_w[i],
                start_g[i],
                setting,
                space,
                out[i],
            )

    @entry
    def run_curved_shape(
        first, last, reference, visible, image2, lens1, lens2, R, t, xy, start, setting, space, out, status, iterations
    ):
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        patches, which = visible
        for i in range(first, last):
            status[i], iterations[i] = _curved_shape(
                reference, patches, which[i], image2, lens1, lens2, R, t, xy[i], start[i], setting, space, out[i]
            )

    @entry
    def run_curved_motion(
        first,
        last,
        reference,
        visible,
        image2,
        image1t,
        image2t,
        lens1,
        lens2,
        R,
        t,
        xy,
        start_w,
        start_g,
        setting,
        space,
        out,
        status,
        iterations,
    ):
        if stamp < 0:
            return
        patches, which = visible
        for i in range(first, last):
            status[i], iterations[i] = _curved_motion(
                reference,
                patches,
                which[i],
                image2,
                image1t,
                image2t,
                lens1,
                lens2,
                R,
                t,
                xy[i],
                start_w[i],
                start_g[i],
                setting,
                space,
                out[i],
            )

    @entry
    def observe_plane_shape(
        first,
        last,
        reference,
        visible,
        image2,
        image1t,
        image2t,
        lens1,
        lens2,
        R,
        t,
        xy,
        w,
        g,
        e,
        setting,
        rigid,
        space,
        out,
        status,
    ):
        if stamp < 0:
            return
        patches, which = visible
        for i in range(first, last):
            status[i] = _observed_plane_shape(
                reference,
                patches,
                which[i],
                image2,
                image1t,
                image2t,
                lens1,
                lens2,
                R,
                t,
                xy[i],
                w[i],
                g[i],
                e[i],
                setting,
                rigid,
                space,
                out[i],
            )

    @entry
    def observe_plane_motion(
        first,
        last,
        reference,
        visible,
        image2,
        image1t,
        image2t,
        lens1,
        lens2,
        R,
        t,
        xy,
        w,
        g,
        e,
        setting,
        rigid,
        space,
        out,
        status,
    ):
        if stamp < 0:
            return
        patches, which = visible
        for i in range(first, last):
            status[i] = _observed_plane_motion(
                reference,
                patches,
                which[i],
                image2,
                image1t,
                image2t,
                lens1,
                lens2,
                R,
                t,
                xy[i],
                w[i],
                g[i],
                e[i],
                setting,
                rigid,
                space,
                out[i],
            )

    @entry
    def observe_curved_shape(
        first,
        last,
        reference,
        visible,
        image2,
        image1t,
        image2t,
        lens1,
        lens2,
        R,
        t,
        xy,
        w,
        g,
        e,
        setting,
        rigid,
        space,
        out,
        status,
    ):
        if stamp < 0:
            return
        patches, which = visible
        for i in range(first, last):
            status[i] = _observed_curved_shape(
                reference,
                patches,
                which[i],
                image2,
                image1t,
                image2t,
                lens1,
                lens2,
                R,
                t,
                xy[i],
                w[i],
                g[i],
                e[i],
                setting,
                rigid,
                space,
                out[i],
            )

    @entry
    def observe_curved_motion(
        first,
        last,
        reference,
        visible,
        image2,
        image1t,
        image2t,
        lens1,
        lens2,
        R,
        t,
        xy,
        w,
        g,
        e,
        setting,
        rigid,
        space,
        out,
        status,
    ):
        if stamp < 0:
            return
        patches, which = visible
        for i in range(first, last):
            status[i] = _observed_curved_motion(
                reference,
                patches,
                which[i],
                image2,
                image1t,
                image2t,
                lens1,
                lens2,
                R,
                t,
                xy[i],
                w[i],
                g[i],
                e[i],
                setting,
                rigid,
                space,
                out[i],
            )

    return (
        {1: run_plane_shape, 2: run_curved_shape},
        {1: run_plane_motion, 2: run_curved_motion},
        {1: observe_plane_shape, 2: observe_curved_shape},
        {1: observe_plane_motion, 2: observe_curved_motion},
    )


shape_points, motion_points, observe_shape, observe_motion = _wrappers(_stamp())
"""The compiled fits and observed covariances, by the patch's degree: 1 plane, 2 curved."""
shape_space = {1: _shape_space, 2: _curved_shape_space}
motion_space = {1: _motion_space, 2: _curved_motion_space}
observed_shape_space = {1: _observed_shape_space, 2: _observed_curved_shape_space}
observed_motion_space = {1: _observed_motion_space, 2: _observed_curved_motion_space}
"""What makes their work space for a subset's width; one call at a time may use it."""
