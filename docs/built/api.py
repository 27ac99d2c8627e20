"""The lists of the HTTP API: under each tag its operations, their query parameters, and the fields of models."""

from __future__ import annotations

import functools
import json
from typing import Any

from docs.built.tables import cell, table
from stereorig.server.api.app import bare_app
from stereorig.server.config.reference import default_text, kind_of_value

#: an operation with its method and path
Operation = tuple[str, str, dict[str, Any]]


def operations(tag: str) -> str:
    """Return the lists of a tag."""
    return _described().page(tag)


@functools.cache
def _described() -> _Description:
    return _Description(bare_app().openapi())


class _Description:
    def __init__(self, description: dict[str, Any]) -> None:
        self.models: dict[str, dict[str, Any]] = description["components"]["schemas"]
        self.tags: dict[str, list[Operation]] = {}
        for path, methods in sorted(description["paths"].items()):
            for method, operation in sorted(methods.items()):
                self.tags.setdefault(operation["tags"][0], []).append((method, path, operation))
        #: the page that describes a model: that of the first tag that uses it
        self.home: dict[str, str] = {}
        for tag, listed in self.tags.items():
            for _, _, operation in listed:
                for name in self._used(operation):
                    self.home.setdefault(name, tag)

    def _used(self, operation: dict[str, Any]) -> list[str]:
        """Return the models of an operation and those inside them."""
        answers = {k: v for k, v in operation["responses"].items() if k.startswith("2")}
        waiting = _references([operation.get("requestBody", {}), answers])
        found: list[str] = []
        while waiting:
            name = waiting.pop(0)
            if name not in found:
                found.append(name)
                waiting += _references(self.models[name])
        return [name for name in found if self.models[name].get("type") != "array"]

    def page(self, tag: str) -> str:
        """Return a tag's lists."""
        head = ("operation", "purpose", "body, query", "reply")
        parts = [table(head, [self._operation(*operation, tag) for operation in self.tags[tag]])]
        if rows := self._parameters(tag):
            parts += ["## Query parameters", table(("parameter", "of", "value", "default", "meaning"), rows)]
        parts.append("## Fields")
        for name in sorted(n for n, home in self.home.items() if home == tag):
            parts += self._model(name, tag)
        return "\n\n".join(parts)

    def _operation(self, method: str, path: str, operation: dict[str, Any], tag: str) -> tuple[str, str, str, str]:
        query = [f"`{p['name']}`" for p in operation.get("parameters", ()) if p["in"] == "query"]
        asked = [self._content(operation.get("requestBody", {}), tag), query and f"query: {', '.join(query)}"]
        replies = [
            f"{status} {self._content(answer, tag)}".strip()
            for status, answer in operation["responses"].items()
            if status.startswith("2")
        ]
        shown = f"{method.upper()} `{path.removeprefix('/api/v1')}`"
        return shown, cell(operation["summary"]), "; ".join(filter(None, asked)), "; ".join(replies)

    def _content(self, body: dict[str, Any], tag: str) -> str:
        content = body.get("content", {})
        names = [n for n in _references(content.get("application/json", {}).get("schema", {})) if n in self.home]
        return ", ".join([self._to(name, tag) for name in names] or [f"`{media}`" for media in content])

    def _parameters(self, tag: str) -> list[tuple[str, str, str, str, str]]:
        """Return the rows of query parameters, one for those that are alike."""
        paths: dict[tuple[str, str, str, str], list[str]] = {}
        for _, path, operation in self.tags[tag]:
            for parameter in operation.get("parameters", ()):
                schema = parameter["schema"]
                text = parameter.get("description") or schema.get("description", "")
                default = default_text(schema["default"]) if schema.get("default") is not None else ""
                if parameter["in"] == "query":
                    row = (parameter["name"], kind_of_value(schema, self.models), default, text)
                    paths.setdefault(row, []).append(f"`{path.rsplit('/', 1)[-1]}`")
        return [
            (f"`{name}`", ", ".join(dict.fromkeys(of)), cell(value), default, cell(_plain(text)))
            for (name, value, default, text), of in paths.items()
        ]

    def _model(self, name: str, tag: str) -> list[str]:
        model = self.models[name]
        parts = [f"### {name}", _plain(model.get("description", "").strip())]
        if "enum" in model:
            return [*parts, ", ".join(f"`{value}`" for value in model["enum"])]
        required, rows = set(model.get("required", ())), []
        for key, field in model.get("properties", {}).items():
            default = "" if key in required or "default" not in field else default_text(field["default"])
            rows.append((f"`{key}`", self._value(field, tag), default, cell(_plain(field.get("description", "")))))
        return [*parts, table(("field", "value", "default", "meaning"), rows)]

    def _value(self, schema: dict[str, Any], tag: str) -> str:
        """Return a schema in words, with links to the models in it."""
        text = kind_of_value(schema, self.models) if schema else "any"
        named = [n for n in _references(schema) if n in self.home]
        for name in named:  # the words have "table" for each model, in the same order
            text = text.replace("table", self._to(name, tag), 1)
        return cell(f"by name: {text}" if named and "additionalProperties" in json.dumps(schema) else text)

    def _to(self, name: str, tag: str) -> str:
        return f"[{name}]({'' if self.home[name] == tag else self.home[name] + '.md'}#{name.lower()})"


def _references(part: Any) -> list[str]:
    if isinstance(part, dict):
        own = [str(part["$ref"]).rsplit("/", 1)[-1]] if "$ref" in part else []
        others = [value for key, value in part.items() if key not in ("example", "examples")]
        return own + _references(others)
    if isinstance(part, list):
        return [name for value in part for name in _references(value)]
    return []


def _plain(text: str) -> str:
    """Take the marks of other languages out of a description."""
    return text.replace("``", "`").replace("<", "&lt;")
