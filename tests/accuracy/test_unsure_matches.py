"""Matches that are unsure, not wrong: kept with their uncertainty as far as it can be stated, and named beyond."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter, uniform_filter1d

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.checks.validity import ValidityOptions
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.patch import PatchChoice
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.seeding.image_faults import unsure_error
from stereorig.core.live.measurement import LiveMeasurement, LiveOptions
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.status import PointStatus
from tests.support.relief_parts import calibrated
from tests.support.relief_rig import ReliefCamera, exposed, two_cameras

STRICT = MeasureOptions(subset_px=21, patch="affine", validity=ValidityOptions(max_sigma_px=0.1))


@pytest.fixture(scope="module")
def flat() -> BulgedPanel:
    return BulgedPanel()


@pytest.fixture(scope="module")
def bulged() -> BulgedPanel:
    return BulgedPanel(bulge_mm=0.3)


def blurred(panel, px, camera=2):
    """One camera out of focus at both times."""
    return [gaussian_filter(image, px) if k % 2 == camera - 1 else image for k, image in enumerate(panel.clean)]


@pytest.mark.fault(66)
@pytest.mark.parametrize("camera", [1, 2])
@pytest.mark.parametrize("noise", [2.0, 5.0])
def test_one_camera_blurred_by_two_pixels_keeps_the_field(flat, camera, noise):
    """A limit of 0.1 px on depth emptied it. The panel has some 230 subsets: their rms is known to 5 %."""
    images = blurred(flat, 2.0, camera)
    found = flat.measured(images[:2], noise=noise)
    shape = flat.beside(found)
    motion = flat.beside(flat.measured(images, noise=noise))
    assert (found.status == PointStatus.NOT_CONVERGED).mean() < 0.005
    assert min(shape.valid, motion.valid) > 0.98  # a per cent of the subsets has too little texture
    assert 0.85 < shape.ratio[2] < 1.15
    assert motion.ratio == pytest.approx(1.0, abs=0.2)
    assert max(shape.worst, motion.worst) < 6.0


@pytest.mark.fault(66)
@pytest.mark.parametrize("camera", [1, 2])
@pytest.mark.parametrize("px", [1.0, 1.5])
def test_depth_of_one_blurred_camera_is_reported_as_it_scatters_at_both_times(flat, camera, px):
    """Blocks counted what flows through their inner borders: the depth was reported up to a half too unsure."""
    images = blurred(flat, px, camera)
    shape, field = flat.beside(flat.measured(images[:2])), flat.measured(images)
    assert shape.valid > 0.98
    assert 0.88 < shape.ratio[2] < 1.12
    assert flat.beside(replace(field, uvw_mm=None)).ratio[2] == pytest.approx(shape.ratio[2], rel=0.05)
    whole = field.covariance[field.valid]  # of position and displacement together: that of some errors
    assert np.linalg.eigvalsh(whole / np.trace(whole, axis1=1, axis2=2)[:, None, None]).min() > -1e-9


@pytest.mark.fault(66)
@pytest.mark.parametrize("gain", [1.5, 1.8])
def test_an_exposure_that_rises_until_a_third_is_saturated_keeps_the_field(flat, gain):
    one, two, one_t, two_t = flat.clean
    assert np.mean(gain * one_t > 254) > 0.3
    found = flat.beside(flat.measured([one, two, gain * one_t, gain * two_t]))
    assert found.valid > 0.98
    assert found.ratio == pytest.approx(1.0, abs=0.2)
    assert found.worst < 6.0


def why(flat, images, unsure):
    """Text and remedy of images, reference and current."""
    rng = np.random.default_rng(0)
    taken = [MeasureImage(exposed(image, 2.0, rng)) for image in images]
    region = flat.grid.extent_px
    error = unsure_error(
        "the field", flat.pair, (taken[0], taken[1]), taken[2:], unsure, subset_px=21, region_px=region
    )
    assert error.code == "sigma_too_large"
    return error.cause, error.remedy


@pytest.mark.fault(66)
def test_a_field_too_unsure_is_refused_by_its_own_status_with_figure_cause_and_remedy(flat):
    images = blurred(flat, 2.0)[:2]
    field = flat.measured(images, options=STRICT)  # what was asked for holds
    assert not field.valid.any()
    assert (field.status == PointStatus.SIGMA_TOO_LARGE).mean() > 0.95
    assert 0.1 < field.unsure.usual_px < 0.15
    text, remedy = why(flat, images, field.unsure)
    assert f"{field.unsure.usual_px:.3f} px" in text
    assert "the limit is 0.1 px: camera 2's image is blurred by about 1.9 px against camera 1" in text
    assert re.search(r"take subsets of (39|41|43|45|47) px, which give about 0.0(5\d|6) px, or allow more", remedy)
    assert "--max-sigma 0.3 " in remedy
    text, _ = why(flat, [2.0 * image for image in flat.clean[:2]], field.unsure)
    assert "% of camera 1's image is saturated" in text


@pytest.mark.fault(66)
def test_a_motion_of_whose_usual_point_half_a_pixel_is_less_than_four_sigma_is_refused(flat):
    """A few points were left by chance, and the cause with them."""
    images = [gaussian_filter(image, 2.0) if k in (2, 3) else image for k, image in enumerate(flat.clean)]
    field = flat.measured(images)
    assert not field.valid.any()
    assert (field.status == PointStatus.SIGMA_TOO_LARGE).mean() > 0.9
    assert (
        "camera 1's image is blurred by about 1.9 px against its reference image" in why(flat, images, field.unsure)[0]
    )


@pytest.mark.fault(66)
@pytest.mark.parametrize("camera", [1, 2])
@pytest.mark.parametrize("seed", [0, 1])
def test_one_camera_blurred_by_two_pixels_at_t_keeps_the_field(flat, camera, seed):
    """Depth alone (camera 2), or the plane, is unsure by 0.103 to 0.11 px: a limit of 0.1 px emptied the field."""
    images = [gaussian_filter(image, 2.0) if k == 1 + camera else image for k, image in enumerate(flat.clean)]
    found = flat.beside(flat.measured(images, seed=seed))
    assert found.valid > 0.99
    assert found.ratio == pytest.approx(1.0, abs=0.1)
    assert found.worst < 6.0


@pytest.mark.fault(66)
@pytest.mark.parametrize("high_px", [0.8, 1.3, 1.8])
def test_blur_that_follows_the_height_keeps_the_panel_and_the_uncertainty_of_its_bulge(bulged, high_px):
    """The bulge counted as scatter, so that w was reported twice too wide; points on the crest were lost."""
    images = [gaussian_filter(image, 0.5) for image in bulged.clean[:2]]
    images += [bulged.blur_by_height(k, 0.5, high_px) for k in (2, 3)]
    found = bulged.beside(bulged.measured(images))
    assert found.valid > 0.95
    assert 0.85 < found.ratio[2] < 1.15
    # u and v of one ratio over a field whose blur varies fourfold: a fifth too wide on the rim
    assert np.all((found.ratio > (0.85 if high_px < 1.5 else 0.75)) & (found.ratio < 1.15)), found.ratio
    assert found.worst < 6.0


@pytest.mark.fault(66)
@pytest.mark.parametrize(("cameras", "valid"), [((2, 3), 0.9), ((2,), 0.98), ((3,), 0.97)])
def test_blur_by_height_that_loses_the_crest_is_measured_with_wider_subsets(bulged, cameras, valid):
    """Without them 70 to 77 % were left; what was left of the crest doubled the standard deviation of w."""
    images = [gaussian_filter(image, 0.5) for image in bulged.clean[:2]]
    images += [bulged.blur_by_height(k, 0.5, 2.5 if k in cameras else 0.5) for k in (2, 3)]
    field = bulged.measured(images, options=MeasureOptions(subset_px=21))
    found = bulged.beside(field)
    assert found.valid > valid
    assert 0.75 < found.ratio[2] < 1.15
    assert found.worst < 6.0
    said = re.search(r"subsets of 31 px at (\d+) points", field.patch.reason)
    assert said is not None
    wider = int(said[1]) / field.valid.sum()
    assert wider > 0.1
    # areas' means take the noise that these share with their neighbours from the mean width
    width = SharedPixels.of(field, 21).subset_px
    assert width == pytest.approx(np.sqrt(21**2 + wider * (31**2 - 21**2)), rel=1e-3)
    assert (
        SharedPixels.of(replace(field, patch=PatchChoice.from_document(field.patch.document())), 21).subset_px == width
    )


@pytest.mark.fault(66)
@pytest.mark.parametrize("which", [2, 3])
@pytest.mark.parametrize("subset_px", [21, 33])
def test_blur_of_one_camera_at_t_is_reported_as_it_scatters(flat, which, subset_px):
    """The fit took camera 2's change for noise, and the blocks left a part: up to 1.6 times too wide."""
    images = [gaussian_filter(image, 1.0) if k == which else image for k, image in enumerate(flat.clean)]
    found = flat.beside(flat.measured(images, options=MeasureOptions(subset_px=subset_px, patch="affine")))
    assert found.valid > 0.99
    assert found.ratio == pytest.approx(1.0, abs=0.2)
    assert found.worst < 6.0


