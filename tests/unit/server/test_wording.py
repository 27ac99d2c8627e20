"""What is wrong with a body is told in its sender's words, with what is permitted; never in the validator's."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from server.api.models import AnalysisRequest, MoveRequest, SceneRequest, StepRequest, TestRequest
from server.results.gauges.request import GaugeRequest
from server.wording import problems_in

RECTANGLE = {"rectangle": [90, 80, 420, 400]}
#: words of the validator, of its classes and of Python
FOREIGN = (
    "input",
    "tuple",
    "extra",
    "discriminator",
    "dictionary",
    "instance",
    "function-",
    "list[",
    "valid ",
    "Model",
)


def told(model: type[BaseModel], body: dict[str, Any]) -> list[str]:
    with pytest.raises(ValidationError) as refused:
        model.model_validate(body)
    return [str(one) for one in problems_in(refused.value, model)]


@pytest.mark.parametrize(
    ("model", "body", "expected"),
    [
        (
            MoveRequest,
            {"targets_mm": {"1": 2}},
            "targets_mm: is not known here. What can be given: by_mm, dz_mm, positions_mm.",
        ),
        (
            AnalysisRequest,
            {"region": {"polygon": [90, 80, 420, 400]}},
            "region.polygon.0: must be a list of 2 numbers (and 3 more alike).",
        ),
        (
            AnalysisRequest,
            {"region": {"rectangle": [90, 80, 420]}},
            "region.rectangle: has too few entries: must be a list of 4 numbers.",
        ),
        (AnalysisRequest, {"region": RECTANGLE, "subset_px": 32}, "subset_px must be odd, got 32."),
        (AnalysisRequest, {"region": RECTANGLE, "subset_px": 999}, "subset_px: must be 401 or less, got 999."),
        (AnalysisRequest, {"region": RECTANGLE, "strain": 4}, "strain: must be an object of names and values."),
        (AnalysisRequest, {}, "region: is missing."),
        (
            GaugeRequest,
            {"align": {"x_direction": [1, 0, 0]}},
            "align: needs 'kind', which says what it is; one of 'plane', '3-2-1', 'given'.",
        ),
        (
            GaugeRequest,
            {"align": {"kind": "2-2"}},
            "align: 'kind' must be one of 'plane', '3-2-1', 'given', not '2-2'.",
        ),
        (
            GaugeRequest,
            {"align": {"kind": "plane", "tilt": 1}},
            "align.tilt: is not known here. What can be given: kind, polygon_px, rectangle_px, x_direction, x_line_px.",
        ),
        (
            SceneRequest,
            {"scene": "plate", "params": {"a": {}}},
            "params.a: must be a number or a list, each entry a number or text.",
        ),
        (
            StepRequest,
            {"timestamp_utc": "today"},
            "timestamp_utc: must be a time as in 2026-03-01T12:00:00Z, got 'today'.",
        ),
        (StepRequest, {"channels": {"force_n": "12"}}, "channels.force_n: must be a number, not text."),
        (TestRequest, {"name": ""}, "name: must have 1 or more characters."),
    ],
)
def test_a_problem_is_told_in_the_senders_words(model: type[BaseModel], body: dict[str, Any], expected: str) -> None:
    assert told(model, body) == [expected]


def test_a_name_nearly_right_is_recognised() -> None:
    (text,) = told(AnalysisRequest, {"region": RECTANGLE, "subset": 33})
    assert text.startswith("subset: is not known here; 'subset_px' is meant, perhaps.")


def test_no_word_of_the_validator_is_left_whatever_is_sent() -> None:
    wrong: list[Any] = [None, True, -1, 1e12, float("nan"), "x", "x" * 30_000, [], [1], {}, {"a": 1}, [[1, 2]], [{}]]
    for model in (AnalysisRequest, GaugeRequest, MoveRequest, SceneRequest, StepRequest, TestRequest):
        for name in model.model_fields:
            for value in wrong:
                try:
                    model.model_validate({name: value})
                except ValidationError as error:
                    for one in problems_in(error, model):
                        foreign = [word for word in FOREIGN if word in str(one) and word not in str(value)]
                        assert not foreign, (model.__name__, name, value, str(one))
