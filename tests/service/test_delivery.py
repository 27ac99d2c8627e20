"""How answers travel: entity tags, 304, If-Match, HEAD, gzip, pages, the forms of a field."""

from __future__ import annotations

import io
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import netCDF4
import numpy as np
import pytest
from PIL import Image

from stereorig.server.api.docs.pages import known_problems
from stereorig.server.results.field_forms import Part, encode, nested, take
from stereorig.server.results.reader import FileVariable
from stereorig.server.workflows.service import Service
from tests.support.service_rig import new_test

API = "/api/v1"


def refused(answer: httpx.Response, status: int, code: str) -> None:
    assert answer.status_code == status, answer.text
    assert answer.json()["code"] == code
    assert status in known_problems()[code]["status"]


# entity tags ------------------------------------------------------------------------------------------------------


def test_what_has_not_changed_is_not_sent_again(client: httpx.Client) -> None:
    url = f"{API}/tests/{new_test(client)}"
    first = client.get(url)
    tag = first.headers["etag"]
    same = client.get(url, headers={"If-None-Match": tag})
    assert (same.status_code, same.content) == (304, b"")
    assert same.headers["etag"] == tag
    assert "content-length" not in same.headers
    assert client.get(url, headers={"If-None-Match": f'"other", W/{tag}'}).status_code == 304
    assert client.get(url, headers={"If-None-Match": '"other"'}).status_code == 200
    client.post(f"{url}/steps", json={}).raise_for_status()
    changed = client.get(url, headers={"If-None-Match": tag})
    assert changed.status_code == 200
    assert changed.headers["etag"] != tag
    # an unforeseen error has one too
    listed = client.get(f"{API}/calibrations")
    assert client.get(f"{API}/calibrations", headers={"If-None-Match": listed.headers["etag"]}).status_code == 304


def test_a_change_says_which_state_it_is_meant_for(client: httpx.Client) -> None:
    url = f"{API}/tests/{new_test(client)}"
    refused(client.patch(url, json={"notes": "a"}), 428, "precondition_required")
    tag = client.get(url).headers["etag"]
    one = client.patch(url, json={"notes": "a"}, headers={"If-Match": tag})
    assert one.json()["notes"] == "a"
    two = client.patch(url, json={"notes": "b"}, headers={"If-Match": tag})
    refused(two, 412, "precondition_failed")
    assert client.get(url).json()["notes"] == "a"
    assert two.json()["etag"] == one.headers["etag"] == client.get(url).headers["etag"]
    assert client.patch(url, json={"notes": "b"}, headers={"If-Match": "*"}).json()["notes"] == "b"
    refused(client.patch(f"{API}/tests/t999999-abcdef", json={}), 404, "not_found")


