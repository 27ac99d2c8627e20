"""Metadata of a test that no device reports: lenses, light, pattern, specimen, purpose.

Nothing here is measured or guessed. An entry that was not stated is None, and a report lists it as not stated. Entries
about cameras and lenses come from the rig file and are stored with every captured step; a test's own take precedence.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field, StringConstraints, ValidationError

from stereorig.core.errors import FileFormatError
from stereorig.server.base.models import StepNumber
from stereorig.server.config.camera_metadata import Above, CameraMetadata, ClosedMetadata, Text
from stereorig.server.results.gauges.request import GaugeRequest
from stereorig.server.wording import problems_in


class TestMetadata(ClosedMetadata):
    """Metadata of one test."""

    purpose: Text | None = Field(None, description="Purpose of the test.")
    laboratory: Text | None = Field(None, description="Laboratory, address.")
    operator: Text | None = Field(None, description="Operator who ran it.")
    specimen: Text | None = Field(None, description="The specimen; instead of the test's own field of that name.")
    material: Text | None = Field(None, description="Its material.", examples=["Aluminium 6061-T6"])
    loading: Text | None = Field(None, description="Loading: machine, rate, control, load cell.")
    environment: Text | None = Field(None, description="Temperature, humidity, vibration.")
    lighting: Text | None = Field(
        None, description="Lamps, their arrangement, polarisation.", examples=["2 LED panels, 45 degrees, diffuse"]
    )
    pattern_technique: Text | None = Field(
        None,
        description="Technique by which the pattern was applied.",
        examples=["matt white ground, black spray paint"],
    )
    pattern_feature_mm: Above | None = Field(
        None, description="Size of the pattern's features as stated by the operator; a report also measures it."
    )
    pattern_feature_method: Text | None = Field(
        None, description="Source of pattern_feature_mm.", examples=["stamp of 0.18 mm dots"]
    )
    standoff_mm: Above | None = Field(
        None, description="Distance from the lens to the specimen by a ruler; a report also computes the pinhole's."
    )
    frame_rate_hz: Above | None = Field(None, description="Rate at which the images were taken.")
    exposure_ms: Above | None = Field(None, description="Exposure of both cameras, where their records do not have it.")
    cam1: CameraMetadata | None = Field(None, description="Camera 1; takes precedence over the rig file.")
    cam2: CameraMetadata | None = Field(None, description="Camera 2.")
    static_steps: list[StepNumber] | None = Field(
        None,
        description="Steps in which nothing moved since the reference: noise floor and bias come from them. Left out: "
        "steps whose label begins with the word `static`.",
        max_length=10_000,
    )
    gauges: GaugeRequest | None = Field(None, description="Gauges whose histories the report shows.")
    notes: Annotated[str, StringConstraints(max_length=20_000)] | None = Field(None, description="Anything else.")

    def camera(self, cam: str) -> CameraMetadata | None:
        """Return the metadata of one camera."""
        return self.cam1 if cam == "cam1" else self.cam2

    def document(self) -> dict[str, object]:
        """Return the entries that were stated."""
        return self.model_dump(mode="json", exclude_none=True)


def parse_metadata(document: Mapping[str, object], *, name: str) -> TestMetadata:
    """Validate metadata.

    Raises
    ------
    FileFormatError
        ``metadata_invalid``, one line that names the first wrong field.
    """
    try:
        return TestMetadata.model_validate(dict(document))
    except ValidationError as error:
        first = problems_in(error)[0]
        where = first.field or "file"
        raise FileFormatError(
            f"{name}: {where}: {first.problem}.",
            code="metadata_invalid",
            field=where,
            remedy="Correct it; docs/how_to/report.md lists the entries.",
        ) from error


def load_metadata(path: Path) -> TestMetadata:
    """Read a ``metadata.toml``.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable``, ``metadata_invalid``.
    """
    try:
        return parse_metadata(tomllib.loads(path.read_text(encoding="utf-8")), name=str(path))
    except FileNotFoundError as error:
        raise FileFormatError(f"{path} does not exist.", code="file_missing", remedy="Check the path.") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileFormatError(f"{path} cannot be read as TOML: {error}.") from error
