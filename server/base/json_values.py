"""Values that JSON can hold."""

from __future__ import annotations

import math
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError
from typing_extensions import TypeAliasType

from stereorig.core.errors import InputError

Asked = TypeVar("Asked")

#: rows of numbers, nested as deep as an array has axes; null where a value is missing
Nested = TypeAliasType("Nested", "list[float | int | str | Nested | None]")


def without_nan(value: Any) -> Any:
    """Replace NaN and infinities by None, tuples by lists, in nested JSON-like data."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(k): without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    return value


def asked_in(text: str, kind: TypeAdapter[Asked], *, named: str, code: str, remedy: str) -> Asked:
    """Return the request in a JSON text.

    Parameters
    ----------
    text, kind
        The text, and the type of its value.
    named
        Name of the value in the error: ``frame``.
    code, remedy
        Code and remedy of the error.

    Raises
    ------
    InputError
        ``code``, with the first thing that is wrong.
    """
    try:
        return kind.validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(
            f"{text[:60]!r} names no {named}: {f'{where}: ' if where else ''}{first['msg']}.", code=code, remedy=remedy
        ) from error
