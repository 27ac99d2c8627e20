"""Bodies: none holds the event loop, whatever it contains, and none is taken for a thing that is not there."""

from __future__ import annotations

import asyncio
import gc
import json
import random
import re
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import httpx
import pytest

from stereorig.server.api.app import create_app
from stereorig.server.api.protocol import bodies
from stereorig.server.http.access import KeyFile
from stereorig.server.workflows.service import Service
from tests.support.api_description import current
from tests.support.requirements import ROOT
from tests.support.service_rig import new_test, served, tiny_config

API = "/api/v1"
#: of the event loop's processor time, which no load of the machine adds to
MOST_S = 0.050
JSON = "application/json"


@pytest.fixture(scope="module")
def described() -> dict[str, Any]:
    return current()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(tiny_config(), tmp_path_factory.mktemp("bodies") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx.Client]:
    with served(service) as made:
        yield made


def content_of(described: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in described["paths"].items():
        for method, operation in methods.items():
            if "requestBody" in operation:
                yield method.upper(), path, operation


def named(described: dict[str, Any], schema: Any, seen: frozenset[str] = frozenset()) -> set[str]:
    """Return every property's name in a schema."""
    if isinstance(schema, list):
        return set().union(*(named(described, item, seen) for item in schema))
    if not isinstance(schema, dict):
        return set()
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[1]
        return set() if name in seen else named(described, described["components"]["schemas"][name], seen | {name})
    own = set(schema.get("properties", {}))
    return own.union(*(named(described, value, seen) for key, value in schema.items() if key != "examples"))


def test_the_limits_are_those_of_what_each_operation_takes(described: dict[str, Any]) -> None:
    for method, path, operation in content_of(described):
        content = operation["requestBody"]["content"]
        limit = bodies.limit_of(re.sub(r"\{[a-z_]+\}", "x1", path))
        if path.endswith(("/steps:import", "/models", "/calibrations:upload")):
            assert limit == 2**30
        elif JSON not in content or "mask_png_base64" in named(described, content[JSON]["schema"]):
            assert limit == 32 * 2**20, (method, path)
        else:
            assert limit == 2**20, (method, path)


def head(port: int, target: str, *headers: str) -> str:
    """Send a request's head without its body, and return the head of the answer."""
    with socket.create_connection(("127.0.0.1", port), timeout=30.0) as link:
        lines = [f"POST {API}{target} HTTP/1.1", f"Host: 127.0.0.1:{port}", *headers, "", ""]
        link.sendall("\r\n".join(lines).encode())
        answer = b""
        while b"\r\n\r\n" not in answer and (part := link.recv(4096)):
            answer += part
    return answer.decode("latin-1").lower()


FORM = "Content-Type: multipart/form-data; boundary=x"
HUGE, CHUNKED = f"Content-Length: {600 * 2**20}", "Transfer-Encoding: chunked"


@pytest.mark.parametrize("length", [HUGE, CHUNKED])
def test_what_is_for_nothing_is_refused_before_its_body_comes(client: httpx.Client, length: str) -> None:
    port, test = int(client.base_url.port or 0), new_test(client)
    for target in ("tests/t000099-abcdef/steps:import", "tests/t000099-abcdef/models", f"tests/{'../x' * 9}/models"):
        answer = head(port, f"/{target}", length, FORM)
        assert answer.startswith("http/1.1 404"), target
        assert "connection: close" in answer
    chunked = (CHUNKED, "Content-Type: application/json")
    for target in (
        "tests/t000099-abcdef/analyses",
        f"tests/{test}/analyses/a000099-abcdef/gauges",
        f"tests/{test}/steps/7/texture",
        "calibrations/c000099-abcdef:repair",
        "certificates/v000099-abcdef:withdraw",
    ):
        assert head(port, f"/{target}", *chunked).startswith("http/1.1 404"), target


def test_a_caller_without_the_right_is_refused_before_the_body_comes(service: Service, client: httpx.Client) -> None:
    key = KeyFile(service.folder.root).add("looks", "viewer")
    port, test = int(client.base_url.port or 0), new_test(client)
    for right, status in ((key, 403), ("x", 401)):
        answer = head(port, f"/tests/{test}/models", HUGE, FORM, f"Authorization: Bearer {right}")
        assert answer.startswith(f"http/1.1 {status}")


def test_json_has_a_mebibyte_and_a_mask_its_own_limit(client: httpx.Client) -> None:
    test = new_test(client)
    long = json.dumps({"name": "x", "notes": "y" * 2**20}).encode()
    for sent in (long, iter([long[:1000], long[1000:]])):
        answer = client.post(f"{API}/tests", content=sent, headers={"Content-Type": JSON})
        assert (answer.status_code, answer.json()["code"]) == (413, "body_too_large")
    masked = client.post(f"{API}/tests/{test}/analyses", json={"region": {"mask_png_base64": "A" * 2**21}})
    assert masked.status_code in (409, 422), masked.text


def test_readings_of_eight_channels_come_five_thousand_at_a_time(client: httpx.Client) -> None:
    path = f"{API}/tests/{new_test(client)}/live/channels"
    channels = {f"force_{n}_n": 812.5 for n in range(8)}
    answer = client.post(path, json={"readings": [{"time_s": 1.5 * n, "channels": channels} for n in range(5000)]})
    assert answer.status_code in (404, 409), answer.text
    wide = {"readings": [{"time_s": 1.0, "channels": {"f_n": 1.0}}] * 20 + [{f"x{n}": 1 for n in range(20_000)}]}
    assert client.post(path, json=wide).json()["code"] == "too_many_values"


@pytest.mark.fault(48)
def test_of_many_wrong_values_the_first_twenty_are_named(client: httpx.Client) -> None:
    answer = client.post(f"{API}/tests", json={"name": "x"} | {f"nmae{n}": 1 for n in range(9000)})
    assert answer.status_code == 422
    assert len(answer.json()["fields"]) == 20
    assert "of the first 20 of 9000 values that are wrong" in answer.json()["detail"]
    assert answer.json()["detail"].startswith("nmae0: Extra inputs are not permitted.")
    many = client.post(f"{API}/tests", json={"name": "x", "tags": [0] * 100_000})
    assert (many.status_code, many.json()["code"]) == (422, "too_many_values")


@dataclass
class Answer:
    """An answer, and the processor time that the event loop took for it."""

    status: int
    loop_s: float


class Asked:
    """Asks the app on an event loop of the test's own, where its time can be taken."""

    def __init__(self, app: Any) -> None:
        self._app = app

    async def ask(self, method: str, path: str, body: bytes) -> Answer:
        """Send a body of JSON."""
        parts = [body[at : at + 65536] for at in range(0, len(body), 65536)] or [b""]
        waiting = [{"type": "http.request", "body": part, "more_body": True} for part in parts]
        waiting[-1]["more_body"] = False
        status = 0

        async def receive() -> Any:
            return waiting.pop(0) if waiting else await asyncio.Event().wait()

        async def send(message: Any) -> None:
            nonlocal status
            status = message.get("status", status)

        headers = {b"host": b"127.0.0.1", b"content-type": JSON.encode(), b"content-length": str(len(body)).encode()}
        scope = {
            "type": "http",
            "asgi": {"version": "3.0", "spec_version": "2.3"},
            "http_version": "1.1",
            "method": method,
            "scheme": "http",
            "path": path,
            "raw_path": path.encode(),
            "query_string": b"",
            "root_path": "",
            "headers": list(headers.items()),
            "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 80),
            "state": {},
        }
        began = time.thread_time()
        await self._app(scope, receive, send)
        return Answer(status, time.thread_time() - began)


@pytest.mark.fault(48)
@pytest.mark.fault(53)
@pytest.mark.parametrize("number", [150, pytest.param(3000, marks=pytest.mark.deep)])
def test_no_body_holds_the_event_loop(service: Service, client: httpx.Client, described: Any, number: int) -> None:
    examples = json.loads((ROOT / "server/api/docs/examples.json").read_text(encoding="utf-8"))
    test, rng = new_test(client), random.Random(number)
    operations = [
        (method, path, list(examples[operation["operationId"]]["requests"][JSON].values()))
        for method, path, operation in content_of(described)
        if JSON in operation["requestBody"]["content"] and not re.search("stage|guide|sim/scene", path)
    ]
    asked = Asked(create_app(service, close_service=False))

    async def scenario() -> None:
        gc.collect()
        gc.freeze()  # as a service does once it serves: a round over every module is no part of a body's cost
        for _ in range(number):
            method, template, right = rng.choice(operations)
            size = rng.choice([2_000, 30_000, 200_000, 2**20 - 4_000])
            form, body = hostile_body(rng, rng.choice(right), size)
            path = template.replace("{test_id}", test).replace("{cam}", "cam1").replace("{n}", "0")
            path = re.sub(r"\{[a-z_]+\}", "x000001-abcdef", path)
            answer = await asked.ask(method, path, body)
            assert answer.status < 500, (method, path, form)
            tries = 1
            while answer.loop_s > MOST_S and tries < 5:  # a round of the collector, a module that is loaded
                answer, tries = await asked.ask(method, path, body), tries + 1
            assert answer.loop_s <= MOST_S, (method, path, form, len(body), answer)

    try:
        asyncio.run(scenario())
    finally:
        gc.unfreeze()


# Bodies of JSON that cost a careless service dear: deep, wide, long, odd; plain, or inside a body that is right.

MIB = 2**20
Text = Callable[[random.Random, int], str]


def _names(rng: random.Random, size: int) -> str:
    word = rng.choice(["x", "nam", "width_mm", "\\u00e9"])
    return "{" + ",".join(f'"{word}{n}":{n}' for n in range(size // (len(word) + 14))) + "}"


def _nested(rng: random.Random, size: int) -> str:
    opening, closing = rng.choice([("[", "]"), ('{"a":', "}"), ('[{"region":', "}]")])
    depth = min(size // (len(opening) + len(closing)), rng.choice([90, 240, 900, 40_000, MIB]))
    return opening * depth + rng.choice(["1", "null", '"x"']) + closing * depth


def _list_of(*items: str) -> Text:
    def made(rng: random.Random, size: int) -> str:
        item = rng.choice(items)
        return "[" + ",".join([item] * max(1, size // (len(item) + 1))) + "]"

    return made


def _string(rng: random.Random, size: int) -> str:
    unit = rng.choice(["a", " ", "1", "[", "\\ud800", "\\u0000", "\\udc00\\ud800", "é", "\\\\", "a b-", ":,{["])
    return '"' + unit * (size // len(unit.encode())) + '"'


def _long_name(rng: random.Random, size: int) -> str:
    return "{" + _string(rng, size - 8) + ":1}"


def _number(rng: random.Random, size: int) -> str:
    digits = rng.choice([4000, 4301, 100_000, size])
    one = rng.choice(["9" * digits, "0." + "1" * digits, "1e" + "9" * min(digits, 4000), "-" + "1" * digits + ".5e-7"])
    return "[" + ",".join([one] * max(1, size // (len(one) + 1))) + "]" if rng.random() < 0.7 else one[:size]


def _alike(rng: random.Random, size: int) -> str:
    name = rng.choice(["name", "region", "steps", "label"])
    return "{" + ",".join([f'"{name}":{rng.choice(["1", "[]", "{}"])}'] * (size // (len(name) + 6))) + "}"


def _objects(rng: random.Random, size: int) -> str:
    return _list_of('{"a":1,"b":2}', '{"name":"x","name":"y"}', '{"kind":"point","x_px":1e308}', "{}")(rng, size)


FORMS: dict[str, Text] = {
    "names": _names,
    "nested": _nested,
    "numbers": _list_of("0", "1.5", "-1e308", "NaN", "123456789012345678901234567890"),
    "pairs": _list_of("[1,2]", "[0.25,0.5]", "[[1,2],[3,4]]", "[null]"),
    "words": _list_of('"a"', "true", "null", '"\\ud800"'),
    "string": _string,
    "long name": _long_name,
    "long number": _number,
    "alike": _alike,
    "objects": _objects,
}


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, inner in items:
        yield from _places(inner, (*path, name))


def _put(value: Any, path: tuple[Any, ...], mark: str) -> Any:
    if not path:
        return mark
    copied = dict(value) if isinstance(value, dict) else list(value)
    copied[path[0]] = _put(copied[path[0]], path[1:], mark)
    return copied


def hostile_body(rng: random.Random, right: Any, size: int) -> tuple[str, bytes]:
    """Return a form's name and a body of some size, in half of the cases with the form in place of a right value."""
    form = rng.choice(list(FORMS))
    text = FORMS[form](rng, size)
    choice = rng.random()
    if choice < 0.5 or right is None:
        return form, text.encode()
    if choice < 0.7 and isinstance(right, dict) and text.startswith("{"):  # beside the right names
        return f"{form}, more", (json.dumps(right)[:-1] + "," + text[1:]).encode()
    path = rng.choice(list(_places(right)))
    return f"{form} at {'.'.join(map(str, path))}", json.dumps(_put(right, path, "@@")).replace('"@@"', text).encode()
