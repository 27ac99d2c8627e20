"""Faults, line 29: a grid that cannot be indexed without doubt is refused with the reason; the accepted is right."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.errors import ImageError, TargetError
from stereorig.core.grid import GridOptions, GridView, detect_grid
from stereorig.core.grid.lattice import LineLattice
from stereorig.core.grid.seen import SeenLines
from stereorig.core.grid.threshold import LinePicture
from stereorig.core.target import GridTarget
from tests.support.grid_images import PAPER_TARGET, Exposure, expose, paper_camera, render_cover, truth_px

pytestmark = pytest.mark.fault(29)

CAMERA = paper_camera(-30.0)
FAR = paper_camera(-30.0, z0_mm=560.0)  # with room around the grid


@cache
def _plain_cover(far: bool) -> Float:
    return render_cover(FAR if far else CAMERA, PAPER_TARGET)


def _grey(camera: Camera, target: GridTarget = PAPER_TARGET, **options: Any) -> Float:
    if target is PAPER_TARGET and not options and (camera is CAMERA or camera is FAR):
        cover = _plain_cover(camera is FAR)
    else:
        cover = render_cover(camera, target, **options)
    return 200.0 - 160.0 * cover


def _digitise(grey: Float, seed: int = 0) -> NDArray[np.uint8]:
    return np.clip(np.rint(grey + np.random.default_rng(seed).normal(0.0, 2.0, grey.shape)), 0, 255).astype(np.uint8)


def _with_disc(grey: Float, x: float, y: float, radius: float, value: float) -> Float:
    reach = radius + 40.0  # e^-40 of a grey level beyond
    (top, left), (bottom, right) = (
        [int(np.clip(c + side * reach, 0, n)) for c, n in zip((y, x), grey.shape, strict=True)] for side in (-1, 1)
    )
    yy, xx = np.mgrid[top:bottom, left:right]
    m = 1.0 / (1.0 + np.exp(np.clip(np.hypot(xx - x, yy - y) - radius, -50.0, 50.0)))
    spoilt = grey.copy()
    spoilt[top:bottom, left:right] = grey[top:bottom, left:right] * (1.0 - m) + value * m
    return spoilt


def _refusal(grey: Float, target: GridTarget = PAPER_TARGET) -> TargetError:
    with pytest.raises(TargetError) as error:
        detect_grid(_digitise(grey), target)
    assert error.value.cause
    assert error.value.remedy
    return error.value


def _accepted(grey: Float, camera: Camera, target: GridTarget = PAPER_TARGET, *, limit_px: float = 0.03) -> GridView:
    view = detect_grid(_digitise(grey), target)
    error = view.xy_px - truth_px(camera, target)
    assert np.nanmax(np.abs(error)) < limit_px
    assert np.isfinite(error).mean() > (0.4 if view.pieces_used.mean() < 0.8 else 0.99)
    return view


@pytest.mark.parametrize("offset_mm", [(0.0, 2.6), (0.0, -3.0), (3.0, 0.0), (7.0, 0.0), (3.0, 3.0)])
def test_a_grid_partly_out_of_view_is_refused(offset_mm: tuple[float, float]) -> None:
    error = _refusal(_grey(paper_camera(-30.0, offset_mm=offset_mm)))
    assert error.code == "target_partly_seen"
    assert len(error.context["segments_px"]) > 8  # for the picture


@pytest.mark.parametrize("z0_mm", [330.0, 200.0, 100.0])
def test_a_grid_larger_than_the_view_is_refused(z0_mm: float) -> None:
    assert _refusal(_grey(paper_camera(-30.0, z0_mm=z0_mm))).code == "target_partly_seen"


def _quarter_turns(view: GridView, truth: Float) -> int:
    """Turns of the view's index against the drawn grid's, from the right way of reading it off."""
    error = []
    for _ in range(4):
        error.append(float(np.abs(view.xy_px - truth).max()))
        truth = np.swapaxes(truth[:, ::-1], 0, 1)
    assert min(error) < 0.03
    return int(np.argmin(error))


@pytest.mark.parametrize(
    ("alpha_deg", "turns"), [(-44.0, 3), (-20.0, 0), (0.0, 0), (10.0, 0), (20.0, 0), (66.0, 0), (72.0, 1), (90.0, 1)]
)
def test_a_grid_is_found_at_any_angle_and_indexed_as_documented(alpha_deg: float, turns: int) -> None:
    camera = paper_camera(-30.0, alpha_deg=alpha_deg, z0_mm=480.0)
    view = detect_grid(_digitise(_grey(camera)), PAPER_TARGET)
    assert _quarter_turns(view, truth_px(camera, PAPER_TARGET)) == turns
    off = np.degrees(view.rotation_rad) - (alpha_deg - 90.0 * turns) % 360.0
    assert abs((off + 180.0) % 360.0 - 180.0) < 0.3


def test_two_cameras_on_both_sides_of_the_jump_agree_when_the_orientation_is_named() -> None:
    for alpha_deg in (64.0, 70.0):
        camera = paper_camera(-30.0, alpha_deg=alpha_deg, z0_mm=480.0)
        image = _digitise(_grey(camera))
        for orientation, turns in (("diagonal", 0), ("upright", 1)):
            view = detect_grid(image, PAPER_TARGET, options=GridOptions(orientation=orientation))  # type: ignore[arg-type]
            assert _quarter_turns(view, truth_px(camera, PAPER_TARGET)) == turns


@pytest.mark.parametrize("alpha_deg", [0.0, 45.0, 72.0])
def test_counts_tell_the_axes_beside_the_jump(alpha_deg: float) -> None:
    target = GridTarget(pitch_mm=1.0, lines=(11, 9), line_width_mm=0.03)
    camera = paper_camera(-30.0, alpha_deg=alpha_deg, z0_mm=480.0)
    _accepted(_grey(camera, target), camera, target)


def test_the_papers_localiser_refuses_lines_along_the_rows() -> None:
    image = _digitise(_grey(paper_camera(-30.0, alpha_deg=1.0, z0_mm=480.0)))
    with pytest.raises(TargetError) as error:
        detect_grid(image, PAPER_TARGET, localiser="paper")
    assert error.value.code == "target_rotated"
    assert abs(error.value.context["rotation_deg"] - 1.0) < 0.3


def test_a_grid_of_unequal_counts_shows_a_turn_by_90_degrees() -> None:
    lying = GridTarget(pitch_mm=1.0, lines=(11, 9), line_width_mm=0.03)
    upright = GridTarget(pitch_mm=1.0, lines=(9, 11), line_width_mm=0.03)
    grey = _grey(CAMERA, lying)
    _accepted(grey, CAMERA, lying)
    error = _refusal(grey, upright)
    assert error.code == "target_rotated"
    assert error.context["found"] == [11, 9]


def test_mirrored_and_turned_images_are_indexed_by_the_image() -> None:
    # one image of a grid without marks cannot show either; the index then follows the picture, as documented
    camera = paper_camera(-30.0, alpha_deg=42.0)
    image = _digitise(_grey(camera))
    mirrored = detect_grid(np.ascontiguousarray(image[:, ::-1]), PAPER_TARGET).xy_px
    turned = detect_grid(np.ascontiguousarray(image[::-1, ::-1]), PAPER_TARGET).xy_px
    truth = truth_px(camera, PAPER_TARGET)
    np.testing.assert_allclose(511.0 - mirrored.swapaxes(0, 1)[..., 0], truth[..., 0], atol=0.03)
    np.testing.assert_allclose(np.array([511.0, 479.0]) - turned[::-1, ::-1], truth, atol=0.03)


@pytest.mark.parametrize("drawn", [(10, 10), (12, 12), (11, 10), (11, 12), (13, 11)])
def test_another_number_of_lines_is_refused_with_both_numbers(drawn: tuple[int, int]) -> None:
    error = _refusal(_grey(CAMERA, GridTarget(pitch_mm=0.85, lines=drawn, line_width_mm=0.03)))
    assert error.code == "target_line_count"
    assert error.context["found"] == list(drawn)
    assert error.context["expected"] == [11, 11]


def test_both_cameras_give_a_corner_the_same_index() -> None:
    for camera in (paper_camera(-30.0, alpha_deg=47.0), paper_camera(30.0, alpha_deg=43.0)):
        _accepted(_grey(camera), camera)


@pytest.mark.parametrize(("count", "radius"), [(30, 2.0), (15, 4.0), (8, 10.0), (1, 30.0)])
def test_a_little_dirt_does_no_harm(count: int, radius: float) -> None:
    rng = np.random.default_rng(count)
    grey = _grey(CAMERA)
    for _ in range(count):
        grey = _with_disc(grey, rng.uniform(60, 450), rng.uniform(40, 440), radius, 30.0)
    view = _accepted(grey, CAMERA)
    assert not view.pieces_used.all()


def _dirty(count: int, radius: float, seed: int) -> Float:
    rng = np.random.default_rng(seed)
    grey = _grey(CAMERA)
    for _ in range(count):
        grey = _with_disc(grey, rng.uniform(60, 450), rng.uniform(40, 440), radius, 30.0)
    return grey


def _honest(view: GridView, truth: Float) -> Float:
    """Errors over their reported standard deviations, of the intersections that are given."""
    z = (view.xy_px - truth) / view.sigma_px
    assert np.isfinite(z[np.isfinite(view.xy_px)]).all()
    return z[np.isfinite(z)]


@pytest.mark.fault(65)
@pytest.mark.parametrize(("count", "radius"), [(150, 3.0), pytest.param(180, 4.0, marks=pytest.mark.deep), (90, 7.0)])
def test_lines_with_dirt_keep_a_true_uncertainty(count: int, radius: float) -> None:
    z, used = [], []
    for seed in range(3):
        view = _accepted(_dirty(count, radius, seed), CAMERA)
        used.append(view.pieces_used.mean())
        z.append(_honest(view, truth_px(CAMERA, PAPER_TARGET)))
    assert max(used) < 0.85  # 33 of 220 pieces and more are spoilt
    # 480 values share some 60 numbers of the lines: their rms is 1 within 3 / sqrt(2 * 60)
    assert 0.7 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.3


def test_much_dirt_is_refused() -> None:
    error = _refusal(_dirty(900, 4.0, 1))
    assert error.code in ("target_dirty", "target_not_found")
    if error.code == "target_dirty":
        assert error.context["bad"] > 30


def test_glare_is_refused_and_a_spot_that_leaves_enough_does_no_harm() -> None:
    for radius in (6.0, 60.0):
        _accepted(_with_disc(_grey(CAMERA), 250.0, 200.0, radius, 300.0), CAMERA)
    overexposed = 300.0 - 240.0 * render_cover(CAMERA, PAPER_TARGET)
    assert _refusal(overexposed).code == "target_glare"


@pytest.mark.fault(65)
@pytest.mark.parametrize(("ground", "noise"), [(200.0, 20.0), (240.0, 20.0), (225.0, 27.0)])
def test_noise_is_measured_and_no_glare(ground: float, noise: float) -> None:
    grey = ground - 0.8 * ground * _plain_cover(False)
    noisy = np.clip(np.rint(grey + np.random.default_rng(1).normal(0.0, noise, grey.shape)), 0, 255).astype(np.uint8)
    view = detect_grid(noisy, PAPER_TARGET)
    assert 0.6 < np.sqrt(np.mean(_honest(view, truth_px(CAMERA, PAPER_TARGET)) ** 2)) < 1.4


def test_more_noise_than_lines_is_called_noise() -> None:
    grey = 150.0 - 40.0 * _plain_cover(False)
    noisy = np.clip(np.rint(grey + np.random.default_rng(1).normal(0.0, 30.0, grey.shape)), 0, 255).astype(np.uint8)
    with pytest.raises(TargetError, match="noise of 30") as error:
        detect_grid(noisy, PAPER_TARGET)
    assert "average several images" in error.value.remedy


def test_glare_that_hides_lines_is_called_glare() -> None:
    refused = _refusal(_with_disc(_grey(FAR), 250.0, 230.0, 110.0, 300.0))
    assert refused.code == "target_glare"
    assert "saturated" in refused.cause


def test_clipped_peaks_of_the_noise_are_no_glare() -> None:
    grey = 249.0 - 200.0 * _plain_cover(False)
    noisy = np.clip(np.rint(grey + np.random.default_rng(1).normal(0.0, 3.0, grey.shape)), 0, 255).astype(np.uint8)
    assert (noisy == 255).sum() > 2000
    error = detect_grid(noisy, PAPER_TARGET).xy_px - truth_px(CAMERA, PAPER_TARGET)
    assert np.abs(error).max() < 0.03


@pytest.mark.parametrize(
    "extra",
    [
        [(0, 5.5, -5.0, 5.0)],  # an edge half a pitch beyond
        [(0, 0.5, -5.0, 5.0)],  # scratches along the lines
        [(1, 1.3, -4.0, 5.0)],
        [(0, 0.5, -5.0, 5.0), (0, -2.5, -5.0, 5.0)],
        [(0, 6.5, -6.5, 6.5), (0, -6.5, -6.5, 6.5), (1, 6.5, -6.5, 6.5), (1, -6.5, -6.5, 6.5)],  # a frame
    ],
)
def test_extra_lines_that_fit_no_lattice_are_passed_over(extra: list[tuple[int, float, float, float]]) -> None:
    _accepted(_grey(FAR, extra_lines=extra), FAR)


@pytest.mark.parametrize(
    "extra",
    [
        [(0, 6.0, -5.0, 5.0)],  # a twelfth line
        [(0, -6.0, -6.0, 6.0), (1, -6.0, -6.0, 6.0)],
        [(0, k + 0.5, -5.0, 5.0) for k in range(-5, 5)],  # half the pitch
    ],
)
def test_extra_lines_that_continue_the_lattice_are_refused(extra: list[tuple[int, float, float, float]]) -> None:
    assert _refusal(_grey(FAR, extra_lines=extra)).code == "target_line_count"


def _covered(grey: Float, camera: Camera, corners_mm: list[tuple[float, float]], value: float) -> Float:
    """The image with a polygon, given clockwise on the grid's plane, of one grey level."""
    xy = camera.project(np.array([(x, y, 0.0) for x, y in corners_mm])).xy
    yy, xx = np.mgrid[0:480, 0:512].astype(np.float64)
    inside = np.ones((480, 512), dtype=bool)
    for p, q in zip(xy, np.roll(xy, -1, axis=0), strict=True):
        inside &= (q[0] - p[0]) * (yy - p[1]) - (q[1] - p[1]) * (xx - p[0]) >= 0.0
    assert inside.sum() > 1000
    return np.where(inside, value, grey)


