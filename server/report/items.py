"""The items of the report's tables: a value with its source, or the note that it was not stated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereorig.core.names import CAMERAS, CameraName

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
    def missing(self) -> list[Missing]:
        """Return the part that is not stated: the item, or the cameras that lack it."""
        if all(v is None for v in self.values):
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


def plain(value: float, digits: int = 4) -> str:
    """Return a number with so many digits, without an exponent down to 1e-6."""
    if value == 0.0 or not np.isfinite(value):
        return "0" if value == 0.0 else "-"
    decimals = int(max(0, digits - 1 - np.floor(np.log10(abs(value)))))
    return f"{value:.{min(decimals, 12)}f}" if abs(value) >= 1e-6 else f"{value:.{digits - 1}e}"
