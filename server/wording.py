"""What is wrong with a body, a query or a form, in the words of who sent it: which name, what it must be.

The validator's own sentences name its classes ("Extra inputs are not permitted", "Input should be a valid tuple"); here
they become what the sender can act on. What is permitted is read out of the model that refused.
"""

from __future__ import annotations

import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import AliasChoices, BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails
from typing_extensions import TypeAliasType

_SCALARS = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
_LISTS: tuple[object, ...] = (list, set, frozenset, Sequence, Iterable)
_MOST_NAMES = 40
_LONGEST = 500

#: by the validator's name of an error; in braces its values, and `got`: what was sent
_SENTENCES = {
    "missing": "is missing",
    "greater_than_equal": "must be {ge} or more{got}",
    "greater_than": "must be more than {gt}{got}",
    "less_than_equal": "must be {le} or less{got}",
    "less_than": "must be less than {lt}{got}",
    "multiple_of": "must be a multiple of {multiple_of}{got}",
    "finite_number": "must be a finite number",
    "int_from_float": "must be a whole number{got}",
    "int_parsing": "must be a whole number{got}",
    "int_type": "must be a whole number{got}",
    "int_parsing_size": "must be a whole number of fewer digits",
    "float_parsing": "must be a number{got}",
    "float_type": "must be a number{got}",
    "bool_type": "must be true or false{got}",
    "bool_parsing": "must be true or false{got}",
    "string_type": "must be text{got}",
    "string_unicode": "must be text in UTF-8",
    "string_too_short": "must have {min_length} or more characters",
    "string_too_long": "must have {max_length} characters at most",
    "string_pattern_mismatch": "must be of the form {pattern}{got}",
    "literal_error": "must be {expected}{got}",
    "enum": "must be {expected}{got}",
    "timezone_aware": "must have a time zone, as in 2026-03-01T12:00:00Z",
    "too_long": "must have {max_length} entries at most, has {actual_length}",
    "too_short": "must have {min_length} or more entries, has {actual_length}",
    "union_tag_not_found": "needs {discriminator}, which says what it is; one of {permitted}",
    "union_tag_invalid": "{discriminator} must be one of {expected_tags}, not {tag!r}",
    "json_invalid": "cannot be read as JSON: {error}",
    "json_type": "must be JSON",
}
_TIMES = ("datetime_", "date_", "time_")


@dataclass(frozen=True)
class FieldProblem:
    """What is wrong with one value.

    Attributes
    ----------
    field
        Names and numbers that lead to it, with points between them; empty for the whole.
    problem
        What it must be, without a full stop.
    """

    field: str
    problem: str

    def __str__(self) -> str:
        if self.field:
            return f"{self.field}: {self.problem}."
        return (
            f"{self.problem[:1].upper()}{self.problem[1:]}." if " must be " not in self.problem else f"{self.problem}."
        )


def problems_in(error: ValidationError, model: object) -> list[FieldProblem]:
    """Return what a model found wrong with what it was given, in the sender's words."""
    return in_words(error.errors(include_url=False), model)


def in_words(errors: Sequence[ErrorDetails], expected: object, *, skip: int = 0) -> list[FieldProblem]:
    """Return what is wrong in the sender's words; what is wrong in the same way at many places is said once.

    Parameters
    ----------
    errors
        As the validator tells them.
    expected
        The model or type that was asked for; None where it is not known.
    skip
        Parts at the beginning of each place that lead to the whole (``body``).
    """
    alike: dict[tuple[tuple[str, ...], str], list[tuple[object, ...]]] = {}
    for error in errors:
        place, candidates = _follow(expected, error["loc"][skip:])
        if error["type"] == "missing" and place and isinstance(place[-1], int):
            place, problem = place[:-1], f"has too few entries{_must(_follow(expected, place[:-1])[1])}"
        else:
            problem = _sentence(error, candidates, _follow(expected, error["loc"][skip:-1])[1])
        pattern = tuple("*" if isinstance(part, int) else str(part) for part in place)
        places = alike.setdefault((pattern, problem), [])
        if place not in places:
            places.append(place)
    found: dict[tuple[object, ...], list[str]] = {}
    for (_, problem), places in alike.items():
        more = len(places) - 1
        found.setdefault(places[0], []).append(f"{problem} (and {more} more alike)" if more else problem)
    # a value that may be of several kinds was refused by each of them
    return [FieldProblem(_joined(place), _or(problems)[:_LONGEST]) for place, problems in found.items()]


def _or(problems: Sequence[str]) -> str:
    return " or ".join([problems[0], *(problem.removeprefix("must be ") for problem in problems[1:])])


def _joined(place: Sequence[object]) -> str:
    return ".".join(str(part) for part in place)[:200]


def _sentence(error: ErrorDetails, candidates: Sequence[object], around: Sequence[object]) -> str:
    kind, values = error["type"], dict(error.get("ctx") or {})
    if kind == "extra_forbidden":
        return _unknown(str(error["loc"][-1]), around)
    values["got"] = _got(error.get("input"))
    values["permitted"] = ", ".join(repr(tag) for tag in _tags(candidates))
    if kind == "too_long" and values.get("actual_length") is None:
        values["actual_length"] = "more"
    must = _must(candidates).removeprefix(": ")
    if must and kind.endswith("_type") and len(candidates) > 1:
        return must
    if kind in _SENTENCES:
        return _SENTENCES[kind].format_map(_Plain(values))
    if kind.startswith(_TIMES):
        return f"must be a time as in 2026-03-01T12:00:00Z{values['got']}"
    if kind == "value_error" and "Expected UploadFile" in str(error["msg"]):
        return f"must be a file that is sent{values['got']}"  # of a form; a path or an address is only text
    if kind == "value_error":
        return str(error["msg"]).removeprefix("Value error, ")
    if must and kind.endswith(("_type", "_attributes_type", "_parsing")):
        return must
    return str(error["msg"]).replace("Input should", "must")


