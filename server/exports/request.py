"""Requests for exports; separate from the exporting code, which takes seconds to load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from stereorig.core.errors import InputError
from stereorig.core.settings import Coverage, CoverageFields
from stereorig.server.formats.figures.options import FigureStyle

ExportFormat = Literal["nc", "csv", "vtu", "mat", "h5", "png", "svg", "gif", "mp4"]
FORMATS: tuple[ExportFormat, ...] = get_args(ExportFormat)
MEDIA_TYPES: dict[ExportFormat, str] = {
    "nc": "application/x-netcdf",
    "csv": "text/csv; charset=utf-8",
    "vtu": "application/zip",
    "mat": "application/x-matlab-data",
    "h5": "application/x-hdf5",
    "png": "image/png",
    "svg": "image/svg+xml",
    "gif": "image/gif",
    "mp4": "video/mp4",
}
#: as a description of the API lists them
MEDIA_CONTENT: dict[int | str, object] = {media.split(";")[0]: {} for media in MEDIA_TYPES.values()}
_MAX_STEP = 9999


def media_type_of(made: Path) -> str:
    """Return the media type of an export's file."""
    form = made.suffix.removeprefix(".")
    return next((media for name, media in MEDIA_TYPES.items() if name == form), "application/zip")


@dataclass(frozen=True)
class ExportRequest:
    """An export to make.

    Attributes
    ----------
    format
        One of :data:`FORMATS`.
    steps
        Numbers; None: all that are finished.
    variables
        Names in the result files; None: all, of pictures and films the displacement ``w_mm`` or the shape ``z_mm``.
    style
        Of pictures and films.
    over_image
        Draw over camera 1's reference image.
    fps
        Steps a second in a film.
    coverage
        Coverage of expanded uncertainties in addition to the standard ones; one standard uncertainty: none.
    """

    format: ExportFormat
    steps: Sequence[int] | None = None
    variables: Sequence[str] | None = None
    style: FigureStyle = field(default_factory=FigureStyle)
    over_image: bool = False
    fps: float = 2.0
    coverage: CoverageFields = field(default_factory=lambda: Coverage.model_validate({}))

    @property
    def drawn_variables(self) -> Sequence[str] | None:
        """Variables that are read; None: all. Without a name a picture shows ``w_mm`` or ``z_mm``."""
        if self.variables is None and self.format in ("png", "svg", "gif", "mp4"):
            return ("w_mm",)
        return self.variables


def steps_in(text: str) -> list[int]:
    """Return the step numbers in a text such as ``0,3-7``.

    Raises
    ------
    InputError
        ``step_invalid``.
    """
    numbers: set[int] = set()
    for part in text.split(","):
        first, _, last = part.partition("-")
        try:
            low, high = int(first), int(last or first)
        except ValueError:
            low, high = 0, -1
        if not 0 <= low <= high <= _MAX_STEP:
            raise InputError(
                f"{part!r} is neither a step's number nor a range of them.",
                code="step_invalid",
                remedy="Give a number, or numbers and ranges such as 0,3-7.",
            )
        numbers.update(range(low, high + 1))
    return sorted(numbers)
