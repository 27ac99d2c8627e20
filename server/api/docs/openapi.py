"""The description of the API (OpenAPI 3.1), as a product: its text is checked in and tested."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypedDict

from fastapi.routing import APIRoute
from pydantic.json_schema import JsonSchemaValue

from stereorig.server.api.protocol import problems

#: Version of the API, and of the program (pyproject.toml): one number. While it begins with 0, the second number grows
#: with each change that breaks clients; additions that clients may ignore are free until the next release
#: (docs/explanation/decisions/0019-api-description.md).
API_VERSION = "0.3.0"

_BODY_METHODS = ("post", "put", "patch")
_BOUNDS = {"ge": "minimum", "le": "maximum", "gt": "exclusiveMinimum", "lt": "exclusiveMaximum"}
_ETAG = {"description": "Names this state of it, for If-None-Match and If-Match.", "schema": {"type": "string"}}
_TAGS = {
    "system": "Health, figures, events.",
    "access": "Authentication: keys and the page's cookie.",
    "rig": "Cameras, live views, devices, the simulated scene.",
    "stage": "Positions of the axes, moves, homing, stop.",
    "noise": "The cameras' noise, measured.",
    "calibrations": "Calibrations: made on the rig, or imported.",
    "live": "Measurement while a test runs: newest values, streams, channels.",
    "tests": "Tests and their load steps.",
    "analyses": "Shape and displacement, computed over a test's steps.",
    "certificates": "Verification certificates of the measuring system.",
    "results": "Fields, points, gauges and files of an analysis.",
    "trash": "Deleting, restoring, deletion by age.",
    "jobs": "Anything that takes longer than a request.",
    "previews": "Previews: 8-bit pictures, and maps over an image; nothing is measured in them.",
}

#: requests and event streams as examples, kept by hand; examples of other answers come from the fields of their models
EXAMPLES = Path(__file__).with_name("examples.json")
_BYTES = {"type": "string", "format": "binary"}

_JOB = {"job_id": "$response.body#/job/id"}
#: fields of an answer that fill parameters of another operation's path
_LINKS = {
    "create_test": {"test_id": "$response.body#/id"},
    "list_tests": {"test_id": "$response.body#/tests/0/id"},
    "create_step": {"test_id": "$request.path.test_id", "n": "$response.body#/n"},
    "import_images": {"test_id": "$request.path.test_id", "n": "$response.body#/n"},
    "create_analysis": {"test_id": "$request.path.test_id", "analysis_id": "$response.body#/analysis_id", **_JOB},
    "list_analyses": {"test_id": "$request.path.test_id", "analysis_id": "$response.body#/analyses/0/id"},
    "create_calibration": {"calibration_id": "$response.body#/calibration_id", **_JOB},
    "import_calibration": {"calibration_id": "$response.body#/id"},
    "repair_calibration": {"calibration_id": "$response.body#/calibration_id", **_JOB},
    "list_calibrations": {"calibration_id": "$response.body#/calibrations/0/id"},
    "create_noise": {"noise_id": "$response.body#/noise_id", **_JOB},
    "list_noise": {"noise_id": "$response.body#/noise/0/id"},
    "list_jobs": {"job_id": "$response.body#/jobs/0/id"},
    "move": _JOB,
    "home": _JOB,
    "reconnect": _JOB,
    "leave_configuration": _JOB,
}


#: a part of an OpenAPI document, in the form that the specification gives it
Part = dict[str, Any]


class Examples(TypedDict, total=False):
    """Requests of an operation by media type and summary, and its answers by status and media type."""

    requests: dict[str, dict[str, object]]
    replies: dict[str, dict[str, object]]


def operation_id(route: APIRoute) -> str:
    """Return the id of an operation: the name of its function, so that generated clients read well."""
    return route.name


def _without_titles(node: Any) -> Any:
    """Drop the titles that pydantic makes of names; they say nothing and differ from version to version."""
    if isinstance(node, list):
        return [_without_titles(item) for item in node]
    if not isinstance(node, dict):
        return node
    if node.get("type") in ("integer", "number"):
        # next to a validator pydantic writes bounds by its own names, which JSON Schema lacks
        node = {_BOUNDS.get(name, name): value for name, value in node.items()}
    return {
        name: value if name in ("example", "examples", "default") else _without_titles(value)
        for name, value in node.items()
        if not (name == "title" and isinstance(value, str) and "version" not in node)
    }


def describe(schema: Part) -> Part:
    """Complete FastAPI's description: problems in place of its own errors, the middleware's answers, keys, tags.

    Parameters
    ----------
    schema
        FastAPI's description of the routes.
    """
    schema = dict(_without_titles(schema))
    components = schema.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    schemas["Problem"] = _without_titles(problems.Problem.model_json_schema())
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    components["securitySchemes"] = {
        "key": {"type": "http", "scheme": "bearer", "description": "A key made by `stereorig keys add`."},
        "cookie": {"type": "apiKey", "in": "cookie", "name": "stereorig_session", "description": "See POST /session."},
    }
    # {}: without a key, on loopback if the rig file requires none
    schema["security"] = [{}, {"key": []}, {"cookie": []}]
    used = set()
    examples = json.loads(EXAMPLES.read_text(encoding="utf-8"))
    for path in schema["paths"].values():
        for method, operation in path.items():
            used |= set(operation.get("tags", ()))
            _complete(method, operation)
            _exemplify(operation, examples.get(operation["operationId"], {}))
    for name, form in schemas.items():
        if name.startswith("Body_"):  # forms, in which null cannot be sent either
            form["properties"] = {field: _sendable(value) for field, value in form["properties"].items()}
    _link(schema)
    schema["tags"] = [{"name": name, "description": text} for name, text in _TAGS.items() if name in used]
    schema["info"]["license"] = {"name": "BSD-3-Clause", "identifier": "BSD-3-Clause"}
    schema["servers"] = [{"url": "/", "description": "The service that this description came from."}]
    return schema


def _link(schema: Part) -> None:
    """Say where the ids that an answer holds can be used."""
    operations = {o["operationId"]: o for path in schema["paths"].values() for o in path.values()}
    for source, known in _LINKS.items():
        if source not in operations:
            continue
        own = {p["name"] for p in operations[source].get("parameters", ()) if p["in"] == "path"}
        links = {}
        for name, operation in operations.items():
            asked = {p["name"] for p in operation.get("parameters", ()) if p["in"] == "path"}
            # the ids must all be known, and one of them be new
            if asked <= set(known) and asked - own:
                links[name] = {"operationId": name, "parameters": {p: known[p] for p in sorted(asked)}}
        status = min(status for status in operations[source]["responses"] if status.startswith("2"))
        operations[source]["responses"][status]["links"] = links


def _sendable(schema: JsonSchemaValue) -> JsonSchemaValue:
    """Return a parameter's schema without null, which cannot be sent in a path, query or header."""
    forms = [form for form in schema.get("anyOf", ()) if form != {"type": "null"}]
    if len(forms) != 1:
        return schema
    rest = {name: value for name, value in schema.items() if name != "anyOf"}
    return {**forms[0], **rest}


