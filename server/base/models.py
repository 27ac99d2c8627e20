"""Base of all models: strict numbers, closed requests, open replies."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainSerializer,
    StringConstraints,
    WithJsonSchema,
)
from pydantic.config import JsonDict
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import core_schema

from stereorig.core.settings import Real, Whole


def _not_a_truth_value(value: Any) -> Any:
    # true would be taken for 1: an axis would move by a millimetre
    if isinstance(value, bool):
        raise ValueError("must be a number, not true or false")
    return value


AXIS_PATTERN = r"^([1-9]|[12][0-9]|3[01])$"


def _axis_number(value: Any) -> Any:
    # as int() reads them, "01", "+1" and " 1 " would name an axis too
    if isinstance(value, str) and not re.fullmatch(AXIS_PATTERN, value):
        raise ValueError("must be the number of an axis, 1 to 31")
    return _not_a_truth_value(value)


def _a_text(value: Any) -> Any:
    # a bare number could be seconds or milliseconds, of any clock
    if not isinstance(value, str):
        raise ValueError("must be text as in 2026-03-01T12:00:00Z")
    return value


def _in_utc(value: datetime) -> datetime:
    try:
        return value.astimezone(UTC)
    except OverflowError as error:
        raise ValueError("is outside the calendar in UTC") from error


#: characters of a line of text, as browsers and schemas read it: no control character, no break of a line, none that
#: turns the direction of later ones (which shows one name as another)
ONE_LINE = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]*$"
SOME_LINES = r"^[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]*$"
# halves of a character too, which no file and no answer could hold
_NO_LINE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_NO_TEXT = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")


def _without(forbidden: re.Pattern[str], value: str) -> str:
    found = forbidden.search(value)
    if found is not None:
        raise ValueError(
            f"must have no control characters, has U+{ord(found[0]):04X} as its character {found.start() + 1}"
        )
    return value


def one_line(value: str) -> str:
    """Return a name or label as it is; raise ValueError if it holds a control character."""
    return _without(_NO_LINE, value)


def plain_text(value: str) -> str:
    """Return text of several lines as it is; raise ValueError if it holds another control character."""
    return _without(_NO_TEXT, value)


@dataclass(frozen=True)
class _WithoutControl:
    """Mark of a text, after its length: no control characters, which the schema states too."""

    check: Callable[[str], str]
    pattern: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {**handler(schema), "pattern": self.pattern}


def utc_text(value: datetime) -> str:
    """Write a time as it is stored: ISO 8601 in UTC, to the microsecond."""
    return value.isoformat(timespec="microseconds").replace("+00:00", "Z")


#: true or false, and no number or text that could be read so
Switch = Annotated[bool, Field(strict=True)]
Number = Annotated[Real, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]


ON_ONE_LINE = _WithoutControl(one_line, ONE_LINE)
Label = Annotated[str, StringConstraints(max_length=300), ON_ONE_LINE]
Notes = Annotated[str, StringConstraints(max_length=20_000), _WithoutControl(plain_text, SOME_LINES)]
StepNumber = Annotated[Whole, Field(ge=0, le=9999)]
#: a number for each of some axes
AxisValues = Annotated[
    dict[Annotated[int, BeforeValidator(_axis_number), Field(ge=1, le=31)], Number],
    Field(min_length=1, max_length=6),
    WithJsonSchema(
        {
            "type": "object",
            "propertyNames": {"pattern": AXIS_PATTERN},
            "additionalProperties": {"type": "number", "minimum": -1e9, "maximum": 1e9},
            "minProperties": 1,
            "maxProperties": 6,
        }
    ),
]
#: a number in a form, where everything is text
FormNumber = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]
Channels = Annotated[
    dict[Annotated[str, StringConstraints(min_length=1, max_length=100), AfterValidator(one_line)], Number],
    Field(max_length=50),
    WithJsonSchema(
        {
            "type": "object",
            "propertyNames": {"minLength": 1, "maxLength": 100, "pattern": ONE_LINE},
            "additionalProperties": {"type": "number", "minimum": -1e9, "maximum": 1e9},
            "maxProperties": 50,
        }
    ),
]
Timestamp = Annotated[
    AwareDatetime,
    BeforeValidator(_a_text),
    AfterValidator(_in_utc),
    PlainSerializer(utc_text, return_type=str),
    Field(examples=["2026-03-01T12:00:00.250Z"]),
]
JobState = Literal["queued", "running", "cancelling", "succeeded", "failed", "cancelled", "interrupted"]


class Request(BaseModel):
    """A body: closed, finite numbers only."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def one_of(*names: str) -> JsonDict:
    """Return the schema's words for: exactly one of these fields, and not null."""
    return {"oneOf": [given(name) for name in names]}


def any_of(*names: str) -> JsonDict:
    """Return the schema for: at least one of these fields, and not null."""
    return {"anyOf": [given(name) for name in names]}


def not_both(*names: str) -> JsonDict:
    """Return the schema's words for: not all of these fields."""
    return {"not": {"allOf": [given(name) for name in names]}}


def given(name: str) -> JsonDict:
    """Return the schema's words for: this field is there, and neither null nor an empty list."""
    return {"required": [name], "properties": {name: {"not": {"type": "null"}, "minItems": 1}}}


class Listing(BaseModel):
    """A page of a list."""

    model_config = ConfigDict(extra="allow")

    next_cursor: str | None = Field(
        None, description="Send it as `cursor` for the page after this one; null on the last page."
    )


class Reply(BaseModel):
    """An answer; may gain fields in later versions."""

    model_config = ConfigDict(extra="allow")


def always_there(schema: JsonDict) -> None:
    """State in a model's schema that none of its fields is ever left out."""
    properties = schema["properties"]
    assert isinstance(properties, dict)
    schema["required"] = list(properties)
    for field in properties.values():
        assert isinstance(field, dict)
        field.pop("default", None)


class Reported(Reply):
    """A device's report: the fields of a driver's dataclass; their defaults are the driver's."""

    model_config = ConfigDict(json_schema_extra=always_there)


#: ids of a thing that was made: ids, a step's number, a reading's value
Ids = dict[str, str | int | float]


class Document(BaseModel):
    """A document as it is kept; it may hold entries that are unknown to this version."""

    model_config = ConfigDict(extra="allow", frozen=True)

    def plain(self) -> dict[str, object]:
        """Return the entries that the document has, and no others."""
        return self.model_dump(exclude_unset=True)
