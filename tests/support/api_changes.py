"""Reports what of a change of an OpenAPI description breaks clients that were written against the older one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_METHODS = ("get", "put", "post", "delete", "patch", "head", "options")
# constraint: +1 where a greater value admits less, -1 where a smaller one does
BOUNDS = {
    "minimum": 1,
    "exclusiveMinimum": 1,
    "minLength": 1,
    "minItems": 1,
    "minProperties": 1,
    "maximum": -1,
    "exclusiveMaximum": -1,
    "maxLength": -1,
    "maxItems": -1,
    "maxProperties": -1,
}


def breaking_changes(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return each change that breaks a client, in words; empty when clients need not notice.

    What a client may send must not become less, and what it is sent must not become something else. Further
    operations, optional parameters, fields of answers and statuses of errors break nobody.
    """
    return list(_Comparison(old, new).changes())


class _Comparison:
    def __init__(self, old: dict[str, Any], new: dict[str, Any]) -> None:
        self._old, self._new = old, new

    def changes(self) -> Iterator[str]:
        for path, operations in self._old["paths"].items():
            for method, operation in operations.items():
                if method not in _METHODS:
                    continue
                location = f"{method.upper()} {path}"
                now = self._new["paths"].get(path, {}).get(method)
                if now is None:
                    yield f"{location} is gone"
                    continue
                yield from self._parameters(location, operation, now)
                yield from self._body(location, operation.get("requestBody"), now.get("requestBody"))
                yield from self._answers(location, operation["responses"], now["responses"])

    def _parameters(self, location: str, old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
        before = {(p["in"], p["name"]): p for p in old.get("parameters", ())}
        after = {(p["in"], p["name"]): p for p in new.get("parameters", ())}
        for key, parameter in before.items():
            where = f"{location}: {key[0]} parameter {key[1]}"
            if key not in after:
                yield f"{where} is gone"
                continue
            if after[key].get("required") and not parameter.get("required"):
                yield f"{where} is required now"
            yield from self._schema(where, parameter.get("schema", {}), after[key].get("schema", {}), sent=True)
        for key in after.keys() - before.keys():
            if after[key].get("required"):
                yield f"{location}: {key[0]} parameter {key[1]} is new and required"

    def _body(self, location: str, old: dict[str, Any] | None, new: dict[str, Any] | None) -> Iterator[str]:
        if old is None:
            if new is not None and new.get("required"):
                yield f"{location}: a body is required now"
            return
        if new is None:
            yield f"{location}: the body is gone"
            return
        if new.get("required") and not old.get("required"):
            yield f"{location}: the body is required now"
        yield from self._contents(f"{location}: body", old.get("content", {}), new.get("content", {}), sent=True)

    def _answers(self, location: str, old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
        for status, answer in old.items():
            if not status.startswith("2"):
                continue
            if status not in new:
                yield f"{location}: the answer {status} is gone"
                continue
            where = f"{location}: answer {status}"
            yield from self._contents(where, answer.get("content", {}), new[status].get("content", {}), sent=False)

    def _contents(self, location: str, old: dict[str, Any], new: dict[str, Any], *, sent: bool) -> Iterator[str]:
        for form, content in old.items():
            if form not in new:
                yield f"{location} is no longer {form}"
                continue
            before, after = content.get("schema", {}), new[form].get("schema", {})
            yield from self._schema(location, before, after, sent=sent)

    def _schema(
        self, location: str, old: Any, new: Any, *, sent: bool, seen: frozenset[tuple[str, str]] = frozenset()
    ) -> Iterator[str]:
        pair = (str(old.get("$ref")), str(new.get("$ref")))
        if "$ref" in old and "$ref" in new:
            if pair in seen:
                return
            seen = seen | {pair}
        choices, others = _choices(self._old, old), _choices(self._new, new)
        if len(choices) > 1 or len(others) > 1:
            yield from self._alternatives(location, choices, others, sent=sent, seen=seen)
            return
        old, new = _resolved(self._old, old), _resolved(self._new, new)
        yield from _kinds(location, old, new, sent=sent)
        if sent:
            yield from _narrowed(location, old, new)
        yield from self._fields(location, old, new, sent=sent, seen=seen)
        if isinstance(old.get("items"), dict) and isinstance(new.get("items"), dict):
            yield from self._schema(f"{location}[]", old["items"], new["items"], sent=sent, seen=seen)

    def _alternatives(
        self, location: str, old: list[Any], new: list[Any], *, sent: bool, seen: frozenset[tuple[str, str]]
    ) -> Iterator[str]:
        # each old form must still be taken; each form that is answered must be one of the old
        givers, takers = (old, new) if sent else (new, old)
        for giver in givers:
            pairs = [(giver, taker) if sent else (taker, giver) for taker in takers]
            if any(not list(self._schema(location, a, b, sent=sent, seen=seen)) for a, b in pairs):
                continue
            same = [(a, b) for a, b in pairs if _kind(_resolved(self._old, a)) == _kind(_resolved(self._new, b))]
            if len(same) == 1:
                yield from self._schema(location, *same[0], sent=sent, seen=seen)
            else:
                word = "is no longer taken" if sent else "is answered now"
                yield f"{location}: the form {_kind(_resolved(self._old if sent else self._new, giver))} {word}"

    def _fields(
        self, location: str, old: Any, new: Any, *, sent: bool, seen: frozenset[tuple[str, str]]
    ) -> Iterator[str]:
        before, after = old.get("properties", {}), new.get("properties", {})
        for name in before:
            if name in after:
                yield from self._schema(f"{location}.{name}", before[name], after[name], sent=sent, seen=seen)
            elif not sent or new.get("additionalProperties") is False:
                yield f"{location}.{name} is gone"
        if sent:
            for name in sorted(set(new.get("required", ())) - set(old.get("required", ()))):
                yield f"{location}.{name} is required now"
        else:
            for name in sorted(set(old.get("required", ())) - set(new.get("required", ()))):
                if name in after:
                    yield f"{location}.{name} may be missing now"


def _resolved(document: dict[str, Any], schema: Any) -> dict[str, Any]:
    while "$ref" in schema:
        found: Any = document
        for part in schema["$ref"].removeprefix("#/").split("/"):
            found = found[part]
        schema = found
    return dict(schema)


def _choices(document: dict[str, Any], schema: dict[str, Any]) -> list[Any]:
    resolved = _resolved(document, schema)
    # a form keeps its reference, by which a form that holds itself is known again
    return list(resolved.get("anyOf") or resolved.get("oneOf") or [schema])


def _kind(schema: dict[str, Any]) -> str:
    return str(schema.get("const", schema.get("type", "anything")))


def _kinds(location: str, old: dict[str, Any], new: dict[str, Any], *, sent: bool) -> Iterator[str]:
    before, after = old.get("type"), new.get("type")
    if before != after:
        wider = after is None or (before == "integer" and after == "number")
        narrower = before is None or (before == "number" and after == "integer")
        if not (wider if sent else narrower):
            yield f"{location}: {before or 'anything'} became {after or 'anything'}"
    first, then = _values(old), _values(new)
    if sent and then is not None:
        lost = [] if first is None else [v for v in first if v not in then]
        if first is None:
            yield f"{location} is one of {then} now"
        elif lost:
            yield f"{location}: {lost} is no longer taken"
    if not sent and first is not None:
        more = None if then is None else [v for v in then if v not in first]
        if more is None or more:
            yield f"{location}: {more or 'anything'} may be answered now"


def _values(schema: dict[str, Any]) -> list[Any] | None:
    if "const" in schema:
        return [schema["const"]]
    values = schema.get("enum")
    return None if values is None else list(values)


def _narrowed(location: str, old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    for name, sign in BOUNDS.items():
        before, after = old.get(name), new.get(name)
        if after is not None and (before is None or sign * (after - before) > 0):
            yield f"{location}: {name} is {after} now, was {before}"
    if new.get("pattern") is not None and new["pattern"] != old.get("pattern"):
        yield f"{location}: has the pattern {new['pattern']} now"
    if new.get("additionalProperties") is False and old.get("additionalProperties") is not False:
        yield f"{location}: unknown fields are refused now"