def _exemplify(operation: Part, examples: Examples) -> None:
    """Add the recorded requests and answers; declare other media types as text or bytes."""
    for media, values in examples.get("requests", {}).items():
        shown = {f"{k}": {"summary": text, "value": value} for k, (text, value) in enumerate(values.items(), 1)}
        operation["requestBody"]["content"][media]["examples"] = shown
    for status, response in operation["responses"].items():
        if not status.startswith("2"):
            continue
        for media, content in response.get("content", {}).items():
            # of a stream of events each reader makes objects of its own: its example shows the contents
            if media not in ("application/json", "text/event-stream") and not content.get("schema"):
                text = media.startswith("text/") or media.endswith("xml")
                content["schema"] = {"type": "string"} if text else dict(_BYTES)
            found = examples.get("replies", {}).get(status, {})
            if media in found:
                content.pop("examples", None)
                content["example"] = found[media]


def _complete(method: str, operation: Part) -> None:
    responses = operation["responses"]
    for parameter in operation.get("parameters", ()):
        parameter["schema"] = _sendable(parameter["schema"])
    statuses = [401, 403, 429, 503]  # the door's, before any operation gets the request
    if "requestBody" in operation and method in _BODY_METHODS:
        statuses.append(413)
    if "422" in responses:
        statuses.append(422)
    for status in statuses:
        known = responses.get(str(status))
        if known is None or "application/json" in known.get("content", {}):
            responses[str(status)] = problems.errors(status)[status]
    if method == "get" and {"application/json", "application/x-npy"} & set(responses.get("200", {}).get("content", {})):
        responses["200"].setdefault("headers", {})["ETag"] = _ETAG
        responses.setdefault("304", {"description": "Nothing has changed: the ETag is the one in If-None-Match"})
    operation["responses"] = dict(sorted(responses.items()))
