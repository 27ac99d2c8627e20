"""Faults, line 29: a grid that cannot be indexed without doubt is refused with the reason; the accepted is right."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.arrays import Float
from core.cameras.camera import Camera
from core.errors import ImageError, TargetError
from core.grid import GridOptions, GridView, detect_grid
from core.target import GridTarget
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
    yy, xx = np.mgrid[0 : grey.shape[0], 0 : grey.shape[1]]
    m = 1.0 / (1.0 + np.exp(np.clip(np.hypot(xx - x, yy - y) - radius, -50.0, 50.0)))
    return grey * (1.0 - m) + value * m


def _refusal(grey: Float, target: GridTarget = PAPER_TARGET) -> TargetError:
    with pytest.raises(TargetError) as error:
        detect_grid(_digitise(grey), target)
    assert error.value.cause
    assert error.value.remedy
    return error.value


def _accepted(grey: Float, camera: Camera, target: GridTarget = PAPER_TARGET, *, limit_px: float = 0.03) -> GridView:
    view = detect_grid(_digitise(grey), target)
    error = view.xy_px - truth_px(camera, target)
    assert np.abs(error).max() < limit_px
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


def test_much_dirt_is_refused() -> None:
    rng = np.random.default_rng(1)
    grey = _grey(CAMERA)
    for _ in range(150):
        grey = _with_disc(grey, rng.uniform(60, 450), rng.uniform(40, 440), 3.0, 30.0)
    error = _refusal(grey)
    assert error.code == "target_dirty"
    assert error.context["bad"] > 30


def test_glare_is_refused_and_a_glint_does_no_harm() -> None:
    _accepted(_with_disc(_grey(CAMERA), 250.0, 200.0, 6.0, 300.0), CAMERA)
    assert _refusal(_with_disc(_grey(CAMERA), 250.0, 200.0, 60.0, 300.0)).code == "target_glare"
    overexposed = 300.0 - 240.0 * render_cover(CAMERA, PAPER_TARGET)
    assert _refusal(overexposed).code == "target_glare"


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


def test_covered_lines_are_refused() -> None:
    corners = np.array([[-5.4, -5.4, 0.0], [-4.6, -5.4, 0.0], [-4.6, 5.4, 0.0], [-5.4, 5.4, 0.0]])
    xy = FAR.project(corners).xy
    yy, xx = np.mgrid[0:480, 0:512].astype(np.float64)
    inside = np.ones((480, 512), dtype=bool)
    for p, q in zip(xy, np.roll(xy, -1, axis=0), strict=True):
        inside &= (q[0] - p[0]) * (yy - p[1]) - (q[1] - p[1]) * (xx - p[0]) >= 0.0
    assert inside.sum() > 1000
    grey = _grey(FAR)
    grey[inside] = 200.0
    assert _refusal(grey).code == "target_line_count"


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
