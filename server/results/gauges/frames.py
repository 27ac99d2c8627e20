"""Frames by name: the calibration's system frame, the specimen's own, or one that is written out."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal

import numpy as np
from pydantic import TypeAdapter, ValidationError

from core.errors import FileFormatError, RegionError
from core.field.points.result import Field
from core.field.points.shared_pixels import SharedPixels
from core.gauge.align import Alignment, align_3_2_1, align_given, align_plane, image_rows
from core.gauge.area import points_within
from core.gauge.sampling import sample
from server.base.json_values import asked_in
from server.results.gauges.request import Alignment as Asked
from server.results.gauges.request import GivenAlignment, PlaneAlignment

#: the specimen's frame where none was chosen
SPECIMEN = PlaneAlignment(kind="plane", x_direction="image_rows")
#: longest text of a frame that is written out
MAX_TEXT = 2000
#: variables that are the same in every frame
_INVARIANT = frozenset(
    [
        "x_px",
        "y_px",
        "status",
        "zncc",
        "iterations",
        "epipolar_px",
        "noise_grey",
        "reference_step",
        "theta_rad",
        "phi_rad",
        "zp_mm",
        "strain_status",
        "e1",
        "e2",
        "sigma_e1",
        "sigma_e2",
        "max_shear",
        "von_mises",
    ]
)
_STRAIN = re.compile(r"(sigma_)?(exx|eyy|exy)(_patch)?$|strain_")
_ASKED: TypeAdapter[Asked] = TypeAdapter(Asked)


def frame_of_test(document: Mapping[str, object] | None) -> Asked:
    """Return the frame that is kept with a test; its best plane with X along the image rows where there is none.

    Raises
    ------
    FileFormatError
        ``frame_invalid`` if what is kept is no frame.
    """
    if document is None:
        return SPECIMEN
    try:
        return _ASKED.validate_python(document)
    except ValidationError as error:
        raise FileFormatError(
            f"The frame kept with the test is none: {error.errors()[0]['msg']}.",
            code="frame_invalid",
            remedy="Choose the specimen's frame anew.",
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
    """Lay a frame through the reference shape of a field.

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


def part_of(name: str) -> Literal["none", "field", "strain"]:
    """Return which part of a result holds a variable, of those that depend on the frame."""
    if name in _INVARIANT:
        return "none"
    return "strain" if _STRAIN.match(name) else "field"


def text_of(asked: Asked) -> str:
    """Return how a frame was laid, in a few words."""
    if isinstance(asked, GivenAlignment):
        return "aligned by given axes"
    if not isinstance(asked, PlaneAlignment):
        return "aligned by 3-2-1"
    if asked.x_line_px is not None:
        return "aligned by plane, X along a line of two positions"
    return "aligned by plane" + (", X along camera 1's image rows" if asked.x_direction == "image_rows" else "")
