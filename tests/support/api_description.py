"""The description of the API (OpenAPI): that of the code, for the page's checker, and that of the last release.

``docs/openapi_released.json`` has as much of a description as a comparison needs: paths, parameters, types; no text. A
change that breaks clients needs a step of ``API_VERSION`` (server/api/docs/openapi.py).

::

    python -m tests.support.api_description              # writes build/openapi.json
    python -m tests.support.api_description --release    # at a release: writes docs/openapi_released.json
"""

from __future__ import annotations

import json
import sys
from typing import Any

from stereorig.server.api.app import bare_app
from tests.support.api_changes import BOUNDS, breaking_changes
from tests.support.requirements import ROOT

BUILT = ROOT / "build" / "openapi.json"
RELEASED = ROOT / "docs" / "openapi_released.json"
_KEPT = {"$ref", "type", "const", "enum", "pattern", "required", *BOUNDS}


def current() -> dict[str, Any]:
    """Return the description of the code as it is."""
    return bare_app().openapi()


def reduced(description: dict[str, Any]) -> dict[str, Any]:
    """Return the part of a description by which changes that break clients are seen."""
    paths = {
        path: {method: _operation(operation) for method, operation in sorted(methods.items())}
        for path, methods in sorted(description["paths"].items())
    }
    schemas = {name: _schema(schema) for name, schema in sorted(description["components"]["schemas"].items())}
    version = description["info"]["version"]
    return {"info": {"version": version}, "paths": paths, "components": {"schemas": schemas}}


def _operation(operation: dict[str, Any]) -> dict[str, Any]:
    kept: dict[str, Any] = {
        "responses": {s: _contents(r) for s, r in operation["responses"].items() if s.startswith("2")}
    }
    if parameters := operation.get("parameters"):
        kept["parameters"] = [
            {**{key: p[key] for key in ("in", "name", "required") if key in p}, "schema": _schema(p["schema"])}
            for p in parameters
        ]
    if body := operation.get("requestBody"):
        kept["requestBody"] = {"required": body.get("required", False), **_contents(body)}
    return kept


def _contents(part: dict[str, Any]) -> dict[str, Any]:
    return {"content": {m: {"schema": _schema(c.get("schema", {}))} for m, c in part.get("content", {}).items()}}


def _schema(schema: dict[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in schema.items() if key in _KEPT}
    if schema.get("additionalProperties") is False:
        kept["additionalProperties"] = False
    for key in ("anyOf", "oneOf"):
        if key in schema:
            kept[key] = [_schema(form) for form in schema[key]]
    if isinstance(schema.get("items"), dict):
        kept["items"] = _schema(schema["items"])
    if "properties" in schema:
        kept["properties"] = {name: _schema(field) for name, field in schema["properties"].items()}
    return kept


def text_of(released: dict[str, Any]) -> str:
    """Return a reduced description as JSON: a line an operation, a line a schema."""

    def lines(members: dict[str, Any]) -> str:
        return ",\n".join(f"{json.dumps(name)}: {json.dumps(value, sort_keys=True)}" for name, value in members.items())

    paths = ",\n".join(f"{json.dumps(path)}: {{\n{lines(methods)}}}" for path, methods in released["paths"].items())
    schemas = lines(released["components"]["schemas"])
    info = json.dumps(released["info"])
    return f'{{"info": {info},\n"paths": {{\n{paths}}},\n"components": {{"schemas": {{\n{schemas}}}}}}}\n'


def step_is_enough(released: str, now: str) -> bool:
    """Whether a version is far enough from the released one for a change that breaks clients.

    A new first number; while that is 0, a new second one.
    """
    before, after = ([int(part) for part in version.split(".")] for version in (released, now))
    if before[0] == 0:
        return after[:2] > before[:2]
    return after[0] > before[0]


def missing_step(released: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Return the changes that break clients while the version is not stepped for them; empty when all is well."""
    if step_is_enough(released["info"]["version"], now["info"]["version"]):
        return []
    return breaking_changes(released, now)


def main(arguments: list[str]) -> None:
    """Write one of the files."""
    if "--release" in arguments:
        RELEASED.write_text(text_of(reduced(current())), encoding="utf-8")
    else:
        BUILT.parent.mkdir(exist_ok=True)
        BUILT.write_text(json.dumps(current(), indent=1, sort_keys=True, ensure_ascii=False), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