def test_of_two_changes_at_once_one_is_refused(client: httpx.Client) -> None:
    url = f"{API}/tests/{new_test(client)}"
    tag = client.get(url).headers["etag"]
    answers: list[int] = []

    def change(text: str) -> None:
        answers.append(client.patch(url, json={"notes": text}, headers={"If-Match": tag}).status_code)

    threads = [threading.Thread(target=change, args=(f"note {k}",)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [200, 412, 412, 412, 412, 412]


def test_a_steps_label_can_be_corrected_and_nothing_else(client: httpx.Client, service: Service) -> None:
    test_id = new_test(client)
    step = client.post(f"{API}/tests/{test_id}/steps", json={"label": "5 kN", "load_n": 5000.0}).json()
    url = f"{API}/tests/{test_id}/steps/0"
    before = client.get(url)
    refused(client.patch(url, json={"label": "6 kN"}), 428, "precondition_required")
    refused(client.patch(url, json={"label": "x", "load_n": 1.0}, headers={"If-Match": "*"}), 422, "invalid_request")
    changed = client.patch(url, json={"label": "6 kN"}, headers={"If-Match": before.headers["etag"]})
    assert changed.json() == {**step, "label": "6 kN"}
    assert client.get(url).json() == changed.json()
    assert client.get(f"{API}/tests/{test_id}/steps").json()["steps"][0]["label"] == "6 kN"
    refused(
        client.patch(url, json={"label": "7"}, headers={"If-Match": before.headers["etag"]}), 412, "precondition_failed"
    )
    assert service.tests.steps.verified(test_id, 0).document.label == "6 kN"
    refused(client.patch(f"{url}1", json={"label": "7"}, headers={"If-Match": "*"}), 404, "not_found")


def test_camera_settings_that_others_changed_are_not_overwritten(client: httpx.Client) -> None:
    url = f"{API}/cameras/cam1"
    tag = client.get(url).headers["etag"]
    assert client.patch(url, json={"exposure_ms": 9.0}, headers={"If-Match": tag}).status_code == 200
    refused(client.patch(url, json={"exposure_ms": 8.0}, headers={"If-Match": tag}), 412, "precondition_failed")
    assert client.get(url).json()["settings"]["exposure_ms"] == 9.0
    assert client.patch(url, json={"exposure_ms": 10.0}).status_code == 200


# HEAD and gzip ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["/rig", "/openapi.json", "/cameras/cam1/frame", "/healthz"])
def test_head_tells_what_get_would(client: httpx.Client, path: str) -> None:
    head = client.head(f"{API}{path}")
    assert head.status_code == 200
    assert head.content == b""
    assert head.headers["content-type"] == client.get(f"{API}{path}").headers["content-type"]
    assert int(head.headers["content-length"]) > 0


@pytest.mark.parametrize("path", ["/events", "/cameras/cam1/stream.mjpg"])
def test_head_of_a_stream_ends_at_once(client: httpx.Client, path: str) -> None:
    head = client.head(f"{API}{path}", timeout=20.0)
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-type"].startswith(("text/event-stream", "multipart/"))


def test_head_is_refused_as_get_is(client: httpx.Client) -> None:
    assert client.head(f"{API}/jobs/j999999-abcdef").status_code == 404
    answer = client.head(f"{API}/stage/moves")
    assert answer.status_code == 405
    assert answer.headers["allow"] == "POST"
    assert client.post(f"{API}/rig").headers["allow"] == "GET, HEAD"


def test_answers_are_compressed_for_those_who_want_it(client: httpx.Client) -> None:
    url = f"{API}/openapi.json"
    packed = client.get(url, headers={"Accept-Encoding": "gzip"})
    plain = client.get(url, headers={"Accept-Encoding": "identity"})
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.json() == plain.json()
    assert int(packed.headers["content-length"]) < 0.3 * int(plain.headers["content-length"])
    assert "content-encoding" not in plain.headers
    assert "Accept-Encoding" in packed.headers["vary"]
    assert "Accept-Encoding" in plain.headers["vary"]
    # the tag of the compressed form is another one, and is understood
    assert packed.headers["etag"] != plain.headers["etag"]
    again = client.get(url, headers={"Accept-Encoding": "gzip", "If-None-Match": packed.headers["etag"]})
    assert again.status_code == 304
    script = client.get("/static/vendor/swagger-ui/swagger-ui-bundle.js", headers={"Accept-Encoding": "gzip"})
    assert script.headers["content-encoding"] == "gzip"
    assert len(script.content) > 10**6
    # pictures are compressed already
    frame = client.get(f"{API}/cameras/cam1/frame", headers={"Accept-Encoding": "gzip"})
    assert "content-encoding" not in frame.headers


def test_a_tag_of_a_compressed_answer_serves_for_a_change(client: httpx.Client) -> None:
    url = f"{API}/tests/{new_test(client, notes='long ' * 1000)}"
    read = client.get(url, headers={"Accept-Encoding": "gzip"})
    assert read.headers["content-encoding"] == "gzip"
    changed = client.patch(url, json={"notes": "short"}, headers={"If-Match": read.headers["etag"]})
    assert changed.status_code == 200, changed.text


# pages ------------------------------------------------------------------------------------------------------------


def pages(client: httpx.Client, url: str, name: str, limit: int) -> Iterator[list[dict[str, object]]]:
    cursor = None
    while True:
        answer = client.get(url, params={"limit": limit} | ({} if cursor is None else {"cursor": cursor}))
        assert answer.status_code == 200, answer.text
        body = answer.json()
        yield body[name]
        cursor = body["next_cursor"]
        if cursor is None:
            assert "link" not in answer.headers
            return
        assert 'rel="next"' in answer.headers["link"]
        # the link leads to the same page as the cursor
        link = answer.headers["link"].partition("<")[2].partition(">")[0]
        assert client.get(link).json()[name] == client.get(url, params={"limit": limit, "cursor": cursor}).json()[name]


def test_pages_hold_everything_once_whatever_is_made_and_deleted_meanwhile(client: httpx.Client) -> None:
    made = [new_test(client, name=f"test {k}") for k in range(7)]
    seen: list[object] = []
    for k, page in enumerate(pages(client, f"{API}/tests", "tests", 3)):
        assert len(page) <= 3
        seen += [t["id"] for t in page]
        if k == 0:
            new_test(client, name="made meanwhile")
            client.delete(f"{API}/tests/{seen[0]}").raise_for_status()
            client.delete(f"{API}/tests/{seen[-1]}").raise_for_status()
    assert len(set(seen)) == len(seen)
    assert set(made) <= set(seen)
    assert seen == sorted(seen)  # type: ignore[type-var]


def test_jobs_come_newest_first_page_by_page(client: httpx.Client) -> None:
    for _ in range(5):
        job = client.post(f"{API}/stage:home").json()["job"]
        while client.get(f"{API}/jobs/{job['id']}").json()["state"] not in ("succeeded", "failed"):
            pass
    whole = [job["id"] for job in client.get(f"{API}/jobs", params={"limit": 1000}).json()["jobs"]]
    paged = [job["id"] for page in pages(client, f"{API}/jobs", "jobs", 2) for job in page]
    assert paged == whole == sorted(whole, reverse=True)


def test_steps_come_page_by_page(client: httpx.Client) -> None:
    test_id = new_test(client)
    for _ in range(3):
        client.post(f"{API}/tests/{test_id}/steps", json={}).raise_for_status()
    found = list(pages(client, f"{API}/tests/{test_id}/steps", "steps", 2))
    assert [[s["n"] for s in page] for page in found] == [[0, 1], [2]]


@pytest.mark.fault(48)
@pytest.mark.parametrize("cursor", ["%%%", "a", "é", "_-_-", "A" * 200, "-1"])
def test_an_invented_cursor_is_refused_or_leads_to_a_page(client: httpx.Client, cursor: str) -> None:
    answer = client.get(f"{API}/tests", params={"cursor": cursor})
    if answer.status_code != 200:
        refused(answer, 422, "cursor_invalid")
    refused(client.get(f"{API}/tests", params={"cursor": "A" * 201}), 422, "invalid_request")
    refused(client.get(f"{API}/tests", params={"limit": 0}), 422, "invalid_request")
    refused(client.get(f"{API}/tests", params={"limit": 1001}), 422, "invalid_request")


# forms of a field -------------------------------------------------------------------------------------------------

GRID = (7, 9)


def field(shape: tuple[int, ...] = GRID, kind: str = "f8", name: str = "w_mm") -> dict[str, FileVariable]:
    rng = np.random.default_rng(4)
    values = rng.normal(0.01, 0.002, shape).astype(kind) if kind.startswith("f") else rng.integers(0, 9, shape, kind)
    if kind.startswith("f"):
        values[2, 4] = np.nan
    y, x = np.mgrid[100:170:10, 50:140:10].astype(float)
    grid = ("row", "col", "component", "component_of")
    return {
        name: FileVariable(values, "mm", "displacement", grid[: values.ndim]),
        "x_px": FileVariable(x, "pixel", "", grid[:2]),
        "y_px": FileVariable(y, "pixel", "", grid[:2]),
    }


def test_ranges_and_strides_take_what_numpy_takes() -> None:
    held = field()
    w, x = held["w_mm"], held["x_px"]
    for rows, cols, stride in ((None, None, 1), ("1:5", ":3", 1), ("2:", "4:8", 2), ("0:100", None, 3)):
        part = take("w_mm", held.__getitem__, Part(rows, cols, stride))
        index = tuple(
            slice(*(int(v) if v else None for v in (text or ":").split(":")), stride) for text in (rows, cols)
        )
        np.testing.assert_array_equal(part.values, w.values[index])
        np.testing.assert_array_equal(part.position("x_px"), x.values[index])
        np.testing.assert_array_equal(part.rows, np.arange(GRID[0])[index[0]])


@pytest.mark.parametrize("rows", ["5:5", "6:2", "7:9", "100:", "0:0"])
def test_a_range_that_holds_nothing_is_refused(rows: str) -> None:
    from stereorig.core.errors import InputError

    with pytest.raises(InputError, match="range_empty"):
        take("w_mm", field().__getitem__, Part(rows, None, 1))


def test_every_form_holds_the_same_numbers() -> None:
    held = field()
    w = held["w_mm"]
    part = take("w_mm", held.__getitem__, Part("1:6", "2:9", 2))
    expected = w.values[1:6:2, 2:9:2]
    np.testing.assert_array_equal(np.load(io.BytesIO(encode(part, "npy"))), expected)
    shape = tuple(int(n) for n in part.headers["X-Shape"].split(","))
    raw = np.frombuffer(encode(part, "f32"), "<f4").reshape(shape)
    np.testing.assert_array_equal(raw, expected.astype(np.float32))
    assert part.headers["X-Rows"] == "1:6:2"
    assert part.headers["X-Units"] == "mm"
    lines = encode(part, "csv").decode().splitlines()
    assert lines[0] == "row,col,x_px,y_px,w_mm"
    assert len(lines) == 1 + expected.size
    for line in lines[1:]:
        row, col, x_px, y_px, value = line.split(",")
        assert (float(x_px), float(y_px)) == (50 + 10 * int(col), 100 + 10 * int(row))
        true = w.values[int(row), int(col)]
        assert float(value) == true if value else np.isnan(true)
    with netCDF4.Dataset("f.nc", memory=encode(part, "nc")) as data:
        np.testing.assert_array_equal(np.ma.filled(data["w_mm"][:], np.nan), expected)
        np.testing.assert_array_equal(data["row"][:], [1, 3, 5])
        assert data["w_mm"].units == "mm"
    listed = np.array(nested(part.values), dtype=float)
    np.testing.assert_array_equal(listed, expected)


def test_fields_of_states_and_of_several_numbers_have_their_forms() -> None:
    status = take("status", field(kind="i1", name="status").__getitem__, Part())
    assert encode(status, "csv").decode().splitlines()[1].split(",")[4] == str(int(status.values[0, 0]))
    assert np.load(io.BytesIO(encode(status, "npy"))).dtype == np.int8
    with netCDF4.Dataset("f.nc", memory=encode(status, "nc")) as data:
        np.testing.assert_array_equal(data["status"][:], status.values)
    covariance = take("covariance", field((*GRID, 3, 3), name="covariance").__getitem__, Part(stride=4))
    assert encode(covariance, "csv").decode().splitlines()[0].endswith("covariance_8")
    with netCDF4.Dataset("f.nc", memory=encode(covariance, "nc")) as data:
        assert data["covariance"].shape == covariance.values.shape


@pytest.mark.parametrize("kind", ["varied", "constant", "empty"])
def test_the_picture_has_map_and_colour_bar(kind: str) -> None:
    held = field()
    w = held["w_mm"]
    if kind != "varied":
        w.values[:] = 0.5 if kind == "constant" else np.nan
    part = take("w_mm", held.__getitem__, Part())
    picture = np.asarray(Image.open(io.BytesIO(encode(part, "png"))).convert("RGB")).astype(int)
    assert picture.shape[1] > picture.shape[0]
    colourful = picture.max(-1) - picture.min(-1) > 40
    # the bar goes from one end of the scale to the other, beside the map
    bar = np.flatnonzero(colourful.mean(0) > 0.5)[-1]
    column = picture[:, bar][colourful[:, bar]]
    assert len(np.unique(column, axis=0)) > 50
    assert column[0, 1] > column[-1, 1], "bright is large, and above"
    dark_text = (picture.max(-1) < 120) & ~colourful
    assert dark_text[:, bar + 8 :].any(), "the bar has its numbers"


def test_what_is_not_over_the_grid_is_refused() -> None:
    from stereorig.core.errors import InputError

    with pytest.raises(InputError, match="field_not_scalar"):
        take("volume", lambda _: FileVariable(np.zeros((3, 2)), "mm", "", ("step", "gauge")), Part())


def test_json_is_strict(tmp_path: Path) -> None:
    part = take("w_mm", field().__getitem__, Part())
    assert "NaN" not in json.dumps(nested(part.values))


def test_a_path_has_its_own_methods_only(client: httpx.Client) -> None:
    path = f"{API}/tests/t000001-abcdef"
    for method, url, allowed in (
        ("DELETE", f"{path}/analyses/a000001-abcdef:continue", "POST"),
        ("GET", f"{path}/steps/1/texture", "POST"),
        ("PUT", f"{path}/analyses/a000001-abcdef", "DELETE, GET, HEAD"),
        ("POST", f"{path}/steps/1/cam1", "GET, HEAD"),
    ):
        answer = client.request(method, url)
        assert (answer.status_code, answer.headers["allow"]) == (405, allowed), url


def test_a_stream_begins_before_anything_happens(client: httpx.Client) -> None:
    began = time.monotonic()
    with client.stream("GET", f"{API}/events") as answer:
        assert answer.status_code == 200
    assert time.monotonic() - began < 10.0  # the first sign of life may come long after
