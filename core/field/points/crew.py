"""Fits of many points, shared out: tiles of them are fitted by other processes, or here, whoever takes one first.

A point's fit depends on its start and the images alone, so the result is the same to the last bit, wherever it is made.
Nobody is waited for: what others have taken and not finished is fitted here too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from core.arrays import Bool, Float
from core.field.points.fitter import FitsPoints, Fitter, PointFits
from core.progress import CancelToken, raise_if_cancelled
from core.status import PointStatus

MAX_BATCH = 4096
"""Points fitted between two looks at the cancel token: a cancel takes effect within a second even on a slow machine."""
_TILES = 16
_SMALLEST, _LARGEST = 64, 16_384
_BY_A_PART = (PointStatus.OUTSIDE_IMAGE, PointStatus.LOW_TEXTURE)


@dataclass(frozen=True, eq=False)
class ToFit:
    """Points to be fitted, and their starts.

    Attributes
    ----------
    xy_px
        (n, 2) px.
    w, G
        (n, 3 or 6); (n, 3, 3 or 6), None for a shape.
    far_px
        A fit that ends further than this from its start has left the basin it was started in.
    """

    xy_px: Float
    w: Float
    G: Float | None
    far_px: float

    def __len__(self) -> int:
        return len(self.xy_px)

    def at(self, part: slice | Bool) -> ToFit:
        """Return some of the points."""
        return ToFit(self.xy_px[part], self.w[part], None if self.G is None else self.G[part], self.far_px)


class Shared(Protocol):
    """Tiles that others may take."""

    def claim(self, k: int) -> bool:
        """Take a tile; False if another one has."""

    def fitted(self, k: int) -> PointFits | None:
        """Return what another one made of a tile; None if it has not yet."""

    def close(self) -> None:
        """Want nothing any more."""


class Crew(Protocol):
    """Those who may take tiles."""

    def share(self, fitter: Fitter, tiles: list[ToFit]) -> Shared | None:
        """Offer tiles; None where nobody can take one."""


def fit_here(fitter: FitsPoints, points: ToFit, cancel: CancelToken | None) -> Iterator[tuple[slice, PointFits]]:
    """Fit points; yield parts of them and their fits."""
    yield from _part_here(fitter, points, slice(0, len(points)), cancel)


def fit_shared(fitter: FitsPoints, points: ToFit, cancel: CancelToken | None) -> Iterator[tuple[slice, PointFits]]:
    """As :func:`fit_here`, with the fitter's crew; a part may come more than once, with the same fits."""
    tiles = list(_slices(len(points), min(max(-(-len(points) // _TILES), _SMALLEST), _LARGEST)))
    shared = None
    if isinstance(fitter, Fitter) and fitter.crew is not None and len(tiles) > 1:
        shared = fitter.crew.share(fitter, [points.at(tile) for tile in tiles])
    if shared is None:
        yield from fit_here(fitter, points, cancel)
        return
    try:
        taken = []
        for k in reversed(range(len(tiles))):  # others begin with the first
            raise_if_cancelled(cancel)
            if shared.claim(k):
                yield from _part_here(fitter, points, tiles[k], cancel)
            else:
                taken.append(k)
        for k in reversed(taken):
            yield from _elsewhere(fitter, points, tiles[k], lambda k=k: shared.fitted(k), cancel)  # type: ignore[misc]
    finally:
        shared.close()


def fit_part(fitter: FitsPoints, points: ToFit) -> PointFits:
    """Fit points at once."""
    fits = fitter.fit(points.xy_px, points.w, points.G)
    far = fits.ok & fitter.far_from_start(points.xy_px, fits, points.w, points.G, points.far_px)
    fits.reject(far, PointStatus.NOT_CONVERGED)
    return fits


def _part_here(
    fitter: FitsPoints, points: ToFit, part: slice, cancel: CancelToken | None
) -> Iterator[tuple[slice, PointFits]]:
    for some in _slices(part.stop - part.start, MAX_BATCH):
        raise_if_cancelled(cancel)
        batch = slice(part.start + some.start, part.start + some.stop)
        yield batch, fit_part(fitter, points.at(batch))


def _elsewhere(
    fitter: FitsPoints, points: ToFit, tile: slice, fitted: Callable[[], PointFits | None], cancel: CancelToken | None
) -> Iterator[tuple[slice, PointFits]]:
    """Yield what another one makes of a tile, or what is made of it here until that is there."""
    found, own = fitted(), _part_here(fitter, points, tile, cancel)
    while found is None and (batch := next(own, None)) is not None:
        yield batch
        found = fitted()
    if found is not None:
        # a subset that leaves the part of an image that a tile is fitted with may lie in the whole image
        again = np.isin(found.status, _BY_A_PART)
        if again.any():
            found.put(np.flatnonzero(again), fit_part(fitter, points.at(tile).at(again)))
        yield tile, found


def _slices(n: int, size: int) -> Iterator[slice]:
    return (slice(first, min(first + size, n)) for first in range(0, n, size))