@pytest.mark.fault(66)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_smear_as_long_as_the_speckle_leaves_no_point_far_off(flat, seed):
    """The calmest of few differences, calm by chance, passed the others' scatter off as strain in one place."""
    images = [*flat.clean[:2], *(uniform_filter1d(image, 7, axis=1) for image in flat.clean[2:])]
    field = flat.measured(images, options=MeasureOptions(subset_px=21), seed=seed)
    assert not field.valid.any() or flat.beside(field).worst < 6.0


@pytest.mark.fault(66)
@pytest.mark.parametrize("which", [(2,), (3,), (2, 3)])
def test_blur_at_t_alone_keeps_the_field_of_subsets_that_are_sure_in_it(flat, which):
    """Subsets of 33 px: some 90 beside one another, whose rms is known to 8 %."""
    images = [gaussian_filter(image, 2.0) if k in which else image for k, image in enumerate(flat.clean)]
    found = flat.beside(flat.measured(images, options=MeasureOptions(subset_px=33, patch="affine")))
    assert found.valid > 0.99
    assert found.ratio == pytest.approx(1.0, abs=0.2)
    assert found.worst < 6.0


@pytest.mark.fault(66)
@pytest.mark.parametrize(("contrast", "valid"), [(0.14, 0.99), (0.1, 0.95)])
def test_a_faint_texture_keeps_a_shape_that_noise_makes_unsure(flat, contrast, valid):
    """The fit's own limit of 0.1 px emptied it. Here it reports 0.1 px and more, and noise is all that there is."""
    images = [100.0 + contrast * (image - image.mean()) for image in flat.clean[:2]]
    found = flat.beside(flat.measured(images, noise=4.0))
    assert found.valid > valid
    assert found.ratio[2] == pytest.approx(1.0, abs=0.15)
    assert found.worst < 6.0


