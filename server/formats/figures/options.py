"""Options of drawing a field; separate from the drawing, which takes a second to load."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.errors import InputError

COLOURS = ("viridis", "cividis", "turbo", "coolwarm", "gray", "diverging", "grey")
WIDTHS_PX = (200, 4000)
MAX_LEVELS = 64


@dataclass(frozen=True)
class FigureStyle:
    """Options of drawing a field.

    Attributes
    ----------
    limits
        Ends of the colour scale in the variable's unit; None: from ``percentiles``.
    percentiles
        Percentiles of the drawn values at which the colour scale ends; values beyond get the end's colour and an arrow.
    colours
        One of :data:`COLOURS`.
    width_px
        Width of the picture.
    opacity
        Opacity of the map over the camera's image.
    levels
        Number of bands of one colour; 0: smooth.
    reverse
        True: the first colour belongs to the largest values.
    dots_per_inch
        Resolution; the larger, the larger are lettering and lines.

    Raises
    ------
    InputError
        ``figure_style_invalid``.
    """

    limits: tuple[float, float] | None = None
    percentiles: tuple[float, float] = (1.0, 99.0)
    colours: str = "viridis"
    width_px: int = 900
    opacity: float = 0.75
    levels: int = 0
    reverse: bool = False
    dots_per_inch: int = 100

    def __post_init__(self) -> None:
        wrong = None
        if self.limits is not None and not (np.isfinite(self.limits).all() and self.limits[0] < self.limits[1]):
            wrong = f"the limits {self.limits[0]:g} and {self.limits[1]:g} are not two numbers, the smaller first"
        elif not 0.0 <= self.percentiles[0] < self.percentiles[1] <= 100.0:
            wrong = f"the percentiles {self.percentiles[0]:g} and {self.percentiles[1]:g} do not rise within 0 to 100"
        elif self.colours not in COLOURS:
            wrong = f"there are no colours {self.colours!r}"
        elif not WIDTHS_PX[0] <= self.width_px <= WIDTHS_PX[1]:
            wrong = f"a width of {self.width_px} px is not between {WIDTHS_PX[0]} and {WIDTHS_PX[1]}"
        elif not 0.0 < self.opacity <= 1.0:
            wrong = f"an opacity of {self.opacity:g} is not above 0 and at most 1"
        elif not 0 <= self.levels <= MAX_LEVELS:
            wrong = f"{self.levels} bands of colour are not between 0 and {MAX_LEVELS}"
        elif not 50 <= self.dots_per_inch <= 600:
            wrong = f"{self.dots_per_inch} dots an inch are not between 50 and 600"
        if wrong is not None:
            raise InputError(
                f"A picture cannot be drawn so: {wrong}.",
                code="figure_style_invalid",
                remedy=f"Correct it; colours are {', '.join(COLOURS)}.",
            )
