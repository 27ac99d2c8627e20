"""``stereorig measure`` with every option beside every other: a sequence is measured, or refused by a coded problem."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import combinations, product
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray as xr

from stereorig.core.names import CAMERAS
from stereorig.core.noise import NoiseModel
from stereorig.server.cli import main
from stereorig.server.formats.images import write_image
from stereorig.server.formats.noise_json import noise_content, write_noise
from tests.support.localised_strain import Strained, necking
from tests.support.matching_scene import Texture, digitise, paper_pair, render

SIZE = 150
# peak strains 0, 4, 12, 20 and 30 %: patches become quadratic on the way
STATES = [
    Strained(necking(0.36 * peak, 0.36), (0.02 * k, 0.01, 0.0)) for k, peak in enumerate((0, 0.04, 0.12, 0.2, 0.3))
]
COVERED = 2  # in this step a strip hides a part of the plate: its points are lost, and found again later

Option = tuple[str, ...]
OPTIONS: dict[str, list[Option]] = {
    "region": [
        ("--roi", "30,30,119,119"),
        ("--roi", "circle:75,75,44"),
        ("--roi", "polygon:30,30,120,34,118,116,34,118"),
        ("--roi", "auto"),
        ("--mask", "mask.png"),
    ],
    "cut": [(), ("--crack", "20,90,70,92"), ("--hole", "circle:60,60,9")],
    "patch": [("--patch", name) for name in ("auto", "affine", "rigid", "quadratic")],
    "subset": [("--subset", "19"), ("--subset", "15")],
    "step": [("--step", "9"), ("--step", "6")],
    "interpolation": [(), ("--interpolation", "cubic")],
    "prefilter": [(), ("--prefilter", "0.6")],
    "sigma": [(), ("--max-sigma", "0.03"), ("--max-sigma", "1")],
    "rejected": [(), ("--keep-rejected",)],
    "seed": [(), ("--seed", "75,75"), ("--seed", "40,100")],
    "noise": [(), ("--noise", "noise.json")],
    "strain": [("--strain", "off"), ("--strain", "5"), ("--strain", "7")],
    "order": [(), ("--strain-order", "1"), ("--strain-order", "2")],
    "tensor": [(), ("--strain-tensor", "hencky")],
    "dense": [(), ("--dense", "3")],
    "smooth": [(), ("--smooth", "5")],
    "reference": [("--reference-update", name) for name in ("auto", "always", "never")],
    "projected": [(), ("--projected",)],
    "frame": [(), ("--frame", "specimen")],
}


Row = dict[str, int]


def _pairs(row: Row) -> set[tuple[tuple[str, int], tuple[str, int]]]:
    return set(combinations([(name, row[name]) for name in OPTIONS if name in row], 2))


def covering_rows(seed: int = 1) -> list[Row]:
    """Return rows that hold every two values of two options: each the best of some that begin with an open pair."""
    rng = np.random.default_rng(seed)
    todo = {
        pair
        for a, b in combinations(OPTIONS, 2)
        for pair in product(*([(name, k) for k in range(len(OPTIONS[name]))] for name in (a, b)))
    }
    rows: list[Row] = []
    while todo:
        tried: list[Row] = []
        for _ in range(12):
            row: Row = dict(sorted(todo)[int(rng.integers(len(todo)))])
            for name in rng.permutation([name for name in OPTIONS if name not in row]).tolist():
                gains = [len(_pairs(row | {name: k}) & todo) for k in range(len(OPTIONS[name]))]
                row[name] = int(rng.choice(np.flatnonzero(np.array(gains) == max(gains))))
            tried.append(row)
        rows.append(max(tried, key=lambda row: len(_pairs(row) & todo)))
        todo -= _pairs(rows[-1])
    return rows


ROWS = covering_rows()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plate")
    pair, texture, rng = paper_pair(size=SIZE), Texture(extent_mm=4.0), np.random.default_rng(3)
    for k, state in enumerate(STATES):
        for name, camera in zip(CAMERAS, (pair.cam1, pair.cam2), strict=True):
            image = render(camera, state, texture, size=SIZE, samples=2)  # type: ignore[arg-type]
            if k == COVERED:
                image[60:84] = 90.0
            write_image(folder / f"{name}_{k}.tif", digitise(image, noise=2.0, rng=rng))
    calibration = {
        name: camera.paper_parameters() for name, camera in zip(CAMERAS, (pair.cam1, pair.cam2), strict=True)
    }
    (folder / "calibration.json").write_text(json.dumps(calibration))
    mask = np.zeros((SIZE, SIZE), np.uint8)
    cv2.circle(mask, (75, 75), 46, 255, -1)
    write_image(folder / "mask.png", mask)
    noise = NoiseModel(coefficients=(4.0, 0.01, 0.0), range_grey=(0.0, 255.0))
    write_noise(folder / "noise.json", noise_content(dict.fromkeys(CAMERAS, noise)))
    return folder


def measured(folder: Path, out: Path, options: Iterable[str]) -> int:
    """Return the exit status, 2 for a refused command line; any other exception leaves here."""
    arguments = [str(folder / value) if value.endswith((".png", ".json")) else value for value in options]
    command = ["measure", "--calibration", str(folder / "calibration.json"), "--out", str(out)]
    images = [part for name in CAMERAS for part in (f"--{name}", str(folder / f"{name}_*.tif"))]
    try:
        return main([*command, *images, *arguments])
    except SystemExit as stopped:
        return int(str(stopped.code))


@pytest.mark.parametrize("row", [pytest.param(k, marks=[] if k < 2 else [pytest.mark.deep]) for k in range(len(ROWS))])
def test_options_together_measure_or_name_their_problem(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], row: int
) -> None:
    options = [part for name, k in ROWS[row].items() for part in OPTIONS[name][k]]
    status = measured(folder, tmp_path / "out", options)
    printed = capfd.readouterr().err
    assert status in {0, 1, 2, 3, 4, 5}
    assert "Traceback" not in printed
    if status in {0, 3, 4, 5}:
        steps = json.loads((tmp_path / "out" / "summary.json").read_text())["steps"]
        assert len(steps) == len(STATES)
    else:
        assert "stereorig" in printed


def test_rejected_points_of_later_references_are_kept_in_the_first_references_frame(
    folder: Path, tmp_path: Path
) -> None:
    # patches become quadratic on the way: six terms in the segment, three in its totals
    options = "--roi 30,30,119,119 --subset 19 --step 9 --patch quadratic --reference-update always --keep-rejected"
    assert measured(folder, tmp_path, [*options.split(), "--strain", "off"]) == 0
    known = 0
    for k in range(len(STATES)):
        with xr.open_dataset(tmp_path / f"step_{k:04d}.nc") as data:
            xy = np.stack([data.x_px, data.y_px], -1)
            kept = np.stack([data.rejected_x_mm, data.rejected_y_mm, data.rejected_z_mm], -1)
        off = np.abs(kept - STATES[0].position(STATES[0].material(paper_pair(size=SIZE).cam1, xy)))
        off = off[np.isfinite(off).all(axis=-1)]
        known += len(off) if k >= COVERED else 0
        assert (np.median(off, axis=0) < 0.05).all() if len(off) else True
    assert known > 0
