"""Start points that a user names: in camera 1's reference image, and where known in camera 2's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import RegionError
from stereorig.core.settings import AnalysisSettings
from stereorig.server.formats.calibrations.recognise import load_calibration

if TYPE_CHECKING:
    from stereorig.core.field.seeding.seeds import Seed


#: a click is good to some pixels; further from the epipolar line it is another point
MAX_EPIPOLAR_PX = 8.0

Position = Sequence[float]


def check_seeds(calibration: Path, settings: AnalysisSettings, size2_px: tuple[int, int]) -> None:
    """Raise an error for a seed whose two positions cannot be one point.

    Parameters
    ----------
    calibration
        The test's calibration.
    settings
        ``seeds`` and ``seeds_cam2`` as the API takes them.
    size2_px
        (width, height) of camera 2's image.

    Raises
    ------
    RegionError
        ``seed_outside``, ``seed_off_epipolar``.
    """
    from stereorig.core.field.seeding.seeds import seeds_of  # slow to load, and not every start needs it

    seeds = [s for s in seeds_of(settings) or [] if s.xy2_px is not None]
    if seeds:
        check_positions(load_calibration(calibration).pair, seeds, size2_px)


def check_positions(pair: StereoPair, seeds: Sequence[Seed], size2_px: tuple[int, int]) -> None:
    """Raise an error for seeds whose positions in camera 2 are outside its image, or cannot be the points of camera 1.

    Raises
    ------
    RegionError
        ``seed_outside``, ``seed_off_epipolar``.
    """
    seeds = [seed for seed in seeds if seed.xy2_px is not None]
    if not seeds:
        return
    for seed in seeds:
        assert seed.xy2_px is not None
        if not (0.0 <= seed.xy2_px[0] <= size2_px[0] - 1 and 0.0 <= seed.xy2_px[1] <= size2_px[1] - 1):
            raise RegionError(
                f"The seed's position ({seed.xy2_px[0]:g}, {seed.xy2_px[1]:g}) is outside camera 2's image of "
                f"{size2_px[0]} x {size2_px[1]} px.",
                code="seed_outside",
                remedy="Give positions inside camera 2's reference image.",
            )
    off = distances_px(pair, seeds)
    worst = int(np.argmax(np.where(np.isfinite(off), off, np.inf)))
    if not off[worst] <= MAX_EPIPOLAR_PX:
        one, two = seeds[worst].xy_px, seeds[worst].xy2_px
        assert two is not None
        raise RegionError(
            f"The seed ({one[0]:g}, {one[1]:g}) cannot be at ({two[0]:g}, {two[1]:g}) in camera 2: that is "
            f"{off[worst]:.1f} px from its epipolar line; {MAX_EPIPOLAR_PX:g} px are allowed.",
            code="seed_off_epipolar",
            remedy="Click the same point in both views, or leave camera 2's position out.",
        )


def distances_px(pair: StereoPair, seeds: Sequence[Seed]) -> np.ndarray:
    """Return the distance (n,) of each seed's position in camera 2 from its epipolar line; NaN without one."""
    out = np.full(len(seeds), np.nan)
    for k, seed in enumerate(seeds):
        if seed.xy2_px is not None:
            out[k] = abs(float(pair.epipolar_residual_px(np.array([seed.xy_px]), np.array([seed.xy2_px]))[0]))
    return out


def epipolar_line(pair: StereoPair, xy_px: Position, size2_px: tuple[int, int]) -> list[list[float]]:
    """Return camera 2's possible positions of a point of camera 1, about 32 along the epipolar line; empty if none."""
    from stereorig.core.field.seeding.epipolar_search import visible_depths  # slow to load

    position = np.asarray(xy_px, dtype=np.float64)
    depths = visible_depths(pair, position, (size2_px[1], size2_px[0]), spacing_px=max(*size2_px) / 32.0)
    if not len(depths):
        return []
    line = pair.image2_at_depth(np.broadcast_to(position, (len(depths), 2)), 1.0 / depths)
    return [[round(float(x), 3), round(float(y), 3)] for x, y in line if np.isfinite(x) and np.isfinite(y)]
