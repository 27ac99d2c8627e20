"""The default region of ``stereorig measure``: the specimen, found in the first pair of images."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import RegionError
from stereorig.server.cli.measurement.image_lists import ImagePair
from stereorig.server.formats.calibrations.recognise import LoadedCalibration
from stereorig.server.formats.images import read_image

if TYPE_CHECKING:
    from stereorig.core.field.seeding.specimen import Specimen

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
