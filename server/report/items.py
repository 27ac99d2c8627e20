"""The items of the report's tables: a value with its source, or the note that it was not stated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereorig.core.names import CAMERAS, CameraName

#: where metadata of a test are entered; the page links it
METADATA_FORM = "the form Metadata of the test's screen (PUT /tests/{id}/metadata, or metadata.toml)"
UM, UM_PER_M = "\u00b5m", "\u00b5m/m"
_MINUS, _NARROW_SPACE = "\u2212", "\u202f"
_SMALL_MM, _LARGE_STRAIN = 0.1, 0.01
CALIBRATION, MEASURED, STATED, RECORD, SETTINGS = (
    "from the calibration",
    "measured here",
    "as stated",
    "recorded with the images",
    "settings of the analysis",
)


@dataclass(frozen=True)
class Missing:
    """An item that was not stated, and how it can be stated."""

    name: str
    remedy: str


@dataclass(frozen=True)
class Value:
    """Value of an item: text, the number behind it in the unit of the text, its source."""

    text: str
    number: float | None = None
    origin: str = ""


@dataclass(frozen=True)
class Item:
    """An item of the tables.

    Attributes
    ----------
    key
        Its id in the page.
    label
        Its name.
    values
        One for the rig, or one for each camera; None if it is not stated.
    remedy
        Instruction how to state it.
    comment
        Method by which it was found, or its meaning.
    """

    key: str
    label: str
    values: tuple[Value | None, ...]
    remedy: str = ""
    comment: str = ""

    @property
    def remarks(self) -> str:
        """Return the sources of its values, and the comment."""
        origins = dict.fromkeys(v.origin for v in self.values if v is not None)
        return "; ".join(text for text in (*origins, self.comment) if text)

    @property
    def unstated(self) -> bool:
        """True if it has no value at all."""
        return all(v is None for v in self.values)

    @property
    def missing(self) -> list[Missing]:
        """Return the part that is not stated: the item, or the cameras that lack it."""
        if self.unstated:
            return [Missing(self.label, self.remedy)]
        lacking = [cam for cam, v in zip(CAMERAS, self.values, strict=False) if v is None]
        return [Missing(f"{self.label}, {cam}", self.remedy) for cam in lacking]


def one(key: str, label: str, value: Value | None, remedy: str = "", comment: str = "") -> Item:
    """An item of the whole rig."""
    return Item(key, label, (value,), remedy, comment)


def each(key: str, label: str, of: Callable[[CameraName], Value | None], remedy: str = "", comment: str = "") -> Item:
    """An item of each camera."""
    return Item(key, label, tuple(of(cam) for cam in CAMERAS), remedy, comment)


def of_text(value: str | None, origin: str) -> Value | None:
    """A text as a value; None of nothing."""
    return None if not value else Value(value, None, origin)


def of_number(value: float | None, form: str, unit: str, origin: str) -> Value | None:
    """A number with its unit as a value; None of nothing."""
    return None if value is None else Value(f"{value:{form}} {unit}".strip(), float(value), origin)


def shown_unit(units: str, size: float, *, strain: bool = False) -> tuple[float, str]:
    """Return the factor and the unit that the page shows numbers in.

    Parameters
    ----------
    units
        Unit of the stored numbers.
    size
        The largest of them.
    strain
        True: shown in um/m, from 1 % on in %.
    """
    if strain:
        return (100.0, "%") if size >= _LARGE_STRAIN else (1e6, UM_PER_M)
    return (1e3, UM) if units == "mm" and size < _SMALL_MM else (1.0, "" if units == "1" else units)


def rounded(value: float, u: float | None) -> str:
    """Return a value and its uncertainty with two digits of it, as the page writes them; without one four digits."""
    if u is None or not np.isfinite(u) or u <= 0.0:
        return _written(value, int(max(0, 3 - np.floor(np.log10(abs(value))))) if value else 0)
    two = float(f"{u:.1e}")
    decimals = int(1 - np.floor(np.log10(two) + 1e-12))
    return f"{_written(value, decimals)} \u00b1 {_written(two, decimals)}"


def _written(value: float, decimals: int) -> str:
    """Return a number to a decimal place (-1: tens), with narrow spaces between thousands from five digits on."""
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    whole, point, rest = text.lstrip("-").partition(".")
    if len(whole) > 4:
        whole = f"{int(whole):,}".replace(",", _NARROW_SPACE)
    return f"{_MINUS if float(text) < 0.0 else ''}{whole}{point}{rest}"


def plain(value: float, digits: int = 4) -> str:
    """Return a number with so many digits, without an exponent down to 1e-6."""
    if value == 0.0 or not np.isfinite(value):
        return "0" if value == 0.0 else "-"
    decimals = int(max(0, digits - 1 - np.floor(np.log10(abs(value)))))
    return f"{value:.{min(decimals, 12)}f}" if abs(value) >= 1e-6 else f"{value:.{digits - 1}e}"
