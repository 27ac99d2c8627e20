"""Check of a calibration by one live pair: how far the cameras see a surface's points off their epipolar lines."""

from __future__ import annotations

import numpy as np

from stereorig.core.errors import ImageError, MeasurementError, RegionError
from stereorig.core.field.checks.epipolar_offset import FAILED_PX, check_epipolar
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.measure import measure_shape
from stereorig.core.orientation.coarse import features_off_px
from stereorig.server.compute.tasks import LiveCheckTask, LiveFinding
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.calibrations.volume import own_px_of, rbe_of

_POINTS = 300  # over the whole image: a smooth offset needs no more
_MIN_VALID = 20
_SPACING_PX = 12.0  # at least
_COARSE_PX = 1.0  # features are found to 0.7 px: above it they say more than subsets, whose search ends at 1.5 px


def check_live(task: LiveCheckTask) -> LiveFinding:
    """Return the offset from the epipolar lines.

    A surface is measured as a test's reference would be, on a coarse grid over the whole image. If the cameras turned
    so far that nothing matches, the offset is measured by features, to some tenths of a pixel.
    """
    loaded = load_calibration(task.calibration)
    images = [MeasureImage(task.pixels[k], f"camera {k + 1}'s live image") for k in range(2)]
    rows, cols = images[0].shape
    options = MeasureOptions(patch="affine")
    margin = options.subset_px // 2 + 1
    spacing = max(_SPACING_PX, float(np.sqrt(rows * cols / _POINTS)))
    own = own_px_of(loaded)
    try:
        grid = PointGrid.rectangle(margin, margin, cols - 1 - margin, rows - 1 - margin, spacing_px=spacing)
        shape = measure_shape(loaded.pair, images[0], images[1], grid, options)
        if int(shape.valid.sum()) >= _MIN_VALID:
            found = check_epipolar(shape, rbe_of(loaded), imported=loaded.imported)
            if found is not None:
                return LiveFinding(found.level, found.reason, found.offset_px, found.own_px, int(shape.valid.sum()))
    except ImageError:
        return _no_texture(own)  # blank, or noise alone
    except (MeasurementError, RegionError):
        pass  # nothing matched on the epipolar lines: texture is missing, or a camera turned
    off_px = features_off_px(loaded.pair, *images)
    if off_px is None or off_px < max(_COARSE_PX, FAILED_PX + (own or 0.0)):
        return _no_texture(own)
    text = f"features are about {off_px:.1f} px off their epipolar lines"
    if loaded.imported:
        level, text = "warning", text + "; the imported calibration's own error is not known"
    else:
        level, text = "failed", text + "; a camera was moved since, or the calibration belongs to another set-up"
    return LiveFinding(level, text, off_px, own)


def _no_texture(own_px: float | None) -> LiveFinding:
    text = "too little of the picture is seen by both cameras with a texture to match"
    return LiveFinding("no_texture", text, own_px=own_px)
