"""The description of the API: complete, and never changed against clients without a version step."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.support.api_changes import breaking_changes
from tests.support.api_description import RELEASED, current, missing_step, reduced, step_is_enough, text_of

Json = dict[str, Any]


@pytest.fixture(scope="module")
def described() -> Json:
    return current()


def operations(description: Json) -> Iterator[tuple[str, Json]]:
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            yield f"{method.upper()} {path}", operation


def test_what_breaks_clients_of_the_last_release_has_a_version_step(described: Json) -> None:
    released = json.loads(RELEASED.read_text(encoding="utf-8"))
    broken = missing_step(released, described)
    assert not broken, f"take it back, or step API_VERSION in server/api/docs/openapi.py: {broken}"


def test_a_step_is_the_second_number_before_1_0_and_the_first_one_after() -> None:
    assert not step_is_enough("0.1.0", "0.1.9")
    assert step_is_enough("0.1.0", "0.2.0")
    assert step_is_enough("0.9.0", "1.0.0")
    assert not step_is_enough("1.2.0", "1.10.0")
    assert step_is_enough("1.2.0", "2.0.0")


def test_a_breaking_change_without_a_step_is_told(described: Json) -> None:
    changed = copy.deepcopy(described)
    del changed["paths"]["/api/v1/stage:stop"]
    assert missing_step(reduced(described), changed) == ["POST /api/v1/stage:stop is gone"]
    changed["info"]["version"] = "99.0.0"
    assert missing_step(reduced(described), changed) == []


def test_the_released_description_has_a_line_an_operation_and_a_line_a_schema(described: Json) -> None:
    text = RELEASED.read_text(encoding="utf-8")
    assert text_of(json.loads(text)) == text
    small = reduced(described)
    assert json.loads(text_of(small)) == small
    assert breaking_changes(small, described) == breaking_changes(described, small) == []


# what breaks a client, and what does not -------------------------------------------------------------------------

SMALL: Json = {
    "info": {"version": "1.0.0"},
    "paths": {
        "/things": {
            "post": {
                "parameters": [{"in": "query", "name": "n", "schema": {"type": "integer", "minimum": 0, "maximum": 9}}],
                "requestBody": {"content": {"application/json": {"schema": {"$ref": "#/components/schemas/Sent"}}}},
                "responses": {
                    "201": {"content": {"application/json": {"schema": {"$ref": "#/components/schemas/Thing"}}}},
                    "409": {"content": {}},
                },
            }
        }
    },
    "components": {
        "schemas": {
            "Sent": {
                "type": "object",
                "additionalProperties": False,
                "properties": {
                    "name": {"type": "string", "maxLength": 10},
                    "kind": {"enum": ["a", "b"], "type": "string"},
                    "size": {"anyOf": [{"type": "number"}, {"type": "null"}]},
                },
                "required": ["name"],
            },
            "Thing": {
                "type": "object",
                "properties": {
                    "id": {"type": "string"},
                    "state": {"enum": ["new", "old"], "type": "string"},
                    "next": {"anyOf": [{"$ref": "#/components/schemas/Thing"}, {"type": "null"}]},
                    "sizes": {"type": "array", "items": {"type": "integer"}},
                },
                "required": ["id", "state"],
            },
        }
    },
}


def sent(d: Json) -> Json:
    return d["components"]["schemas"]["Sent"]["properties"]


def thing(d: Json) -> Json:
    return d["components"]["schemas"]["Thing"]["properties"]


def post(d: Json) -> Json:
    return d["paths"]["/things"]["post"]


def schema(d: Json, name: str) -> Json:
    return d["components"]["schemas"][name]


BREAKING: dict[str, Callable[[Json], Any]] = {
    "path gone": lambda d: d["paths"].clear(),
    "method gone": lambda d: d["paths"]["/things"].clear(),
    "parameter gone": lambda d: post(d)["parameters"].clear(),
    "parameter required": lambda d: post(d)["parameters"][0].update(required=True),
    "parameter narrower": lambda d: post(d)["parameters"][0]["schema"].update(maximum=5),
    "bound added": lambda d: post(d)["parameters"][0]["schema"].update(exclusiveMinimum=0),
    "new required parameter": lambda d: post(d)["parameters"].append(
        {"in": "header", "name": "If-Match", "required": True, "schema": {"type": "string"}}
    ),
    "body required": lambda d: post(d)["requestBody"].update(required=True),
    "body gone": lambda d: post(d).pop("requestBody"),
    "form of body gone": lambda d: post(d)["requestBody"]["content"].clear(),
    "answer gone": lambda d: post(d)["responses"].pop("201"),
    "form of answer gone": lambda d: post(d)["responses"]["201"]["content"].clear(),
    "field no longer taken": lambda d: sent(d).pop("kind"),
    "field required": lambda d: schema(d, "Sent")["required"].append("kind"),
    "shorter text": lambda d: sent(d)["name"].update(maxLength=9),
    "pattern": lambda d: sent(d)["name"].update(pattern="^x"),
    "other type": lambda d: sent(d)["name"].update(type="integer"),
    "value no longer taken": lambda d: sent(d)["kind"].update(enum=["a"]),
    "null no longer taken": lambda d: sent(d).update(size={"type": "number"}),
    "whole numbers only": lambda d: sent(d).update(size={"anyOf": [{"type": "integer"}, {"type": "null"}]}),
    "answer without a field": lambda d: thing(d).pop("sizes"),
    "answer may lack a field": lambda d: schema(d, "Thing")["required"].remove("state"),
    "answer of another type": lambda d: thing(d)["id"].update(type="integer"),
    "further value answered": lambda d: thing(d)["state"]["enum"].append("older"),
    "any value answered": lambda d: thing(d)["state"].pop("enum"),
    "null answered": lambda d: thing(d).update(id={"anyOf": [{"type": "string"}, {"type": "null"}]}),
    "items of another type": lambda d: thing(d)["sizes"].update(items={"type": "number"}),
}
HARMLESS: dict[str, Callable[[Json], Any]] = {
    "nothing": lambda d: None,
    "words": lambda d: post(d).update(summary="Make a thing", description="Words."),
    "path": lambda d: d["paths"].update({"/more": {"get": {"responses": {"200": {}}}}}),
    "optional parameter": lambda d: post(d)["parameters"].append(
        {"in": "query", "name": "m", "schema": {"type": "string"}}
    ),
    "optional field": lambda d: sent(d).update(more={"type": "string"}),
    "longer text": lambda d: sent(d)["name"].update(maxLength=11),
    "any length": lambda d: sent(d)["name"].pop("maxLength"),
    "further value taken": lambda d: sent(d)["kind"]["enum"].append("c"),
    "text taken too": lambda d: sent(d)["size"]["anyOf"].append({"type": "string"}),
    "field need not be sent": lambda d: schema(d, "Sent")["required"].clear(),
    "further field answered": lambda d: thing(d).update(more={"type": "string"}),
    "field is always answered": lambda d: schema(d, "Thing")["required"].append("sizes"),
    "value no longer answered": lambda d: thing(d)["state"]["enum"].remove("old"),
    "null no longer answered": lambda d: thing(d).update(next={"$ref": "#/components/schemas/Thing"}),
    "further problem": lambda d: post(d)["responses"].update({"412": {"content": {}}}),
    "further form of answer": lambda d: post(d)["responses"]["201"]["content"].update({"text/csv": {}}),
    "wider parameter": lambda d: post(d)["parameters"][0]["schema"].update(minimum=-1, maximum=10),
}


@pytest.mark.parametrize("what", BREAKING)
def test_what_breaks_clients_is_seen(what: str) -> None:
    changed = copy.deepcopy(SMALL)
    BREAKING[what](changed)
    assert breaking_changes(reduced(SMALL), changed)
    assert breaking_changes(SMALL, reduced(changed))


@pytest.mark.parametrize("what", HARMLESS)
def test_what_clients_need_not_heed_is_free(what: str) -> None:
    changed = copy.deepcopy(SMALL)
    HARMLESS[what](changed)
    assert breaking_changes(reduced(SMALL), changed) == []
    assert breaking_changes(SMALL, reduced(changed)) == []


# completeness ----------------------------------------------------------------------------------------------------


def test_every_operation_says_what_it_is(described: Json) -> None:
    ids = [operation["operationId"] for _, operation in operations(described)]
    assert len(set(ids)) == len(ids), sorted(ids)
    tags = {tag["name"] for tag in described["tags"]}
    for where, operation in operations(described):
        assert re.fullmatch(r"[a-z][a-z_]+", operation["operationId"]), where
        assert operation["summary"], where
        assert operation["description"], where
        assert set(operation["tags"]) <= tags, where
        assert any(status.startswith("2") for status in operation["responses"]), where
        assert {"401", "403", "429", "503"} <= set(operation["responses"]), where
        for parameter in operation.get("parameters", ()):
            assert parameter.get("description"), (where, parameter["name"])
