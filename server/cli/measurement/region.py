"""The region to measure, the mask, the seeds: read from the command line and checked against the image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import InputError, RegionError
from stereorig.core.field.region.lay_points import corners_px, lay_points
from stereorig.core.field.region.region import check_region as check_points
from stereorig.core.field.seeding.seeds import Seed
from stereorig.core.settings import Outline, Range, StoredRegion
from stereorig.server.cli.measurement.image_lists import ImagePair
from stereorig.server.formats.calibrations.recognise import LoadedCalibration
from stereorig.server.formats.images import read_image, read_mask

if TYPE_CHECKING:
    from stereorig.core.field.seeding.specimen import Specimen

Rectangle = tuple[float, float, float, float]
Line = list[list[float]]


def _numbers(option: str, text: str, count: int, form: str | None = None) -> list[float]:
    parts = text.split(",")
    try:
        numbers = [float(part) for part in parts]
    except ValueError as error:
        raise _bad(option, text, "is not a list of numbers", count, form) from error
    if len(numbers) != count:
        raise _bad(option, text, f"has {len(numbers)} numbers", count, form)
    if not all(math.isfinite(v) for v in numbers):
        raise _bad(option, text, "holds a number that is not finite", count, form)
    return numbers


def _bad(option: str, text: str, why: str, count: int, form: str | None) -> RegionError:
    form = form or ("X0,Y0,X1,Y1" if count == 4 else "X,Y")
    return RegionError(f"{option} {text!r} {why}.", remedy=f"Give {option} {form} in pixels of camera 1's image.")


def parse_rectangle(text: str) -> Rectangle:
    """Read ``X0,Y0,X1,Y1``.

    Raises
    ------
    RegionError
        If it is not four finite numbers in order.
    """
    x0, y0, x1, y1 = _numbers("--roi", text, 4)
    if x1 <= x0 or y1 <= y0:
        raise RegionError(
            f"--roi {text} is empty: from {x0:g} to {x1:g} by {y0:g} to {y1:g}.",
            remedy="Give the upper left corner first, then the lower right one.",
        )
    return x0, y0, x1, y1


def parse_outline(option: str, text: str) -> Outline:
    """Read ``X0,Y0,X1,Y1``, ``circle:X,Y,RADIUS`` or ``polygon:X0,Y0,X1,Y1,X2,Y2,...``.

    Raises
    ------
    RegionError
        If it is none of these, or holds nothing; ``cut_invalid`` for a polygon that is none.
    """
    form, colon, numbers = text.partition(":")
    if not colon:
        return Outline.model_construct(rectangle=parse_rectangle(text), polygon=None, circle=None)
    if form == "circle":
        x, y, radius = _numbers(option, numbers, 3, "circle:X,Y,RADIUS")
        if radius <= 0.0:
            raise RegionError(f"{option} {text} holds nothing.", remedy="Give a radius above zero, in pixels.")
        return Outline.model_construct(rectangle=None, polygon=None, circle=(x, y, radius))
    if form == "polygon":
        corners = [(x, y) for x, y in parse_line(option, numbers, 3)]
        return Outline.model_construct(rectangle=None, polygon=corners, circle=None)
    raise RegionError(
        f"{option} {text!r} is no form that is known.",
        remedy=f"Give {option} X0,Y0,X1,Y1, {option} circle:X,Y,RADIUS or {option} polygon:X0,Y0,X1,Y1,X2,Y2,...",
    )


def parse_hole(text: str) -> Line:
    """Read a hole's corners: as an outline, or ``X0,Y0,X1,Y1,X2,Y2,...`` alone; [x, y] each.

    Raises
    ------
    RegionError
        As :func:`parse_outline`.
    """
    if ":" not in text:
        return parse_line("--hole", text, 3)
    return [list(corner) for corner in corners_px(parse_outline("--hole", text)).tolist()]


def parse_line(option: str, text: str, min_points: int) -> Line:
    """Read ``X0,Y0,X1,Y1,...`` of ``min_points`` points or more; returns [x, y] each.

    Raises
    ------
    RegionError
        ``cut_invalid``.
    """
    form = ",".join(f"X{k},Y{k}" for k in range(min_points))
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) < 2 * min_points or len(numbers) % 2 or not all(math.isfinite(v) for v in numbers):
        raise RegionError(
            f"{option} {text!r} is no list of {min_points} points or more.",
            code="cut_invalid",
            remedy=f"Give {option} {form},... in pixels of camera 1's first image.",
        )
    return [numbers[k : k + 2] for k in range(0, len(numbers), 2)]


def check_whole(option: str, text: str, allowed: Range) -> int:
    """Read a whole number in a range.

    Raises
    ------
    InputError
        ``option_out_of_range``.
    """
    try:
        value = int(text)
    except ValueError:
        value = allowed.low - 1
    if not allowed.holds(value):
        raise InputError(
            f"{option} is {text}; it must be {allowed}.",
            code="option_out_of_range",
            remedy=f"Give {option} {allowed.default}, for example.",
        )
    return value


def check_region(
    outlines: Sequence[Outline],
    *,
    image_shape: tuple[int, int],
    subset_px: int,
    spacing_px: int,
    mask_path: Path | None,
    seeds: Sequence[str],
    cracks: Sequence[str] = (),
    holes: Sequence[str] = (),
    mask: NDArray[np.bool_] | None = None,
) -> tuple[StoredRegion, tuple[Seed, ...] | None]:
    """Check region, mask, cracks, holes and seeds against camera 1's image; return the region, and the seeds if any.

    Parameters
    ----------
    outlines, mask_path
        One of them, or both; points are inside any of the outlines.
    mask
        The mask, if its file is still to be written.

    Raises
    ------
    RegionError
        Outside the image, smaller than a subset, no white under any point, a mask of another size, a seed outside,
        a crack or hole that is none.
    ImageError
        If the mask cannot be read.
    """
    if mask is None and mask_path is not None:
        mask = read_mask(mask_path)
    region = StoredRegion.model_validate(
        {
            **_given(outlines),
            "cracks": [parse_line("--crack", text, 2) for text in cracks],
            "holes": [parse_hole(text) for text in holes],
            "mask": None if mask_path is None else str(mask_path),
        }
    )
    mask_shape = None if mask is None else (mask.shape[0], mask.shape[1])
    points = lay_points(region, spacing_px, mask)
    check_points(points, image_shape=image_shape, subset_px=subset_px, mask_shape=mask_shape)
    return region, _seeds(seeds, points.extent_px, mask)


def _given(outlines: Sequence[Outline]) -> dict[str, object]:
    # a single rectangle or polygon is stored as it always was
    first = outlines[0] if len(outlines) == 1 else None
    if first is None or first.circle is not None:
        return {"outlines": [outline.model_dump() for outline in outlines]}
    return {"rectangle": first.rectangle, "polygon": first.polygon}


def _seeds(texts: Sequence[str], rectangle: Rectangle, mask: NDArray[np.bool_] | None) -> tuple[Seed, ...] | None:
    if not texts:
        return None
    x0, y0, x1, y1 = rectangle
    seeds = []
    for text in texts:
        # with four numbers, the last two are the position in camera 2
        count = 4 if text.count(",") == 3 else 2
        x, y, *other = _numbers("--seed", text, count, "X,Y or X,Y,X2,Y2")
        if not (x0 <= x <= x1 and y0 <= y <= y1):
            cause = f"--seed {text} is outside the region {x0:g},{y0:g},{x1:g},{y1:g}."
            raise RegionError(cause, code="seed_outside", remedy="Give a seed inside the region, in camera 1's image.")
        if mask is not None and not mask[min(round(y), mask.shape[0] - 1), min(round(x), mask.shape[1] - 1)]:
            raise RegionError(
                f"--seed {text} is at a black pixel of the mask.",
                code="seed_outside",
                remedy="Give a seed where the mask is white.",
            )
        seeds.append(Seed((x, y), (other[0], other[1]) if other else None))
    return tuple(seeds)


# The default region of ``stereorig measure``: the specimen, found in the first pair of images.

SPECIMEN_FILE = "specimen.png"
"""The mask in the output folder, white on the specimen: to be looked at, and to be corrected for ``--mask``."""


def found_specimen(
    pair: ImagePair, calibration: LoadedCalibration, subset_px: int, mask: NDArray[np.bool_] | None
) -> Specimen:
    """Find the specimen in a pair of images, within a mask (rows, cols) if there is one.

    Raises
    ------
    RegionError
        ``region_not_found``; ``mask_size`` for a mask of another size.
    ImageError, SeedError
        The images cannot be used; ``not_seeded`` if they have no matches.
    """
    # the kernels' modules take seconds to load: only if they are needed
    from stereorig.core.field.points.images import MeasureImage
    from stereorig.core.field.seeding.specimen import find_specimen

    one, two = (MeasureImage(read_image(path), str(path)) for path in (pair.cam1, pair.cam2))
    if mask is not None and mask.shape != one.shape:
        raise RegionError(
            f"The mask is {mask.shape[1]} x {mask.shape[0]} px, camera 1's image {one.shape[1]} x {one.shape[0]} px.",
            code="mask_size",
            remedy="Draw the mask over camera 1's reference image.",
        )
    specimen = find_specimen(calibration.pair, one, two, subset_px=subset_px)
    if mask is None:
        return specimen
    both = specimen.mask & mask
    if not both.any():
        raise RegionError(
            "The specimen that was found is where the mask is black.",
            code="region_not_found",
            remedy="Leave out --roi auto or the mask.",
        )
    return replace(specimen, mask=both, text=f"{specimen.text}; the mask's white of it")