@pytest.mark.fault(66)
def test_frames_are_followed_where_one_camera_is_blurred(flat):
    """Each frame lost the points that its step had kept; a sure series keeps the limit of a single point."""
    rng = np.random.default_rng(0)
    for px, limit_px in ((2.0, 0.25), (0.0, 0.1)):
        images = blurred(flat, px, 1)
        reference = ReferencePair(flat.pair, *(exposed(image, 2.0, rng) for image in images[:2]))
        options = MeasureOptions(subset_px=21, patch="affine")
        live = LiveMeasurement(reference, flat.grid, options, (), LiveOptions(whole_field=True))
        frames = [live.measure(*(exposed(image, 2.0, rng) for image in images[2:])) for _ in range(3)]
        assert [frame.how for frame in frames] == ["step", "followed", "followed"]
        assert flat.beside(frames[-1].field).valid > 0.98
        assert live._follower._inputs.matcher.options.max_sigma_px == limit_px


@pytest.mark.fault(66)
def test_points_that_left_the_image_are_outside_it_however_far():
    panel = BulgedPanel(shift_mm=(7.0, 0.0))
    field = panel.measured(panel.clean)
    left = field.x_px > panel.size[0] - 190  # 7 mm are some 210 px
    assert (field.status[left] == PointStatus.OUTSIDE_IMAGE).all()
    assert field.valid[:, 0].all()
    assert not (field.status == PointStatus.NOT_SEEDED).any()


@pytest.mark.fault(66)
def test_blur_at_t_is_taken_for_no_localised_strain(flat):
    """Its scatter of the slopes, several times the fit's noise, put quadratic patches everywhere: none converged."""
    images = [*flat.clean[:2], *(gaussian_filter(image, 1.6) for image in flat.clean[2:])]
    found = flat.beside(flat.measured(images, options=MeasureOptions(subset_px=21)))
    assert found.valid > 0.98
    assert found.ratio == pytest.approx(1.0, abs=0.2)


# A speckled panel that bulges towards the cameras between two pictures, by exact rays and a spline of fifth degree.
#
# Nothing of `core` or `sim` makes the pictures; cameras are those of `tests.support.relief_rig`.

Array = NDArray[np.float64]
_KNOT_MM, _KNOTS = 0.012, 2048
_BLUR_STEP_PX = 0.1
_SAMPLES = 2  # a side, of a pixel


@dataclass(frozen=True)
class Beside:
    """A field beside the truth: share of valid points; rms and worst of their errors over the reported sigma."""

    valid: float
    ratio: Array
    worst: float


