"""The pages of the HTTP API: one a tag, from docs/openapi.json: operations, then the fields of what they take and give."""

from __future__ import annotations

import json
from typing import Any

from server.config.reference import default_text, kind_of_value
from tests.bench.documents.openapi import DESCRIPTION
from tests.bench.documents.prose import cell, wrapped

_METHODS = ("get", "post", "put", "patch", "delete")
_TITLES = {
    "rig": "Rig and cameras",
    "stage": "Motion stage",
    "calibrations": "Calibrations",
    "noise": "Noise measurements",
    "tests": "Tests and steps",
    "analyses": "Analyses",
    "results": "Results and exports",
    "jobs": "Jobs",
    "trash": "Trash",
    "access": "Access",
    "system": "System",
}
_HEAD = """# HTTP API

All paths begin with `/api/v1`. Bodies and replies are JSON unless said otherwise; errors are `application/problem+json` with
`code`, `cause` and `remedy` ([errors](errors.md)). Units are in names (`_mm`, `_px`, `_rad`, `_s`); a value that is not known
is `null`, never zero.

- A long operation answers 202 with a `job`: poll `/jobs/{job_id}`, or follow `/jobs/{job_id}/events` (server-sent events).
- The hardware is exclusive: a second client gets 409 with the holder. `POST /stage:stop` works always.
- `Idempotency-Key` on a request that makes something: sent again after a lost reply, the request has one effect.
- `ETag` and `If-Match` on what is read and changed; lists come in pages (`limit`, `cursor`, `next_cursor`).
- `Authorization: Bearer KEY` where keys are asked for ([keys and roles](../how_to/operate.md#keys-and-roles)).

The running service shows the same with examples under `/docs`, and as `GET /api/v1/openapi.json`. Version of the description:
{version}. These pages are written by `make reference`.
"""


