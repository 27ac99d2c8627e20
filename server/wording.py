"""The values that pydantic found wrong in a request, a file or a form: the place of each, and pydantic's message."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import ValidationError
from pydantic_core import ErrorDetails

_MOST = 40
_LONGEST = 500
_LONGEST_FIELD = 200
_LONGEST_VALUE = 60


@dataclass(frozen=True)
class FieldProblem:
    """One wrong value.

    Attributes
    ----------
    field
        Names and numbers that lead to the value, joined by points; empty for the whole document.
    problem
        Pydantic's message, without a full stop.
    """

    field: str
    problem: str

    def __str__(self) -> str:
        return f"{self.field}: {self.problem}." if self.field else f"{self.problem}."


def problems_in(error: ValidationError) -> list[FieldProblem]:
    """Return the values that a model refused."""
    return [field_problem(one) for one in error.errors(include_url=False)[:_MOST]]


def field_problem(error: ErrorDetails, *, skip: int = 0) -> FieldProblem:
    """Return one of pydantic's errors; ``skip`` leaves out parts at the beginning of its place (``body``)."""
    message = str(error["msg"]).removeprefix("Value error, ")
    if message.startswith("Expected UploadFile"):  # the rest of this message names a class
        message = "Input should be a file"
    if message.startswith("Input should"):
        message += _got(error.get("input"))
    place = ".".join(str(part) for part in error["loc"][skip:])
    return FieldProblem(place[:_LONGEST_FIELD], message[:_LONGEST])


def _got(value: object) -> str:
    if not isinstance(value, str | int | float | bool):
        return ""
    text = repr(value[:_LONGEST_VALUE] if isinstance(value, str) else value)
    return f", got {text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + '...'}"
