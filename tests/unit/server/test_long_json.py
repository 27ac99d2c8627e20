"""Long JSON documents: what the standard library reads, entry by entry."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereorig.server.base import json_values

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)
layouts = st.sampled_from([None, 1, 4])


@pytest.fixture(autouse=True)
def nothing_is_short(monkeypatch):
    monkeypatch.setattr(json_values, "_LONG", 0)


@given(values, layouts, st.sampled_from(["", " ", "\n\t"]))
def test_it_reads_what_the_standard_library_reads(value, indent, around):
    text = f"{around}{json.dumps(value, indent=indent)}{around}"
    found = json_values.loads(text)
    assert found == json.loads(text)
    assert json.dumps(found) == json.dumps(value)  # true is no 1, and the order is the file's


@given(values, st.data())
def test_it_refuses_what_the_standard_library_refuses(value, data):
    text = json.dumps({"a": value, "b": [value, 1]}, indent=1)
    at = data.draw(st.integers(0, len(text) - 1))
    changed = text[:at] + data.draw(st.sampled_from(["", ",", "}", "]", '"', "x"])) + text[at + 1 :]
    try:
        expected = json.loads(changed)
    except ValueError:
        with pytest.raises(json.JSONDecodeError):
            json_values.loads(changed)
    else:
        assert json_values.loads(changed) == expected


def test_of_a_list_only_what_is_wanted_is_kept():
    text = json.dumps({"steps": [{"n": 1, "file": "a"}, {"n": 2}], "more": [{"n": 3}], "of": {"steps": [{"n": 4}]}})
    found = json_values.loads(text, {"steps": lambda one: one["n"]})
    assert found == {"steps": [1, 2], "more": [{"n": 3}], "of": {"steps": [{"n": 4}]}}


def test_entries_of_which_nothing_is_kept_are_left_out():
    text = json.dumps({"steps": [5, 6, 7], "more": [8]})
    assert json_values.loads(text, {"steps": json_values.the_first(2)}) == {"steps": [5, 6], "more": [8]}
    assert json_values.loads(text, {"steps": json_values.nothing}) == {"steps": [], "more": [8]}
    assert json_values.loads(text, {"steps": lambda n: n if n > 6 else None}) == {"steps": [7], "more": [8]}


@pytest.mark.parametrize("other", [None, 3, {"n": 1}])
def test_what_is_no_list_stays_as_it_is(other):
    assert json_values.loads(json.dumps({"steps": other}), {"steps": json_values.nothing}) == {"steps": other}