def _strip(low: float, high: float) -> list[tuple[float, float]]:
    return [(low, -7.0), (high, -7.0), (high, 7.0), (low, 7.0)]


@pytest.mark.fault(65)
@pytest.mark.parametrize("value", [30.0, 120.0, 200.0])
@pytest.mark.parametrize(
    ("corners_mm", "lost"),
    [
        (_strip(-5.4, -4.6), 0),  # the first line, its outermost intersections are not used anyway
        (_strip(-7.0, -2.4), 2),  # a quarter of the grid, three lines
        ([(-7.0, -7.0), (2.5, -7.0), (-7.0, 2.5)], 0),  # 30 % across a corner: every line is seen in part
        ([(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)], 0),
    ],
)
def test_a_part_that_is_covered_leaves_the_rest_to_be_used(
    corners_mm: list[tuple[float, float]], lost: int, value: float
) -> None:
    view = detect_grid(_digitise(_covered(_grey(FAR), FAR, corners_mm, value)), PAPER_TARGET)
    assert np.abs(_honest(view, truth_px(FAR, PAPER_TARGET))).max() < 6.0
    found = np.isfinite(view.xy_px).all(axis=-1)
    assert found.sum() >= (9 - lost) * 9 - 27  # a line of which 30 % is left has none
    assert found.sum() > 40