@dataclass(frozen=True, eq=False)
class BulgedPanel:
    """A panel of 16 x 14 mm that bulges by ``bulge_mm`` and shifts by ``shift_mm``; a pixel is 33 um of it."""

    bulge_mm: float = 0.0
    shift_mm: tuple[float, float] = (0.02, -0.01)
    size: tuple[int, int] = (420, 340)
    speckle_mm: float = 0.16
    spacing_px: int = 14

    @cached_property
    def cameras(self) -> tuple[ReliefCamera, ReliefCamera]:
        """Two cameras, 25 degrees apart."""
        return two_cameras(self.size, f_px=3000.0, standoff_mm=100.0, angle_rad=0.436)

    @cached_property
    def pair(self) -> StereoPair:
        """Their calibration."""
        return calibrated(self.cameras)

    @cached_property
    def grid(self) -> PointGrid:
        """The points."""
        w, h = self.size
        return PointGrid.rectangle(30, 30, w - 30, h - 30, spacing_px=self.spacing_px)

    def _height(self, x: Array, y: Array, moved: bool) -> Array:
        if not moved:
            return np.zeros_like(x)
        along, down = (np.cos(np.pi * np.clip(v / span, -0.5, 0.5)) ** 2 for v, span in ((x, 16.0), (y, 14.0)))
        return np.asarray(-self.bulge_mm * along * down)

    def points(self, camera: ReliefCamera, px: Array, moved: bool) -> Array:
        """(..., 3) mm of the panel at pixels (..., 2)."""
        centre, direction = camera.rays(px)
        t = -centre[2] / direction[..., 2]
        for _ in range(12):
            p = centre + t[..., None] * direction
            t = t + (self._height(p[..., 0], p[..., 1], moved) - p[..., 2]) / direction[..., 2]
        return np.asarray(centre + t[..., None] * direction)

    @cached_property
    def _texture(self) -> Array:
        raw = gaussian_filter(
            np.random.default_rng(0).standard_normal((_KNOTS, _KNOTS)), 0.32 * self.speckle_mm / _KNOT_MM, mode="wrap"
        )
        return np.asarray(spline_filter(0.5 * np.tanh(1.6 * raw / raw.std()) + 0.5, 5, mode="grid-wrap"))

    def _picture(self, camera: ReliefCamera, moved: bool) -> Array:
        w, h = self.size
        y, x = np.mgrid[:h, :w].astype(float)
        out, taps = np.zeros((h, w)), (np.arange(_SAMPLES) - 0.5 * (_SAMPLES - 1)) / _SAMPLES
        for a in taps:
            for b in taps:
                p = self.points(camera, np.stack([x + a, y + b], -1), moved)
                material = p[..., :2] - np.array(self.shift_mm) * moved
                at = material[..., ::-1] / _KNOT_MM + _KNOTS / 2
                out += map_coordinates(
                    self._texture, np.moveaxis(at, -1, 0), order=5, prefilter=False, mode="grid-wrap"
                )
        return 50.0 + 150.0 * out / _SAMPLES**2

    @cached_property
    def clean(self) -> list[Array]:
        """Both cameras at the reference, then both at t, in focus and without noise."""
        return [self._picture(camera, moved) for moved in (False, True) for camera in self.cameras]

    def blur_by_height(self, k: int, low_px: float, high_px: float) -> Array:
        """Picture ``k`` at t, blurred by ``low_px`` on the panel's rim and by ``high_px`` on its crest."""
        w, h = self.size
        y, x = np.mgrid[:h, :w].astype(float)
        height = -self.points(self.cameras[k - 2], np.stack([x, y], -1), True)[..., 2] / self.bulge_mm
        level = (low_px + (high_px - low_px) * height) / _BLUR_STEP_PX
        stack = np.stack([gaussian_filter(self.clean[k], _BLUR_STEP_PX * i) for i in range(int(level.max()) + 2)])
        below = level.astype(int)
        rows, cols = np.indices(level.shape)
        share = level - below
        return np.asarray((1.0 - share) * stack[below, rows, cols] + share * stack[below + 1, rows, cols])

    def measured(
        self, images: list[Array], *, noise: float = 2.0, seed: int = 0, options: MeasureOptions | None = None
    ) -> Field:
        """The field of two pictures (a shape) or four, with noise."""
        rng = np.random.default_rng(seed)
        taken = [exposed(image, noise, rng) for image in images]
        options = options or MeasureOptions(subset_px=21, patch="affine")
        pair = ReferencePair(self.pair, *taken[:2])
        return pair.shape(self.grid, options) if len(taken) == 2 else pair.motion(*taken[2:], self.grid, options)

    def beside(self, field: Field) -> Beside:
        """A field beside the truth."""
        xyz = self.points(self.cameras[0], self.grid.xy_px, False)
        true, found, sigma = xyz, field.xyz_mm, field.sigma_mm[..., :3]
        if field.uvw_mm is not None:
            u, v = self.shift_mm
            w = self._height(xyz[..., 0] + u, xyz[..., 1] + v, True)
            true, found, sigma = np.stack([np.full_like(w, u), np.full_like(w, v), w], -1), field.uvw_mm, sigma
            sigma = field.sigma_mm[..., 3:]
        valid = field.valid
        off = (found - true)[valid] / sigma[valid]
        return Beside(float(valid.mean()), np.sqrt((off**2).mean(axis=0)), float(np.abs(off).max(initial=0.0)))