class _Pages:
    def __init__(self, description: dict[str, Any]) -> None:
        self.description = description
        self.models: dict[str, dict[str, Any]] = description["components"]["schemas"]
        self.tags: dict[str, list[tuple[str, str, dict[str, Any]]]] = {}
        for path, methods in description["paths"].items():
            for method, operation in methods.items():
                if method in _METHODS:
                    self.tags.setdefault(operation["tags"][0], []).append((method, path, operation))
        #: the page that describes a model: that of the first tag that uses it
        self.home: dict[str, str] = {}
        for tag, operations in self.tags.items():
            for _, _, operation in operations:
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

    def link(self, schema: dict[str, Any], tag: str) -> str:
        """Return a schema in words, with links to the models in it."""
        text = kind_of_value(schema, self.models) if schema else "any"
        named = [n for n in _references(schema) if n in self.home]
        for name in named:  # the words have "table" for each model, in the same order
            text = text.replace("table", self._to(name, tag), 1)
        return cell(f"by name: {text}" if named and "additionalProperties" in json.dumps(schema) else text)

    def _to(self, name: str, tag: str) -> str:
        return f"[{name}]({'' if self.home[name] == tag else self.home[name] + '.md'}#{name.lower()})"

    def _content(self, content: dict[str, Any], tag: str) -> str:
        if not content:
            return ""
        kind, inner = next(iter(content.items()))
        names = _references(inner.get("schema", {}))
        if kind == "application/json" and names:
            return ", ".join(self._to(n, tag) for n in names if n in self.home)
        return f"`{kind}`" if len(content) == 1 else ", ".join(f"`{k}`" for k in content)

    def operation(self, method: str, path: str, operation: dict[str, Any], tag: str) -> str:
        """Return an operation's row."""
        body = self._content(operation.get("requestBody", {}).get("content", {}), tag)
        replies = [
            f"{code} {self._content(answer.get('content', {}), tag)}".strip()
            for code, answer in operation["responses"].items()
            if code.startswith("2")
        ]
        query = [f"`{p['name']}`" for p in operation.get("parameters", ()) if p["in"] == "query"]
        asked = "; ".join(filter(None, [body, f"query: {', '.join(query)}" if query else ""]))
        shown = path.removeprefix("/api/v1")
        return f"| {method.upper()} `{shown}` | {cell(operation['summary'])} | {asked} | {'; '.join(replies)} |"

    def model(self, name: str, tag: str) -> list[str]:
        """Return a model's heading and table of fields."""
        model = self.models[name]
        lines = [f"### {name}", ""]
        if text := model.get("description", "").strip():
            lines += [wrapped(_plain(text)), ""]
        if "enum" in model:
            return [*lines, ", ".join(f"`{value}`" for value in model["enum"]), ""]
        required = set(model.get("required", ()))
        lines += ["| field | value | default | meaning |", "| --- | --- | --- | --- |"]
        for key, field in model.get("properties", {}).items():
            default = "" if key in required or "default" not in field else default_text(field["default"])
            lines.append(
                f"| `{key}` | {self.link(field, tag)} | {default} | {cell(_plain(field.get('description', '')))} |"
            )
        return [*lines, ""]

    def parameters(self, tag: str) -> list[str]:
        """Return the table of a tag's query parameters, each once."""
        rows: dict[tuple[str, str, str, str], list[str]] = {}
        for _, path, operation in self.tags[tag]:
            for parameter in operation.get("parameters", ()):
                schema = parameter["schema"]
                text = parameter.get("description") or schema.get("description", "")
                default = default_text(schema["default"]) if schema.get("default") is not None else ""
                if parameter["in"] == "query":
                    row = (parameter["name"], kind_of_value(schema, self.models), default, text)
                    rows.setdefault(row, []).append(path.rsplit("/", 1)[-1])
        if not rows:
            return []
        head = ["## Query parameters", "", "| parameter | of | value | default | meaning |", f"|{' --- |' * 5}"]
        for (name, value, default, text), paths in rows.items():
            of = ", ".join(f"`{path}`" for path in dict.fromkeys(paths))
            head.append(f"| `{name}` | {of} | {cell(value)} | {default} | {cell(_plain(text))} |")
        return [*head, ""]

    def page(self, tag: str) -> str:
        """Return a tag's page."""
        lines = [f"# {_TITLES.get(tag, tag.capitalize())}", ""]
        lines += ["| operation | purpose | body, query | reply |", "| --- | --- | --- | --- |"]
        lines += [self.operation(*operation, tag) for operation in self.tags[tag]]
        lines += ["", *self.parameters(tag), "## Fields", ""]
        for name in sorted(n for n, home in self.home.items() if home == tag):
            lines += self.model(name, tag)
        return "\n".join(lines).rstrip() + "\n"


def _references(part: Any) -> list[str]:
    if isinstance(part, dict):
        own = [str(part["$ref"]).rsplit("/", 1)[-1]] if "$ref" in part else []
        return own + [
            name for key, value in part.items() if key not in ("example", "examples") for name in _references(value)
        ]
    if isinstance(part, list):
        return [name for value in part for name in _references(value)]
    return []


def _plain(text: str) -> str:
    """Take the marks of other languages out of a description."""
    return text.replace("``", "`").replace("<", "&lt;")


def pages() -> dict[str, str]:
    """Return the pages by their paths below docs/reference."""
    made = _Pages(json.loads(DESCRIPTION.read_text(encoding="utf-8")))
    tags = sorted(made.tags, key=lambda tag: (list(_TITLES).index(tag) if tag in _TITLES else len(_TITLES), tag))
    head = _HEAD.replace("{version}", made.description["info"]["version"])
    rows = ["| pages | operations |", "| --- | --- |"]
    rows += [f"| [{_TITLES.get(tag, tag.capitalize())}](api/{tag}.md) | {len(made.tags[tag])} |" for tag in tags]
    tree = ["```{toctree}", ":hidden:", "", *(f"api/{tag}" for tag in tags), "```"]
    return {"api.md": "\n".join([head, *rows, "", *tree]) + "\n", **{f"api/{tag}.md": made.page(tag) for tag in tags}}
