"""``stereorig expect`` and POST /calibrations:expect: the same prediction, of a rig that is there or not."""

from __future__ import annotations

import json
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.server.cli.main import main
from tests.support.requirements import ROOT

RIG = str(ROOT / "config" / "sim_paper.toml")
NOT_THERE = [
    *("--focal-mm", "35", "--pixel-um", "5", "--image-size-px", "2448,2048", "--standoff-mm", "500"),
    *("--angle-deg", "25", "--pitch-mm", "10", "--lines", "11,11", "--positions", "-10,0,10"),
]


def document(capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    assert main(["expect", *options, "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def sigma_of(found: dict[str, Any], name: str, of: str, moved: tuple[float, float, float] | None = None) -> float:
    wanted = None if moved is None else list(moved)
    one = next(q for q in found["quantities"] if (q["name"], q["of"], q["translation_mm"]) == (name, of, wanted))
    return float(one["sigma"])


def test_a_rig_file_is_predicted_as_a_table_in_micrometres(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["expect", "--rig", RIG]) == 0
    shown = capsys.readouterr().out
    assert shown.splitlines()[0].split() == [
        *("quantity", "after,", "mm", "u", "(k", "=", "1)", "matching", "reference", "calibration", "stage", "target")
    ]
    assert "length along X, 10 mm" in shown
    assert "Not included" in shown


def test_a_rig_that_is_not_there_is_predicted_from_options_alone(capsys: pytest.CaptureFixture[str]) -> None:
    usual = document(capsys, *NOT_THERE)
    for one in usual["quantities"]:
        assert one["sigma"] == pytest.approx(np.sqrt(sum(v**2 for v in one["budget"].values())), rel=1e-9)
    # twice the noise of the images is twice the noise of the matches, and nothing else
    noisy = document(capsys, *NOT_THERE, "--image-noise-grey", "4")
    w, doubled = (
        next(q for q in d["quantities"] if q["name"] == "w" and q["of"] == "point")["budget"] for d in (usual, noisy)
    )
    assert doubled["matching"] == pytest.approx(2.0 * w["matching"], rel=0.01)
    assert doubled["target"] == pytest.approx(w["target"], rel=1e-6)
    # a scale of the target is one of every length
    scaled = document(capsys, *NOT_THERE, "--pitch-scale-sigma", "1e-4")
    length = next(q for q in scaled["quantities"] if q["name"] == "length along X")
    assert length["budget"]["target"] == pytest.approx(1e-3, rel=0.01)
    # a longer lens, and so a coarser image of nothing: Z comes down with the pixel's size on the surface
    longer = document(capsys, *NOT_THERE, "--focal-mm", "50")
    assert sigma_of(longer, "Z", "point") == pytest.approx(0.7 * sigma_of(usual, "Z", "point"), rel=0.05)


def test_what_is_missing_or_out_of_range_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    for options, text in (
        (["--phd-px", "7000"], "--image-size-px, --standoff-mm"),
        ([*NOT_THERE, "--subset", "20"], "odd"),
        ([*NOT_THERE, "--phd-px", "7000"], "phd_px and focal_mm"),
        ([*NOT_THERE, "--contrast-grey", "x"], "--contrast-grey"),
        ([*NOT_THERE, "--noise-px", "0"], "--noise-px"),
    ):
        assert main(["expect", *options]) == 1, options
        assert text in capsys.readouterr().err


def test_a_length_that_the_cameras_do_not_see_has_no_number(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, *NOT_THERE, "--length-mm", "900")
    lengths = [q for q in found["quantities"] if q["of"] == "length"]
    assert [q["sigma"] for q in lengths] == [None, None]
    assert all(q["missing"] and q["budget"] == {} for q in lengths)
    assert main(["expect", *NOT_THERE, "--length-mm", "900"]) == 0


def test_the_service_predicts_the_same_for_a_rig_that_differs_from_its_own(client: httpx.Client) -> None:
    def asked(**body: object) -> dict[str, Any]:
        answer = client.post("/api/v1/calibrations:expect", json=body)
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    own = asked()
    assert {q["name"] for q in own["quantities"]} >= {"X", "Z", "length along X", "u", "v", "w", "exx"}
    fine = asked(measurement={"image_noise_grey": 0.5, "translations_mm": [0.0]})
    assert sigma_of(fine, "Z", "point") < sigma_of(own, "Z", "point")
    # positions that the service's stage does not reach, of a rig that has another
    far = {"positions_mm": [-20.0, 0.0, 20.0], "held_out_mm": [], "rig": {"stage_step_sigma_mm": 0.01}}
    stage = next(q for q in asked(**far)["quantities"] if q["name"] == "w" and q["of"] == "point")["budget"]["stage"]
    assert stage > 0.0
    wrong = client.post("/api/v1/calibrations:expect", json={"measurement": {"subset_px": 20}})
    assert wrong.status_code == 422


def test_what_the_cameras_see_follows_from_what_is_stated(capsys: pytest.CaptureFixture[str]) -> None:
    plain = document(capsys, *NOT_THERE)["views"]["cam1"]
    # similar triangles: 2448 pixels of 5 um behind 35 mm, at 500 mm
    assert plain["field_mm"][0] == pytest.approx(2448 * 0.005 * 500.0 / 35.0)
    assert plain["um_per_px"] == pytest.approx(5.0 * 500.0 / 35.0)
    assert plain["speckle_mm"] == pytest.approx([3e-3 * plain["um_per_px"], 5e-3 * plain["um_per_px"]])
    assert (plain["depth_mm"], plain["blur_px"], plain["photons_at_1000_lx"]) == (None, None, None)
    assert plain["missing"] == ["f_number", "exposure_ms", "speed_mm_s"]
    moved = ("--f-number", "8", "--exposure-ms", "10", "--speed-mm-s", "2")
    full = document(capsys, *NOT_THERE, *moved)["views"]["cam2"]
    assert full["missing"] == []
    # 0.02 mm of motion during the exposure
    assert full["blur_px"] == pytest.approx(0.02 / (1e-3 * full["um_per_px"]))
    # 1,000 lx on matt white are 1,000 / (4 8^2) lx behind f/8, for 10 ms on 25 um^2; 683 lm/W, 3.579e-19 J a photon
    photons = 1000.0 / (4.0 * 8.0**2) * 0.01 * 25e-12 / 683.0 / 3.579e-19
    assert full["photons_at_1000_lx"] == pytest.approx(photons, rel=1e-3)
    # a thin lens with the sensor at 35 mm in focus on 500 mm: the cone of a point elsewhere, cut by the sensor
    pupil, sensor = 35.0 / 8.0, 35.0
    for z in (500.0 - full["depth_mm"][0], 500.0 + full["depth_mm"][1]):
        image = 1.0 / (1.0 / 500.0 + 1.0 / sensor - 1.0 / z)
        assert pupil * abs(image - sensor) / image == pytest.approx(0.005, rel=1e-9)
    assert main(["expect", *NOT_THERE, *moved]) == 0
    shown = capsys.readouterr().out
    assert "mm nearer to" in shown
    assert main(["expect", *NOT_THERE]) == 0
    assert "not stated: f_number, exposure_ms, speed_mm_s" in capsys.readouterr().out


def test_the_modulus_of_a_planned_test_scatters_as_its_parts_say(capsys: pytest.CaptureFixture[str]) -> None:
    """Tests drawn with the predicted errors of strain, load and section, and a line through each."""
    planned = ["--area-mm", "12", "--modulus-strains", "0.0005,0.0025", "--modulus-steps", "15"]
    found = document(capsys, *NOT_THERE, *planned, "--load-class", "0.5", "--section-u", "0.003")["modulus"]
    assert found["gauge_mm"] == pytest.approx(12.0, rel=0.1)
    assert found["missing"] == []
    strain = np.linspace(0.0005, 0.0025, 15)
    spread, rng, moduli = 0.002 * np.sqrt(15 * 16 / (12 * 14)), np.random.default_rng(1), []
    for _ in range(4000):
        load = strain * (1.0 + 0.005 * rng.uniform(-1.0, 1.0)) / (1.0 + 0.003 * rng.normal())
        # noise by the predicted slope's part, the reference's noise in all steps alike, the cameras' growing
        read = strain * (1.0 + found["parts"]["cameras"] * rng.normal()) + 1e-4 * rng.normal()
        read = read + found["parts"]["noise"] * spread * rng.normal(size=15)
        moduli.append(1.0 / np.polyfit(load, read, 1)[0])
    # a standard deviation of 4,000 is known to 1.1 %
    assert np.std(moduli) / np.mean(moduli) == pytest.approx(found["relative_u"], rel=0.05)
    # what is not stated is named, and no whole is made of the rest
    assert main(["expect", *NOT_THERE, *planned]) == 0
    assert "modulus: not stated: load_class, section_u; noise" in capsys.readouterr().out
    assert main(["expect", *NOT_THERE, "--modulus-strains", "0.003,0.001"]) == 1
    assert "lower end first" in capsys.readouterr().err


def test_a_wider_gauge_and_more_steps_know_the_modulus_better(capsys: pytest.CaptureFixture[str]) -> None:
    def noise(*options: str) -> float:
        return float(document(capsys, *NOT_THERE, *options)["modulus"]["parts"]["noise"])

    assert noise("--area-mm", "20") < 0.6 * noise("--area-mm", "12")
    few, many = (noise("--modulus-steps", str(n)) for n in (20, 80))
    assert many == pytest.approx(few * np.sqrt(20 * 21 / 19) / np.sqrt(80 * 81 / 79), rel=1e-9)


CRACKED = [
    *("--crack-half-mm", "20", "--panel-width-mm", "200", "--panel-thickness-mm", "2", "--panel-load-n", "40000"),
    *("--youngs-modulus-mpa", "73100", "--modulus-u", "0.01", "--ring-mm", "4,16"),
]


def test_k_of_a_planned_panel_is_the_formulas_and_its_noise_that_of_a_line_fit(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = document(capsys, *NOT_THERE, *CRACKED)["k1"]
    # 40 kN over 200 x 2 mm2, a crack of a fifth of the width: the secant, which is within 0.2 % of Tada's
    k = 100.0 * np.sqrt(np.pi * 0.020 / np.cos(np.pi * 20.0 / 200.0))
    assert found["k1"] == pytest.approx(k, rel=2e-3)
    assert found["parts"]["modulus"] == pytest.approx(0.01 * found["k1"])
    assert found["u"] == pytest.approx(np.linalg.norm(list(found["parts"].values())))
    # twice the noise is twice the part; a narrower subset has more of it
    twice, dense = (
        document(capsys, *NOT_THERE, *CRACKED, *more)["k1"]["parts"]
        for more in (["--image-noise-grey", "4"], ["--subset", "17"])
    )
    assert twice["matching"] == pytest.approx(2.0 * found["parts"]["matching"], rel=0.02)
    assert dense["matching"] > found["parts"]["matching"]
    assert found["parts"]["calibration"] < found["parts"]["modulus"]
    assert main(["expect", *NOT_THERE, "--crack-half-mm", "20"]) == 0
    assert "K_I: not stated: panel_width_mm" in capsys.readouterr().out
    assert main(["expect", *NOT_THERE, *CRACKED, "--panel-width-mm", "41"]) == 1
    assert "panel" in capsys.readouterr().err