class _Plain(dict[str, Any]):
    """Values of a sentence; numbers without needless digits."""

    def __getitem__(self, name: str) -> Any:
        value = super().__getitem__(name)
        return f"{value:.12g}" if isinstance(value, float) else value

    def __missing__(self, name: str) -> str:
        return name


def _unknown(name: str, candidates: Sequence[object]) -> str:
    names = sorted({n for c in candidates if _is_model(c) for n in c.model_fields})  # type: ignore[attr-defined]
    if not names:
        return "is not known here"
    near = get_close_matches(name, names, n=1)
    meant = f"; {near[0]!r} is meant, perhaps" if near else ""
    return f"is not known here{meant}. What can be given: {', '.join(names[:_MOST_NAMES])}"


def _got(value: object) -> str:
    if isinstance(value, str | int | float | bool):
        text = {True: "true", False: "false"}[value] if isinstance(value, bool) else repr(value)
        return f", got {text if len(text) <= 60 else text[:57] + '...'}"
    return ""


def _must(candidates: Sequence[object]) -> str:
    kinds = list(dict.fromkeys(k for c in candidates if (k := _described(c))))
    return f": must be {' or '.join(kinds)}" if kinds else ""


def _described(kind: object) -> str:
    """Say what a type is, as who writes JSON would."""
    if kind in _SCALARS:
        return _SCALARS[kind]
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"one of {', '.join(repr(a) for a in arguments)}"
    if origin is tuple and arguments and arguments[-1] is not Ellipsis:
        inner = {_described(one) for argument in arguments for one in _kinds(argument)}
        many = "numbers" if inner <= {"a number", "a whole number"} else "entries"
        return f"a list of {len(arguments)} {many}"
    if origin in _LISTS or origin is tuple:
        inner_kinds = [_described(one) for one in _kinds(arguments[0])] if arguments else []
        return f"a list, each entry {' or '.join(filter(None, inner_kinds))}" if any(inner_kinds) else "a list"
    if origin in (dict, Mapping) or _is_model(kind):
        return "an object of names and values"
    return ""


def _is_model(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _kinds(kind: object) -> Iterator[object]:
    """Return the types that a value may have."""
    origin = get_origin(kind)
    if isinstance(kind, TypeAliasType):
        yield from _kinds(kind.__value__)
    elif origin is Annotated:
        yield from _kinds(get_args(kind)[0])
    elif origin in (Union, types.UnionType):
        for argument in get_args(kind):
            yield from _kinds(argument)
    elif kind is not type(None):
        yield kind


def _tags(candidates: Sequence[object]) -> list[str]:
    """Return the values that tell the models of a union apart."""
    return [tag for c in candidates if _is_model(c) for tag in _tag_of(c)]


def _tag_of(model: Any) -> list[str]:
    literals = [f.annotation for f in model.model_fields.values() if get_origin(f.annotation) is Literal]
    return [str(value) for literal in literals[:1] for value in get_args(literal)]


def _named(model: Any, name: object) -> FieldInfo | None:
    for own, field in model.model_fields.items():
        alias = field.validation_alias
        names = alias.choices if isinstance(alias, AliasChoices) else [alias]
        if name == own or name in names:
            return field  # type: ignore[no-any-return]
    return None


def _step(kind: object, part: object) -> list[object]:
    """Return the types of what a name or a number leads to in a value of a type; none if it leads nowhere."""
    origin, arguments = get_origin(kind), get_args(kind)
    if _is_model(kind):
        field = _named(kind, part)
        return [] if field is None else list(_kinds(field.annotation))
    if isinstance(part, int) and origin is tuple and arguments:
        return list(_kinds(arguments[min(part, len(arguments) - 1)]))
    if isinstance(part, int) and origin in _LISTS and arguments:
        return list(_kinds(arguments[0]))
    if origin in (dict, Mapping) and arguments and part != "[key]":
        return list(_kinds(arguments[1]))
    return []


def _follow(
    expected: object, parts: Sequence[int | str] | tuple[object, ...]
) -> tuple[tuple[object, ...], list[object]]:
    """Return a place without the validator's own names in it (of a union's types), and the types that fit there."""
    candidates = list(_kinds(expected)) if expected is not None else []
    place: list[object] = []
    for part in parts:
        inner = [kind for candidate in candidates for kind in _step(candidate, part)]
        if inner:
            place.append(part)
            candidates = inner
            continue
        chosen = [c for c in candidates if _is_model(c) and (part in _tag_of(c) or part == getattr(c, "__name__", ""))]
        if chosen:
            candidates = chosen  # the name of one of a union's types
        elif not candidates or isinstance(part, int) or _could_be_a_name(part, candidates):
            place.append(part)
            candidates = []
    return tuple(place), candidates


def _could_be_a_name(part: object, candidates: Sequence[object]) -> bool:
    return any(_is_model(c) for c in candidates) and "[" not in str(part)