def test_a_cover_along_the_last_line_seen_leaves_no_certain_number() -> None:
    # as bright as the ground and flush with a line: the grid seems to end there, on both sides
    assert _refusal(_covered(_grey(FAR), FAR, _strip(-7.0, -3.05), 200.0)).code == "target_line_count"


def _without_lines(missing: tuple[tuple[int, ...], tuple[int, ...]]) -> Float:
    nodes = PAPER_TARGET.all_points_mm()
    far = GridTarget(pitch_mm=1000.0, lines=(6, 6), line_width_mm=PAPER_TARGET.line_width_mm)
    covers = []
    for axis, at in enumerate((nodes[:, 0, 0], nodes[0, :, 1])):
        lines = [(axis, float(at[k]), -5.015, 5.015) for k in range(11) if k + 1 not in missing[axis]]
        covers.append(render_cover(FAR, far, extra_lines=lines, samples=4))
    return 200.0 - 160.0 * np.maximum(*covers)  # where two cross, the darker counts


@pytest.mark.fault(65)
@pytest.mark.parametrize(
    ("missing", "named"),
    [
        (((4,), ()), "line 4 of the columns is missing"),
        (((), (1,)), "line 1 of the rows is missing"),
        (((5, 6), (9,)), "line 5 of the columns, line 6 of the columns, line 9 of the rows are missing"),
    ],
)
def test_a_line_that_is_missing_is_named_and_where_declared_left_out(
    missing: tuple[tuple[int, ...], tuple[int, ...]], named: str
) -> None:
    grey = _without_lines(missing)
    error = _refusal(grey)
    assert error.code == "target_line_missing"
    assert named in error.cause
    assert f"missing_lines = {[list(m) for m in missing]}" in error.remedy
    view = detect_grid(_digitise(grey), dataclasses.replace(PAPER_TARGET, missing_lines=missing))
    found = np.isfinite(view.xy_px).all(axis=-1)
    inner = [[k - 2 for k in own if 1 < k < 11] for own in missing]
    assert not found[inner[0]].any()
    assert not found[:, inner[1]].any()
    assert found.sum() == (9 - len(inner[0])) * (9 - len(inner[1]))
    assert np.nanmax(np.abs(view.xy_px - truth_px(FAR, PAPER_TARGET))) < 0.06


