"""Metadata of a camera and its lens: stated in the rig file, kept with every step.

An entry that the operator did not state is None, never a guess.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

Text = Annotated[str, StringConstraints(min_length=1, max_length=500, strip_whitespace=True)]
Above = Annotated[float, Field(strict=True, gt=0.0, le=1e6, allow_inf_nan=False)]


class ClosedMetadata(BaseModel):
    """Base of metadata: closed and frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class LensMetadata(ClosedMetadata):
    """[cam1.lens], [cam2.lens]: the lens, as printed on it; for reports, nothing is computed from it."""

    maker: Text | None = Field(None, description="Maker of the lens.", examples=["Schneider-Kreuznach"])
    model: Text | None = Field(None, description="Model of the lens.", examples=["Xenoplan 2.8/50"])
    focal_length_mm: Above | None = Field(None, description="Nominal focal length.", examples=[50.0])
    f_number: Above | None = Field(None, description="Aperture that was set, as the f-number.", examples=[8.0])
    note: Text | None = Field(None, description="Filters, extension tubes, polarisers.")


class CameraMetadata(ClosedMetadata):
    """A camera by its data sheet; for reports, nothing is computed from it but lengths on the sensor."""

    maker: Text | None = Field(None, description="Maker of the camera.", examples=["Basler"])
    model: Text | None = Field(None, description="Model; the camera's own report takes precedence.")
    sensor: Text | None = Field(None, description="The sensor.", examples=["Sony IMX250, CMOS, global shutter"])
    pixel_um: Above | None = Field(None, description="Width of a pixel on the sensor.", examples=[3.45])
    lens: LensMetadata | None = Field(None, description="The lens.")


def merged(over: CameraMetadata | None, under: Mapping[str, object] | None) -> CameraMetadata:
    """Merge the metadata of a camera entry by entry: ``over`` takes precedence over ``under``, a step's record."""
    stated = CameraMetadata.model_validate({k: v for k, v in (under or {}).items() if k in CameraMetadata.model_fields})
    if over is None:
        return stated
    document, lens = over.model_dump(exclude_none=True), over.lens
    both = {**stated.model_dump(exclude_none=True), **document}
    if lens is not None and stated.lens is not None:
        both["lens"] = {**stated.lens.model_dump(exclude_none=True), **lens.model_dump(exclude_none=True)}
    return CameraMetadata.model_validate(both)
