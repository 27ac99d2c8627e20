"""The view of a planned camera: field, size of a pixel, depth of field, blur by motion, light, size of a good speckle.

Whatever needs a value that is not stated is None, and the value is named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

_SPECKLE_PX = (3.0, 5.0)
# luminous flux of green light (555 nm, the candela's definition), and the energy of one of its photons
_LM_PER_W, _PHOTON_J = 683.0, 6.62607e-34 * 2.99792e8 / 555e-9


@dataclass(frozen=True, kw_only=True)
class PlannedView:
    """A camera's view at its stand-off.

    Attributes
    ----------
    field_mm
        Width and height of the plane that it sees there.
    um_per_px
        Size of a pixel on that plane.
    speckle_mm
        Diameters of speckle of 3 and 5 px.
    depth_mm
        Distances towards the camera and away from it, at which a point is blurred to a circle of one pixel; the second
        is None if it has no end.
    blur_px
        Motion during the exposure, across the optical axis.
    photons_at_1000_lx
        Photons of green light that a pixel gets in the exposure from a matt white surface lit with 1,000 lx, on the
        axis; the lens's own losses are not taken off.
    missing
        Names of the values that are not stated and would give more.
    """

    field_mm: tuple[float, float]
    um_per_px: float
    speckle_mm: tuple[float, float]
    depth_mm: tuple[float, float | None] | None
    blur_px: float | None
    photons_at_1000_lx: float | None
    missing: tuple[str, ...]


def planned_view(
    image_size_px: tuple[int, int],
    phd_px: float,
    standoff_mm: float,
    *,
    focal_mm: float | None = None,
    f_number: float | None = None,
    exposure_ms: float | None = None,
    speed_mm_s: float | None = None,
) -> PlannedView:
    """Return what a camera focused on its stand-off sees.

    Parameters
    ----------
    image_size_px, phd_px, standoff_mm
        The nominal camera.
    focal_mm, f_number
        Focal length and aperture: the pupil's diameter is their quotient.
    exposure_ms, speed_mm_s
        Exposure and the specimen's speed.
    """
    mm_per_px = standoff_mm / phd_px
    depth = None
    if focal_mm is not None and f_number is not None:
        # thin lens: a point at z has the blur pupil * phd_px * |1/z - 1/standoff|, in pixels
        change = f_number / (focal_mm * phd_px)
        far = 1.0 / standoff_mm - change
        near_mm = standoff_mm - 1.0 / (1.0 / standoff_mm + change)
        depth = near_mm, 1.0 / far - standoff_mm if far > 0.0 else None
    blur = None
    if exposure_ms is not None and speed_mm_s is not None:
        blur = 1e-3 * exposure_ms * speed_mm_s / mm_per_px
    photons = None
    if focal_mm is not None and f_number is not None and exposure_ms is not None:
        # a matt white surface has the luminance E / pi; a pixel takes that of its square into the pupil's solid angle
        lumen = 1e3 / math.pi * (1e-3 * mm_per_px) ** 2 * math.pi / 4.0 * (focal_mm / f_number / standoff_mm) ** 2
        photons = 1e-3 * exposure_ms * lumen / _LM_PER_W / _PHOTON_J
    stated = {"focal_mm": focal_mm, "f_number": f_number, "exposure_ms": exposure_ms, "speed_mm_s": speed_mm_s}
    return PlannedView(
        field_mm=(image_size_px[0] * mm_per_px, image_size_px[1] * mm_per_px),
        um_per_px=1e3 * mm_per_px,
        speckle_mm=(_SPECKLE_PX[0] * mm_per_px, _SPECKLE_PX[1] * mm_per_px),
        depth_mm=depth,
        blur_px=blur,
        photons_at_1000_lx=photons,
        missing=tuple(name for name, value in stated.items() if value is None),
    )
