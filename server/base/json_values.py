"""Values that JSON can hold."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Mapping
from json import JSONDecodeError
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


# Long JSON documents, read so that other threads get their turn.
#
# One call of Python's decoder keeps all other threads waiting: half a second for the summary of an analysis of 5,000
# steps. Here each entry of a document's lists and objects is a call of its own.

Keep = Callable[[Any], Any]

#: shorter texts are decoded in some milliseconds
_LONG = 200_000
#: levels of a document whose entries are read one by one: its own members, and theirs
_LEVELS = 2
_decode = json.JSONDecoder().raw_decode
_GAP = re.compile(r"[ \t\n\r]*")


def loads(text: str, keep: Mapping[str, Keep] | None = None) -> Any:
    """Return what ``json.loads`` returns.

    Parameters
    ----------
    text
        The document.
    keep
        By the name of one of the document's lists, what is made of each entry as it is read; entries of which nothing
        (None) is kept are left out.

    Raises
    ------
    JSONDecodeError
        The text is no JSON.
    """
    if len(text) < _LONG and not keep:
        return json.loads(text)
    reader = _Reader(text)
    value = reader.value(_LEVELS, keep or {})
    if reader.next_character():
        raise JSONDecodeError("Extra data", text, reader.at)
    return value


def nothing(_entry: Any) -> None:
    """Keep nothing of an entry."""


def the_first(most: int) -> Keep:
    """Return what keeps so many entries of one list, and nothing of those behind them."""
    numbers = itertools.count()
    return lambda entry: entry if next(numbers) < most else None


class _Reader:
    """A text, and how far it was read."""

    def __init__(self, text: str) -> None:
        self._text = text
        self.at = 0

    def value(self, levels: int, keep: Mapping[str, Keep]) -> Any:
        """Read a value; one of ``levels`` from the bottom entry by entry."""
        first = self.next_character()
        if levels and first == "[":
            return self._list(levels, None)
        if levels and first == "{":
            return self._object(levels, keep)
        found, self.at = _decode(self._text, self.at)
        return found

    def next_character(self) -> str:
        """Go on to the next character that is no white space, and return it; empty at the end."""
        gap = _GAP.match(self._text, self.at)
        assert gap is not None
        self.at = gap.end()
        return self._text[self.at : self.at + 1]

    def _list(self, levels: int, keep: Keep | None) -> list[Any]:
        entries: list[Any] = []
        begun = False
        while self._another("]", first=not begun):
            begun = True
            entry = self.value(levels - 1, {})
            if keep is None:
                entries.append(entry)
            elif (kept := keep(entry)) is not None:
                entries.append(kept)
        return entries

    def _object(self, levels: int, keep: Mapping[str, Keep]) -> dict[str, Any]:
        members: dict[str, Any] = {}
        begun = False
        while self._another("}", first=not begun):
            begun = True
            if self.next_character() != '"':
                raise JSONDecodeError("Expecting property name enclosed in double quotes", self._text, self.at)
            name, self.at = _decode(self._text, self.at)
            self._take(":")
            kept = keep.get(name)
            members[name] = (
                self._list(levels - 1, kept) if kept and self.next_character() == "[" else self.value(levels - 1, {})
            )
        return members

    def _another(self, closing: str, *, first: bool) -> bool:
        """Return whether another entry follows, and go to it, or behind the end."""
        if first:
            self.at += 1
            if self.next_character() != closing:
                return True
        elif self.next_character() == ",":
            self.at += 1
            return True
        self._take(closing)
        return False

    def _take(self, character: str) -> None:
        if self.next_character() != character:
            raise JSONDecodeError(f"Expecting {character!r}", self._text, self.at)
        self.at += 1