@pytest.mark.fault(65)
def test_a_line_that_is_declared_missing_but_seen_is_named() -> None:
    other = dataclasses.replace(PAPER_TARGET, missing_lines=((8,), ()))
    assert "line 8 of the columns is declared missing but seen" in _refusal(_without_lines(((), (1,))), other).cause


@pytest.mark.parametrize("name", ["blank", "dark", "slope", "speckle", "one_family", "checker"])
def test_an_image_without_a_grid_is_refused(name: str) -> None:
    yy, xx = np.mgrid[0:480, 0:512].astype(np.float64)
    images = {
        "blank": np.full((480, 512), 200.0),
        "dark": np.zeros((480, 512)),
        "slope": 60.0 + 0.3 * xx,
        "speckle": np.repeat(np.repeat(np.random.default_rng(3).uniform(40, 200, (120, 128)), 4, 0), 4, 1),
        "one_family": 60.0 + 120.0 * (np.mod(xx + yy, 40.0) > 2.0),
        "checker": 60.0 + 120.0 * (((xx + yy) // 30 + (xx - yy) // 30) % 2),
    }
    assert _refusal(images[name]).code == "target_not_found"


def test_arrays_that_are_no_gray_image_are_refused() -> None:
    for bad in (
        np.zeros((480, 512, 3)),
        np.zeros((10, 10)),
        np.full((480, 512), np.nan),
        np.zeros((480, 512), complex),
    ):
        with pytest.raises(ImageError):
            detect_grid(bad, PAPER_TARGET)


@given(
    alpha=st.floats(27.0, 63.0),
    beta=st.floats(-10.0, 10.0),
    gamma=st.floats(-35.0, 35.0),
    aspect=st.floats(0.93, 1.07),
    lines=st.tuples(st.integers(7, 13), st.integers(7, 13)),
    width_ratio=st.floats(0.025, 0.1),
    fill=st.floats(0.6, 0.93),
    blur=st.floats(0.35, 1.0),
    dark=st.booleans(),
    bits=st.sampled_from([8, 12, 16]),
    vignette=st.floats(0.0, 0.4),
)
@settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_any_rig_is_measured_rightly_or_refused(
    alpha: float,
    beta: float,
    gamma: float,
    aspect: float,
    lines: tuple[int, int],
    width_ratio: float,
    fill: float,
    blur: float,
    dark: bool,
    bits: int,
    vignette: float,
) -> None:
    size = (560, 500)
    target = GridTarget(pitch_mm=2.0, lines=lines, line_width_mm=2.0 * width_ratio, dark_lines=dark)
    camera = _filling_camera(target, size, fill, alpha, beta, gamma, aspect)
    line, ground = (60.0, 200.0) if dark else (200.0, 60.0)
    radius = 0.5 * float(np.hypot(*size))
    exposure = Exposure(
        ground=ground,
        line=line,
        noise=1.5,
        bits=bits,
        lighting=lambda x, y: 1.0 - vignette * ((x - 280.0) ** 2 + (y - 250.0) ** 2) / radius**2,
    )
    image = expose(render_cover(camera, target, size, blur_px=blur), exposure)
    view = detect_grid(image, target)
    error = view.xy_px - truth_px(camera, target)
    assert np.abs(error / view.sigma_px).max() < 6.0
    assert np.abs(error).max() < 0.06


def _filling_camera(
    target: GridTarget, size: tuple[int, int], fill: float, alpha: float, beta: float, gamma: float, aspect: float
) -> Camera:
    z0, offset = 400.0, np.zeros(2)
    nodes = target.all_points_mm().reshape(-1, 2)
    points = np.concatenate([nodes, np.zeros((len(nodes), 1))], axis=1)
    camera = CAMERA
    for _ in range(25):
        camera = paper_camera(
            gamma,
            alpha_deg=alpha,
            beta_deg=beta,
            size_px=size,
            phd_px=6.0 * size[0],
            z0_mm=z0,
            kappa_per_px2=2e-8,
            aspect=aspect,
            offset_mm=(float(offset[0]), float(offset[1])),
            centre_offset_px=(0.0, 0.0),
        )
        xy = camera.project(points).xy
        extent = float((np.ptp(xy, axis=0) / size).max())
        middle = 0.5 * (xy.max(axis=0) + xy.min(axis=0)) - 0.5 * (np.array(size) - 1.0)
        offset = offset - middle * z0 / (6.0 * size[0])
        z0 *= extent / fill
    return camera


@pytest.mark.parametrize("first", [-4, -3, -1, 0, 2, 5, 8])
def test_lines_before_and_after_those_found_are_numbered_by_the_homography(first: int) -> None:
    pitch = 20.0
    own = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0), indexing="ij"), axis=-1)
    lattice = LineLattice(60.0 + pitch * own + 0.3, np.array([[pitch, 0, 60], [0, pitch, 60], [0, 0, 1]]), 0.0, ())
    grey = np.full((200, 200), 100.0, np.float32)
    picture = LinePicture(grey, np.zeros((200, 200), bool), 1.0, 1.0, 1)
    i, j = np.arange(first, first + 3), np.arange(-2, 2)
    found = SeenLines(picture, grey, lattice, dark_lines=True).nodes(i, j)
    ij = np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1)
    known = (ij >= 0).all(axis=-1) & (ij < [5, 4]).all(axis=-1)
    np.testing.assert_allclose(found, 60.0 + pitch * ij + 0.3 * known[..., None])
