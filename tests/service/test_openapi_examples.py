"""The examples in the API's description are true: a small simulated rig accepts each request and answers like that."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest

from stereorig.server.api.docs.openapi import EXAMPLES
from stereorig.server.config.rig_file import parse_config
from stereorig.server.http.access import KeyFile
from stereorig.server.workflows.service import Service
from tests.support.api_description import current
from tests.support.api_scenario import FILE, Session, operations_of, run
from tests.support.requirements import ROOT
from tests.support.service_rig import SMALL, served

Json = dict[str, Any]
COMMAND = "bring server/api/docs/examples.json and tests/support/api_scenario.py together"


@pytest.fixture(scope="module")
def described() -> Json:
    return current()


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory, described: Json) -> Iterator[Session]:
    """Every operation called once."""
    service = Service(parse_config(SMALL), tmp_path_factory.mktemp("examples") / "data").start()
    try:
        with served(service) as client:
            yield run(client, described, KeyFile(service.folder.root).add("lab-page", "admin"))
    finally:
        service.close()


def schema_of(described: Json, schema: Json) -> Json:
    return {**schema, "components": described["components"], "$schema": "https://json-schema.org/draft/2020-12/schema"}


def successes(operation: Json) -> Iterator[tuple[str, str, Json]]:
    """Status, media type and content of each successful answer."""
    for status, response in operation["responses"].items():
        if status.startswith("2"):
            for media, content in response.get("content", {}).items():
                yield status, media, content


def untyped(described: Json, schema: Json) -> bool:
    """Return True if a schema states of an object no more than that it is one."""
    if "$ref" in schema:
        return untyped(described, described["components"]["schemas"][schema["$ref"].rsplit("/", 1)[1]])
    return not schema or (schema.get("type") == "object" and not schema.get("properties"))


def missing(described: Json) -> list[str]:
    """What a reader of the description would miss: a line each."""
    found = []
    for name, operation in operations_of(described).items():
        if not operation.get("summary"):
            found.append(f"{name}: no summary")
        for media, content in operation.get("requestBody", {}).get("content", {}).items():
            if not content.get("examples"):
                found.append(f"{name}: no example of what is sent as {media}")
        for status, media, content in successes(operation):
            if media == "application/json" and untyped(described, content.get("schema", {})):
                found.append(f"{name}: {status} has no type")
            if not content.get("schema") and not (media == "text/event-stream" and content.get("example")):
                found.append(f"{name}: {status} as {media} says not even whether it is text")
        if not any(status.startswith("2") for status in operation["responses"]):
            found.append(f"{name}: no successful answer")
    return found


def test_every_operation_has_summary_examples_and_types(described: Json) -> None:
    assert missing(described) == [], COMMAND


@pytest.mark.parametrize(
    ("spoil", "fragment"),
    [
        (lambda o: o.pop("summary"), "no summary"),
        (lambda o: o["requestBody"]["content"]["application/json"].pop("examples"), "no example of what is sent"),
        (
            lambda o: o["responses"]["202"]["content"]["application/json"].update(
                schema={"type": "object", "additionalProperties": True}
            ),
            "202 has no type",
        ),
    ],
)
def test_what_is_missing_is_seen(spoil: Any, fragment: str) -> None:
    fresh = json.loads(json.dumps(current()))
    spoil(fresh["paths"]["/api/v1/stage/moves"]["post"])
    assert [line for line in missing(fresh) if fragment in line]


def test_every_example_fits_its_schema(described: Json) -> None:
    checked = 0
    for name, operation in operations_of(described).items():
        for content in operation.get("requestBody", {}).get("content", {}).values():
            for example in content.get("examples", {}).values():
                try:
                    jsonschema.validate(example["value"], schema_of(described, content["schema"]))
                except jsonschema.ValidationError as error:
                    pytest.fail(f"{name}, what is sent: {error.message} at {error.json_path}")
                checked += 1
        for status, _, content in successes(operation):
            if "example" not in content:
                continue
            try:
                jsonschema.validate(content["example"], schema_of(described, content.get("schema", {})))
            except jsonschema.ValidationError as error:
                pytest.fail(f"{name}, answer {status}: {error.message} at {error.json_path}")
            checked += 1
    assert checked > 50


def test_the_session_calls_every_operation_and_each_answer_that_has_a_body(session: Session, described: Json) -> None:
    assert set(session.replies) == set(session.operations)
    for name, operation in session.operations.items():
        for status, media, _ in successes(operation):
            if media == "application/json":
                assert media in session.replies[name].get(status, {}), (name, status, COMMAND)


def test_every_example_of_a_request_is_one_that_the_service_took(session: Session, described: Json) -> None:
    """What the session sends was accepted (it asserts so); the description shows just that."""

    def without_ids(value: Any) -> str:
        # an id in a body is another one in each session
        return re.sub(r"\b([atcnjm]\d{6})-[0-9a-f]{6}\b", r"\1", json.dumps(value, sort_keys=True))

    taken = {(sent.operation, sent.media_type, without_ids(sent.value)) for sent in session.requests}
    for name, operation in operations_of(described).items():
        for media, content in operation.get("requestBody", {}).get("content", {}).items():
            for example in content["examples"].values():
                sent = without_ids(example["value"])
                assert (name, media, sent) in taken, (name, example["summary"], COMMAND)


def test_files_in_examples_are_told_as_files(described: Json) -> None:
    form = described["paths"]["/api/v1/tests/{test_id}/steps:import"]["post"]["requestBody"]["content"]
    for example in form["multipart/form-data"]["examples"].values():
        assert example["value"]["cam1"] == example["value"]["cam2"] == FILE


def test_the_description_holds_the_file_of_examples(described: Json) -> None:
    examples = json.loads(EXAMPLES.read_text(encoding="utf-8"))
    assert set(examples) <= set(operations_of(described)), COMMAND
    wheel = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert '"api/docs/examples.json"' in wheel  # the service of an installed wheel shows them too
