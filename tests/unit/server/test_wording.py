"""A wrong value is named by its place and by pydantic's message, with the value that was sent."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from stereorig.server.api.models import AnalysisRequest, MoveRequest, StepRequest, TestRequest
from stereorig.server.results.gauges.request import GaugeRequest
from stereorig.server.wording import FieldProblem, problems_in

RECTANGLE = {"rectangle": [90, 80, 420, 400]}


def problems(model: type[BaseModel], body: dict[str, Any]) -> list[FieldProblem]:
    with pytest.raises(ValidationError) as refused:
        model.model_validate(body)
    return problems_in(refused.value)


@pytest.mark.parametrize(
    ("model", "body", "field"),
    [
        (MoveRequest, {"targets_mm": {"1": 2}}, "targets_mm"),
        (AnalysisRequest, {"region": {"polygon": [90, 80, 420, 400]}}, "region.polygon.0"),
        (AnalysisRequest, {"region": {"rectangle": [90, 80, 420]}}, "region.rectangle.3"),
        (AnalysisRequest, {"region": RECTANGLE, "subset_px": 999}, "subset_px"),
        (AnalysisRequest, {"region": RECTANGLE, "strain": 4}, "strain"),
        (AnalysisRequest, {}, "region"),
        (GaugeRequest, {"align": {"kind": "plane", "tilt": 1}}, "align.plane.tilt"),
        (StepRequest, {"channels": {"force_n": "12"}}, "channels.force_n"),
        (TestRequest, {"name": ""}, "name"),
    ],
)
def test_the_place_of_a_wrong_value_is_named(model: type[BaseModel], body: dict[str, Any], field: str) -> None:
    assert problems(model, body)[0].field == field


def test_values_that_disagree_have_the_models_own_text() -> None:
    (one,) = problems(AnalysisRequest, {"region": RECTANGLE, "subset_px": 32})
    assert str(one) == "subset_px must be odd, got 32."


def test_a_value_that_was_sent_is_shown_and_cut() -> None:
    (one,) = problems(AnalysisRequest, {"region": RECTANGLE, "subset_px": 999})
    assert str(one) == "subset_px: Input should be less than or equal to 401, got 999."
    (long,) = problems(AnalysisRequest, {"region": RECTANGLE, "interpolation": "x" * 30_000})
    assert len(str(long)) < 200


def test_many_wrong_values_give_a_short_list() -> None:
    found = problems(TestRequest, {"name": "x"} | {f"{n}" * 1000: 1 for n in range(1000)})
    assert len(found) == 40
    assert all(len(one.field) <= 200 for one in found)
