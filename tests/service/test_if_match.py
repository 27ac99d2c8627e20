"""A change that was meant for another state is refused: of an axis, a camera, a calibration's review, a watch."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from tests.support.service_rig import TINY, new_test, true_cameras

API = "/api/v1"


def plain(answer: httpx.Response) -> str:
    """The ETag, as it is where nothing is compressed."""
    return answer.headers["ETag"].replace("-gzip", "")


def axis(client: httpx.Client) -> tuple[str, str, str, list[dict[str, Any]]]:
    return f"{API}/stage/axes/1", "PATCH", f"{API}/stage/axes/1", [{"velocity_mm_s": 3.0}, {"velocity_mm_s": 4.0}]


def camera(client: httpx.Client) -> tuple[str, str, str, list[dict[str, Any]]]:
    return f"{API}/cameras/cam2", "PATCH", f"{API}/cameras/cam2", [{"exposure_ms": 8.0}, {"exposure_ms": 9.0}]


def review(client: httpx.Client) -> tuple[str, str, str, list[dict[str, Any]]]:
    file = json.dumps(true_cameras(TINY)).encode()
    made = client.post(f"{API}/calibrations:import", files={"file": ("calibration.json", file)}).json()["id"]
    bodies = [{"decision": "accepted", "note": "mine"}, {"decision": "discarded", "note": "yours"}]
    return f"{API}/calibrations/{made}", "PUT", f"{API}/calibrations/{made}/review", bodies


def watch(client: httpx.Client) -> tuple[str, str, str, list[dict[str, Any]]]:
    url = f"{API}/tests/{new_test(client)}/watch"
    client.put(url, json={"channel": "load_n", "threshold": 1.0}).raise_for_status()
    return url, "PUT", url, [{"channel": "load_n", "threshold": 2.0}, {"channel": "load_n", "threshold": 3.0}]


@pytest.mark.parametrize("thing", [axis, camera, review, watch])
def test_the_second_of_two_changes_is_refused(
    client: httpx.Client, thing: Callable[[httpx.Client], tuple[str, str, str, list[dict[str, Any]]]]
) -> None:
    read, method, change, (mine, yours) = thing(client)

    def send(body: dict[str, Any], tag: str | None) -> httpx.Response:
        return client.request(method, change, json=body, headers={} if tag is None else {"If-Match": tag})

    seen = client.get(read).headers["ETag"]
    assert client.get(read, headers={"If-None-Match": seen}).status_code == 304
    first = send(mine, seen)
    assert first.status_code == 200, first.text
    after = client.get(read)
    # the answer's tag is the one that the next change needs
    assert plain(first) == plain(after) != seen.replace("-gzip", "")
    refused = send(yours, seen)
    assert refused.status_code == 412, refused.text
    assert refused.json()["code"] == "precondition_failed"
    assert refused.json()["etag"] == plain(after)
    assert client.get(read).json() == after.json(), "a refused change changed something"
    assert send(yours, f'W/"other", {after.headers["ETag"]}').status_code == 200
    assert send(mine, "*").status_code == 200
    assert send(yours, None).status_code == 200  # who names no state means any


def test_any_state_is_not_none(client: httpx.Client) -> None:
    """`*` asks for something that is there."""
    url = f"{API}/tests/{new_test(client)}/watch"
    refused = client.put(url, json={"channel": "load_n", "threshold": 1.0}, headers={"If-Match": "*"})
    assert refused.status_code == 412, refused.text
    assert client.get(url).status_code == 404


def test_an_axis_that_is_none_has_no_velocity(client: httpx.Client) -> None:
    answer = client.get(f"{API}/stage/axes/7")
    assert answer.status_code == 422
    assert answer.json()["code"] == "invalid_axis"
