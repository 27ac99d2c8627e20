"""Description of a load frame's record as the reader recognised it, for the user to confirm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel, Field

#: of the examples of lines and of doubtful cells, and characters of each
MOST_SHOWN, LONGEST_SHOWN = 5, 80


Decimal = Literal[".", ","]


@dataclass(frozen=True)
class RecordOptions:
    """Answers of a user to the questions that a record may leave open.

    Attributes
    ----------
    time_column
        Title of the times' column, its channel's name, or its number from 1.
    decimal
        Decimal mark of all numbers.
    segment
        Number from 1 of the readings between two restarts of the clock, or above a footer; 0 for all.
    date_order
        Of dates as 03/01/2026.
    """

    time_column: str | None = None
    decimal: Decimal | None = None
    segment: int | None = None
    date_order: Literal["dmy", "mdy"] | None = None


def shown(text: str, longest: int = LONGEST_SHOWN) -> str:
    """Return a text of the file on one line, cut to a length that can be shown."""
    return "".join(c if c.isprintable() else " " for c in text[:longest])


class RecordColumn(BaseModel):
    """A column of a record."""

    title: str = Field(description="As the file has it, without the unit.")
    unit: str = Field(description="As the file states it; `1` for none.")
    kind: Literal["time", "date", "numbers", "text", "empty"] = Field(description="`numbers` become a channel.")
    name: str | None = Field(None, description="Name of its channel; null if it becomes none.")
    decimal: str | None = Field(None, description="Decimal mark of its numbers; null if none has one.")
    numbers: int = Field(0, description="Cells that are numbers.")
    empty: int = Field(0, description="Cells that are empty, or state that there was no reading, as `NaN`.")
    unread: int = Field(0, description="Cells that are neither; no step gets a value that would bridge one.")
    example: str = Field("", description="Its first cell that is not empty, as the file has it.")


class RecordLine(BaseModel):
    """A line of a record that was left out."""

    line: int = Field(description="Number of the line, from 1.")
    text: str = Field(description="Its first characters.")


class RecordSegment(BaseModel):
    """Readings over which the clock does not fall."""

    first_line: int = Field(description="Line of its first reading.")
    last_line: int = Field(description="Line of its last reading.")
    readings: int = Field(description="Its readings.")
    from_s: float = Field(description="Time of its first reading.")
    to_s: float = Field(description="Time of its last reading.")


class RecordQuestion(BaseModel):
    """An open question about the file: the import is refused until the option answers it."""

    option: Literal["time_column", "decimal", "segment", "date_order"] = Field(description="Option that answers it.")
    cause: str = Field(description="The open question, with an example from the file.")
    choices: list[str] = Field(description="The option's values.")


class RecordRead(BaseModel):
    """The recognised parts of a record."""

    encoding: str = Field(description="Encoding of the text.")
    separator: str = Field(description="Separator of the cells: `tab`, `semicolon`, `comma`, `bar`, `blanks`.")
    titles_line: int = Field(description="Line of the titles.")
    columns: list[RecordColumn] = Field(description="Every column of the table.")
    left_above: int = Field(description="Lines above the table that were left out, titles and units not counted.")
    left_between: int = Field(description="Lines between its readings that were left out.")
    left_below: int = Field(description="Lines below it that were left out.")
    left_lines: list[RecordLine] = Field(description="The first of these lines.")
    segments: list[RecordSegment] = Field(description="More than one if the clock falls: the first 100.")
    doubts: list[str] = Field(description="To be checked by the user: cells and rows that were not read, assumptions.")
    questions: list[RecordQuestion] = Field(description="Questions that the file leaves open.")
