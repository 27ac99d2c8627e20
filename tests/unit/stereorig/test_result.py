"""How a result shows itself, and what it says of a name that it does not have."""

from __future__ import annotations

import base64
import json
import re
import sys

import cv2
import numpy as np
import pytest

from stereorig.core.errors import InputError, StateError
from stereorig.core.gauge.reading import Reading
from stereorig.core.settings import AnalysisSettings
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.result import Result
from stereorig.server.formats.calibrations.recognise import parse_calibration
from stereorig.server.formats.figures.card import card
from tests.support.disc_images import cameras_beside
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


def test_a_plot_is_the_variable_in_the_pages_unit(result: Result) -> None:
    figure = result.plot("exx")
    bar = figure.axes[1].get_ylabel()
    assert bar.endswith("\u00b5m/m")
    (drawn,) = figure.axes[0].images
    values = np.asarray(drawn.get_array(), dtype=float)
    assert np.nanmedian(values) == pytest.approx(1e6 * (0.001 + 0.5e-6), rel=1e-3)  # Green-Lagrange of 0.1 %
    assert result.plot().axes[1].get_ylabel().startswith("W")


def test_pyvista_gets_the_surface_of_the_valid_points(result: Result) -> None:
    surface = result.pyvista()
    assert surface.n_points == 179
    valid = result.valid
    np.testing.assert_allclose(surface.points, np.stack([result[f"{k}_mm"][valid] for k in "xyz"], axis=1))
    warped = surface.warp_by_vector("displacement", factor=1.0)
    np.testing.assert_allclose(warped.points, 1.001 * surface.points, rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(surface["sigma_w_mm"], result["sigma_w_mm"][valid])


def test_without_pyvista_the_remedy_is_named(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(StateError) as caught:
        result.pyvista()
    assert (caught.value.code, caught.value.remedy) == ("pyvista_missing", "pip install pyvista.")


def test_a_card_escapes_what_it_shows_and_leaves_out_what_is_unknown() -> None:
    shown = card("<b>", [("name", "<script>"), ("n", 3), ("unknown", None)], b"png", 'a "map"')
    assert "&lt;script&gt;" in shown
    assert "<script>" not in shown
    assert "unknown" not in shown
    assert 'alt="a &quot;map&quot;" src="data:image/png;base64,cG5n"' in shown


def test_a_calibration_shows_its_cameras() -> None:
    pair = cameras_beside(64)
    text = json.dumps({name: camera.paper_parameters() for name, camera in (("cam1", pair.cam1), ("cam2", pair.cam2))})
    loaded = parse_calibration(text.encode(), name="c")
    assert loaded.pair.baseline_mm == pytest.approx(0.6)
    assert repr(loaded).startswith("<Calibration from calibration_json: baseline ")
    shown = loaded._repr_html_()
    assert "0.600 mm" in shown
    assert shown.count("f = 1000.00, 1000.00 px") == 2


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
