"""Printed targets and speckle: drawn by other programs, found by the detectors, measured, refused."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.boards.board import BoardTarget
from stereorig.core.boards.targets import detect_target
from stereorig.core.errors import InputError
from stereorig.core.pattern import pattern_size
from stereorig.core.target import GridTarget
from stereorig.server.cli.main import main
from stereorig.server.formats.calibrations.target_toml import read_target
from stereorig.server.formats.prints.speckle import speckle_page
from stereorig.server.formats.prints.targets import target_drawing, target_text
from tests.support.printed_page import as_seen, pdf_image, svg_image
from tests.support.requirements import ROOT

pytestmark = pytest.mark.timeout(300)
Target = GridTarget | BoardTarget
TARGETS: dict[str, Target] = {
    "dark lines": GridTarget(pitch_mm=10.0, lines=(13, 17), line_width_mm=0.8),
    "bright lines": GridTarget(pitch_mm=10.0, lines=(13, 17), line_width_mm=0.8, dark_lines=False),
    "checkerboard": BoardTarget(kind="checkerboard", size=(7, 10), pitch_mm=18.0),
    "charuco": BoardTarget(kind="charuco", size=(7, 10), pitch_mm=18.0, marker_mm=13.0),
    "dots": BoardTarget(kind="circles", size=(9, 12), pitch_mm=15.0),
    "asymmetric dots": BoardTarget(kind="circles_asymmetric", size=(5, 11), pitch_mm=15.0, dot_diameter_mm=8.0),
}
# a pitch's part of a page; the drawing programs place edges to a 256th of a pixel, the pages have 800 pixels and more
EXACT = 1e-5


def nominal(target: Target) -> Float:
    return target.inner_points_mm() if isinstance(target, GridTarget) else target.points_mm()


def pitch_errors(found_px: Float, nominal_mm: Float, per_mm: float) -> Float:
    """Relative errors of the pitch along X and Y, and the shears, of points found in a drawn page."""
    seen = np.isfinite(found_px).all(axis=-1)
    points = np.column_stack([nominal_mm[seen], np.ones(int(seen.sum()))])
    fitted = np.linalg.lstsq(points, found_px[seen], rcond=None)[0]
    return np.asarray((fitted[:2] / per_mm - np.eye(2)).ravel())


@pytest.mark.parametrize("per_mm", [4.0, 7.5, 10.0])
@pytest.mark.parametrize("name", TARGETS)
def test_every_target_is_found_in_its_pdf_with_its_pitch(name: str, per_mm: float) -> None:
    target = TARGETS[name]
    drawing = target_drawing(target, marks=name == "dots")
    found = detect_target(as_seen(pdf_image(drawing, per_mm)), target)
    assert np.isfinite(found.xy_px).all()
    assert np.abs(pitch_errors(found.xy_px, nominal(target), per_mm)).max() < EXACT


@pytest.mark.parametrize("name", TARGETS)
def test_the_svg_is_the_same_page(name: str) -> None:
    target, per_mm = TARGETS[name], 6.0
    found = detect_target(as_seen(svg_image(target_drawing(target), per_mm)), target)
    assert np.abs(pitch_errors(found.xy_px, nominal(target), per_mm)).max() < EXACT


def opencv_points(image: NDArray[np.uint8], target: BoardTarget) -> Float:
    """Points (columns, rows, 2) that OpenCV finds."""
    columns, rows = target.size
    if target.kind == "checkerboard":
        ok, points = cv2.findChessboardCornersSB(image, (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
    elif target.kind == "charuco":
        book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        board = cv2.aruco.CharucoBoard((columns + 1, rows + 1), target.pitch_mm, float(target.marker_mm or 0.0), book)
        points, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        ok = len(ids) == columns * rows
        points = points[np.argsort(ids.ravel())]
    else:
        grid = cv2.CALIB_CB_SYMMETRIC_GRID if target.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
        wanted = cv2.SimpleBlobDetector.Params()
        wanted.minArea, wanted.maxArea = 400.0, 1e5  # not the rulers' numbers
        ok, points = cv2.findCirclesGrid(
            image, (columns, rows), flags=grid, blobDetector=cv2.SimpleBlobDetector.create(wanted)
        )
    assert ok
    found = np.asarray(points, dtype=np.float64).reshape(rows, columns, 2).swapaxes(0, 1)
    # OpenCV may begin at the other end
    return found[::-1, ::-1] if found[0, 0, 1] > found[-1, -1, 1] else found


@pytest.mark.parametrize("per_mm", [4.0, 7.5, 10.0])
@pytest.mark.parametrize("name", ["checkerboard", "charuco", "dots", "asymmetric dots"])
def test_opencv_finds_the_boards(name: str, per_mm: float) -> None:
    target = TARGETS[name]
    assert isinstance(target, BoardTarget)
    found = opencv_points(as_seen(pdf_image(target_drawing(target), per_mm)), target)
    assert np.abs(pitch_errors(found, nominal(target), per_mm)).max() < EXACT


@pytest.mark.parametrize("per_mm", [4.0, 7.5, 10.0])
def test_the_rulers_are_as_long_as_they_say(per_mm: float) -> None:
    drawing = target_drawing(TARGETS["checkerboard"])
    dark = 255.0 - pdf_image(drawing, per_mm)
    # the marks across lie in the last 17 to 21 mm of the page, those down in the first 10 to 14; long ones alone count
    for profile, count in (
        (dark[round((297 - 21) * per_mm) : round((297 - 20.1) * per_mm)].sum(axis=0), 18),
        (dark[:, round(13.2 * per_mm) : round(14 * per_mm)].sum(axis=1), 26),
    ):
        at = np.arange(len(profile)) + 0.5
        places = np.array([np.average(at[a:b], weights=profile[a:b]) for a, b in runs(profile > 0.02 * profile.max())])
        assert len(places) == count
        slope = np.polyfit(10.0 * np.arange(count), places, 1)[0]
        assert slope / per_mm == pytest.approx(1.0, abs=EXACT)


def runs(inside: NDArray[np.bool_]) -> list[tuple[int, int]]:
    steps = np.diff(np.concatenate([[0], inside.astype(int), [0]]))
    return list(zip(np.flatnonzero(steps == 1).tolist(), np.flatnonzero(steps == -1).tolist(), strict=True))


@pytest.mark.parametrize("share", [0.3, 0.5, 0.65])
def test_speckle_has_its_size_and_its_black_share(share: float) -> None:
    diameter, per_mm = 1.0, 40.0
    drawing = speckle_page(diameter, share=share, seed=3, paper="100x120")
    centres = drawing.discs[0].centres
    low, high = centres.min(axis=0) + 2.0, centres.max(axis=0) - 2.0
    image = pdf_image(drawing, per_mm)
    inside = image[int(low[1] * per_mm) : int(high[1] * per_mm), int(low[0] * per_mm) : int(high[0] * per_mm)]
    # some thousand discs: the share varies by less than 0.005 from seed to seed; PDFium's discs are smaller by 0.7 %
    assert 1.0 - inside.mean() / 255.0 == pytest.approx(share, abs=0.01)
    size = pattern_size(cv2.resize(inside, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))
    assert size is not None
    # discs at places that know nothing of each other; one in each cell is a little more regular
    assert size.feature_px / (0.25 * per_mm) == pytest.approx(width_of_independent_discs(share) * diameter, rel=0.1)


def width_of_independent_discs(share: float) -> float:
    """Full width at half maximum of the autocovariance of a Boolean model of discs of diameter 1."""
    intensity = -np.log(1.0 - share)
    apart = np.linspace(0.0, 1.0, 10_001)
    overlap = 2.0 / np.pi * (np.arccos(apart) - apart * np.sqrt(1.0 - apart**2))
    covariance = np.expm1(intensity * overlap)
    return float(2.0 * apart[np.argmax(covariance < 0.5 * covariance[0])])


def test_the_same_seed_is_the_same_file_and_another_one_is_not() -> None:
    made = [speckle_page(1.0, seed=seed) for seed in (7, 7, 8)]
    assert made[0].pdf() == made[1].pdf() != made[2].pdf()
    assert made[0].svg() == made[1].svg()


def test_the_target_file_describes_the_print(tmp_path: Path) -> None:
    for name, target in TARGETS.items():
        path = tmp_path / f"{name}.toml"
        path.write_text(target_text(target), encoding="utf-8")
        assert read_target(path) == target


def test_a_named_paper_is_turned_if_the_pattern_fits_only_so() -> None:
    wide = BoardTarget(kind="checkerboard", size=(10, 7), pitch_mm=18.0)
    drawing = target_drawing(wide)
    assert (drawing.width_mm, drawing.height_mm) == (297.0, 210.0)
    with pytest.raises(InputError) as caught:
        target_drawing(wide, paper="210x297")
    assert caught.value.code == "print_too_large"


def test_a_print_is_made_and_its_measured_rulers_become_the_pitch(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, beside, wanted = (tmp_path / name for name in ("board.pdf", "board.toml", "wanted.toml"))
    wanted.write_text('kind = "checkerboard"\nsize = [7, 10]\npitch_mm = 18.0\n', encoding="utf-8")
    assert main(["print", "target", str(wanted), "--out", str(page)]) == 0
    assert page.read_bytes().startswith(b"%PDF")
    assert "not measured" in beside.read_text(encoding="utf-8")
    assert read_target(beside).pitch_scale_sigma == 5e-3
    both = ["--printed-mm", "100", "200", "--measured-mm", "99.93", "200.4", "--u-mm", "0.05"]
    assert main(["print", "measured", *both, str(beside)]) == 0
    assert "directions differ by 0.27 %" in capsys.readouterr().out
    first = read_target(beside)
    # by hand: scales 0.9993 and 1.002; readings that may err alike are 0.05/100 and 0.05/200, a mean of 3.75e-4
    assert first.pitch_mm == pytest.approx(18.0 * 1.00065, rel=1e-9)
    assert first.pitch_scale_sigma == pytest.approx(3.75e-4)
    # half the difference at the board's half length, 4.5 pitches
    assert first.node_tolerance_mm == pytest.approx(0.00135 * 4.5 * 18.0 * 1.00065, rel=1e-6)
    assert first.flatness_mm == 0.0
    # measured again, the first measurement counts no more
    one = ["--printed-mm", "100", "--measured-mm", "99.93", "--u-mm", "0.05"]
    assert main(["print", "measured", *one, str(beside)]) == 0
    assert "one direction" in capsys.readouterr().out
    again = read_target(beside)
    assert again.pitch_mm == pytest.approx(18.0 * 0.9993, rel=1e-8)
    assert (again.pitch_scale_sigma, again.node_tolerance_mm) == (pytest.approx(5e-4), 0.0)


def test_speckle_by_the_rig_file_has_the_pixels_of_its_specimen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "config" / "sim_panel.toml").read_text(encoding="utf-8")
    standoff, distance = (
        float(re.search(rf"^{key} = ([0-9.]+)", text, re.MULTILINE)[1])  # type: ignore[index]
        for key in ("standoff_mm", "phd_px")
    )
    rig = ["--rig", str(ROOT / "config" / "sim_panel.toml"), "--speckle-px", "5"]
    assert main(["print", "speckle", *rig, "--out", str(tmp_path / "s.svg")]) == 0
    diameter = float(re.search(r"discs of ([0-9.]+) mm", capsys.readouterr().out)[1])  # type: ignore[index]
    assert diameter == pytest.approx(5.0 * standoff / distance, rel=1e-3)


BOARD = 'kind = "checkerboard"\nsize = [9, 6]\npitch_mm = 20.0\n'


@pytest.mark.parametrize(
    ("text", "options", "code"),
    [
        (BOARD.replace("20.0", "60.0"), [], "print_too_large"),
        (BOARD.replace("pitch_mm", "pitch"), [], "field_invalid"),
        (BOARD, ["--marks"], "target_invalid"),
        (BOARD, ["--paper", "A9"], "print_page"),
        (BOARD, ["--paper", "10x10"], "print_page"),
        (BOARD, ["--margin-mm", "nan"], "print_page"),
        (BOARD.replace("checkerboard", "charuco") + 'marker_mm = 15.0\ndictionary = "DICT_4X4"', [], "field_invalid"),
        ("", ["--speckle-mm", "0.02"], "speckle_invalid"),
        ("", ["--speckle-mm", "30"], "speckle_invalid"),
        ("", ["--speckle-mm", "nan"], "speckle_invalid"),
        ("", ["--speckle-mm", "1", "--share", "0.9"], "speckle_invalid"),
        ("", ["--speckle-px", "9", "--rig", "config/sim_panel.toml"], "speckle_invalid"),
        ("", [], "nominal_missing"),
    ],
)
def test_what_cannot_be_printed_is_one_line_with_cause_and_remedy(
    text: str, options: list[str], code: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted, page = tmp_path / "wanted.toml", tmp_path / "page.pdf"
    wanted.write_text(text, encoding="utf-8")
    what = ["target", str(wanted)] if text else ["speckle"]
    assert main(["print", *what, *options, "--out", str(page)]) == 1
    line = capsys.readouterr().err
    assert line.startswith(f"stereorig: {code}: ")
    assert line.count("\n") == 1
    assert "Remedy: " in line
    assert list(tmp_path.iterdir()) == [wanted]


@pytest.mark.parametrize(
    ("printed", "measured", "u"), [(["100"], ["9.99"], "0.05"), (["100", "100"], ["99.9"], "0.05"), (["0"], ["1"], "1")]
)
def test_a_ruler_that_no_print_has_changes_nothing(
    printed: list[str], measured: list[str], u: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "target.toml"
    path.write_text(before := target_text(TARGETS["checkerboard"]), encoding="utf-8")
    lengths = ["--printed-mm", *printed, "--measured-mm", *measured, "--u-mm", u]
    assert main(["print", "measured", str(path), *lengths]) == 1
    assert "ruler_implausible" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == before


def test_a_rig_file_is_not_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(before := (ROOT / "config" / "sim_paper.toml").read_text(encoding="utf-8"), encoding="utf-8")
    lengths = ["--printed-mm", "100", "--measured-mm", "99.9", "--u-mm", "0.05"]
    assert main(["print", "measured", str(path), *lengths]) == 1
    assert "field_invalid" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == before


def test_the_api_gives_the_pages_that_the_command_writes(client: httpx.Client) -> None:
    board = {"kind": "checkerboard", "size": [7, 10], "pitch_mm": 18.0}
    answer = client.post("/api/v1/prints/target", json={"target": board, "form": "svg"})
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "image/svg+xml"
    assert answer.headers["content-disposition"] == 'attachment; filename="target.svg"'
    assert answer.content == target_drawing(TARGETS["checkerboard"]).svg()
    rigs = client.post("/api/v1/prints/target", json={"paper": "600x400"})
    assert rigs.content.startswith(b"%PDF")
    beside = client.post("/api/v1/prints/target", json={"target": board, "form": "toml"}).text
    rulers = {"printed_mm": [100.0, 200.0], "measured_mm": [99.93, 200.4], "u_mm": 0.05}
    found = client.post("/api/v1/prints/measured", json={"target_file": beside, **rulers}).json()
    # by hand, as above
    assert (found["scale"], found["sigma"]) == (pytest.approx(1.00065), pytest.approx(3.75e-4))
    assert f"pitch_mm = {18.0 * 1.00065:.9g}" in found["target_file"]
    speckle = client.get("/api/v1/prints/speckle", params={"diameter_mm": 1.0, "form": "svg"})
    assert speckle.content == speckle_page(1.0).svg()


@pytest.mark.parametrize(
    ("method", "path", "sent", "code"),
    [
        ("POST", "target", {"paper": "A5"}, "print_page"),
        ("POST", "target", {"paper": "40x40"}, "print_too_large"),
        ("POST", "target", {"target": {"pitch_mm": 1.0}}, "invalid_request"),
        ("GET", "speckle", {"diameter_px": 9.0}, "speckle_invalid"),
        ("GET", "speckle", {"diameter_mm": 1.0, "share": 0.95}, "speckle_invalid"),
        ("POST", "measured", {"target_file": "[", "printed_mm": [1], "measured_mm": [1], "u_mm": 1}, "toml_malformed"),
    ],
)
def test_a_page_that_cannot_be_is_refused_with_its_code(
    client: httpx.Client, method: str, path: str, sent: dict[str, object], code: str
) -> None:
    how = {"json": sent} if method == "POST" else {"params": sent}
    answer = client.request(method, f"/api/v1/prints/{path}", **how)  # type: ignore[arg-type]
    assert (answer.status_code, answer.json()["code"]) == (422, code)
    assert answer.json()["remedy"]
