"""Frames by name: the calibration's system frame, the specimen's own, or one that is written out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import TypeAdapter, ValidationError

from stereorig.core.errors import FileFormatError, RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.align import Alignment, align_3_2_1, align_given, align_plane, image_rows
from stereorig.core.gauge.area import points_within
from stereorig.core.gauge.sampling import sample
from stereorig.server.base.json_values import asked_in
from stereorig.server.results.gauges.request import Alignment as Asked
from stereorig.server.results.gauges.request import GivenAlignment, PlaneAlignment

#: the specimen's frame if none was chosen
SPECIMEN = PlaneAlignment(kind="plane", x_direction="image_rows")
_ASKED: TypeAdapter[Asked] = TypeAdapter(Asked)


def frame_of_test(document: Mapping[str, object] | None) -> Asked:
    """Return the frame that is stored with a test; if none is, its best plane with X along the image rows.

    Raises
    ------
    FileFormatError
        ``frame_invalid`` if the stored document is no frame.
    """
    if document is None:
        return SPECIMEN
    try:
        return _ASKED.validate_python(document)
    except ValidationError as error:
        raise FileFormatError(
            f"The frame kept with the test is none: {error.errors()[0]['msg']}.",
            code="frame_invalid",
            remedy="Choose the specimen's frame again.",
        ) from error


def frame_asked(text: str | None, of_test: Asked) -> Asked | None:
    """Return the frame that a text names; None: the system frame, in which results are stored.

    Parameters
    ----------
    text
        ``system``, ``specimen``, or a frame as JSON, with the entries of a gauge request's `align`.
    of_test
        The specimen's.

    Raises
    ------
    InputError
        ``frame_invalid`` for anything else.
    """
    if text in (None, "system"):
        return None
    if text == "specimen":
        return of_test
    remedy = 'Give system, specimen, or JSON such as {"kind": "plane", "x_direction": [1, -1, 0]}.'
    return asked_in(text or "", _ASKED, named="frame", code="frame_invalid", remedy=remedy)


def lay(asked: Asked, field: Field, shared: SharedPixels) -> Alignment:
    """Define a frame by the reference shape of a field.

    Raises
    ------
    MeasurementError
        ``too_few_points``.
    RegionError
        ``gauge_outside``, ``gauge_unusable``.
    """
    if isinstance(asked, GivenAlignment):
        return align_given(asked.rotation, asked.origin_mm)
    if not isinstance(asked, PlaneAlignment):
        return align_3_2_1(field, asked.positions_px, shared=shared)
    along = asked.x_direction
    direction = image_rows(field) if along == "image_rows" else np.asarray(along, dtype=np.float64)
    if asked.x_line_px is not None:
        ends = sample(field, asked.x_line_px)
        if not ends.found.all():
            raise RegionError(
                "An end of the line of X has no measured point about it.",
                code="gauge_outside",
                remedy="Choose positions where the shape was measured.",
            )
        first, second = ends.of(field.xyz_mm)
        direction = second - first
    return align_plane(field, shared=shared, chosen=points_within(field, asked.corners()), x_direction=direction)


def text_of(asked: Asked) -> str:
    """Return how a frame was laid, in a few words."""
    if isinstance(asked, GivenAlignment):
        return "aligned by given axes"
    if not isinstance(asked, PlaneAlignment):
        return "aligned by 3-2-1"
    if asked.x_line_px is not None:
        return "aligned by plane, X along a line of two positions"
    return "aligned by plane" + (", X along camera 1's image rows" if asked.x_direction == "image_rows" else "")
