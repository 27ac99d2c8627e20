"""How a result shows itself, and what it says of a name that it does not have."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest

from stereorig.core.errors import InputError
from stereorig.core.gauge.reading import Reading
from stereorig.core.settings import AnalysisSettings
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.result import Result
from tests.support.strain_fields import make_field, plane


@pytest.fixture(scope="module")
def result() -> Result:
    field = make_field(plane, lambda points: 1.001 * points, shape=(12, 15))
    field.status[0, 0] = 1
    settings = AnalysisSettings.model_validate({"region": {"rectangle": [0, 0, 200, 200]}})
    return Result(field, surface_strain(field, StrainOptions(window=5), subset_px=33), settings, 3)


def test_a_result_is_shown_in_one_line(result: Result) -> None:
    assert repr(result) == (
        "<Result of step 3: displacement with strain over 5 points, 179 of 180 points valid, frame: target>"
    )


def test_a_notebook_shows_a_map_with_its_uncertainty(result: Result) -> None:
    shown = result._repr_html_()
    assert "median standard uncertainty of w_mm 0.3 um" in shown  # as `make_field` makes it
    found = re.search(r"base64,([^\"]+)", shown)
    assert found is not None
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 420
    assert picture.std() > 10.0


def test_a_wrong_name_lists_the_right_ones(result: Result) -> None:
    with pytest.raises(InputError) as caught:
        result["w_m"]
    assert caught.value.code == "field_missing"
    assert caught.value.remedy.startswith("Perhaps w_mm is meant; there are e1, ")
    for name in ("sigma_exx", "exx", "z_mm"):
        assert result[name].shape == (12, 15)
        assert f" {name}," in caught.value.remedy


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (0.000849123, 9.2e-6, "0.0008491 +- 0.0000092"),
        (12.3456, 0.5, "12.35 +- 0.50"),
        (1234.5, 30.0, "1234 +- 30"),
        (float("nan"), float("nan"), "nan +- nan"),
        (1.0, 0.0, "1 +- 0"),
    ],
)
def test_a_reading_is_rounded_by_its_uncertainty(value: float, sigma: float, shown: str) -> None:
    assert repr(Reading(value, sigma)) == f"Reading({shown})"
