"""Live measurement: frames followed as a step would measure them, gauges as elsewhere, clocks of channels."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from stereorig.core.common.factor import ParameterCovariance
from stereorig.core.errors import ImageError, InputError, MeasurementError, RegionError
from stereorig.core.field.common import with_common_parts
from stereorig.core.field.growth.grow import fit_in_batches
from stereorig.core.field.growth.state import prepare
from stereorig.core.field.points.assemble import assemble
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.area import area_statistics
from stereorig.core.gauge.extensometer import extensometer
from stereorig.core.gauge.sampling import sample
from stereorig.core.live.clocks import clock_offset, value_at
from stereorig.core.live.follow import Follower
from stereorig.core.live.gauges import GaugeSet, LiveGauge
from stereorig.core.live.measurement import LiveMeasurement, LiveOptions
from stereorig.core.measure import ReferencePair
from stereorig.core.names import UNITS
from tests.support.gauge_field import SUBSET, make_field
from tests.support.sequence_bench import GRID, OPTIONS, capture, plate, rig

STRETCH = np.array([[1.002, 0.0], [0.0, 0.9994]])
ENDS = np.array([[220.0, 200.0], [300.0, 280.0]])
INSIDE = (GRID.x_px >= 200) & (GRID.x_px <= 320) & (GRID.y_px >= 190) & (GRID.y_px <= 290)
GAUGES = (
    LiveGauge("e1", "extensometer", ends_px=ENDS),
    LiveGauge("a1", "area", inside=INSIDE),
    LiveGauge("p1", "point", ends_px=ENDS[:1]),
)


# gauges ---------------------------------------------------------------------------------------------------------


def stretched(x: np.ndarray) -> np.ndarray:
    return x @ np.diag([1.003, 0.999, 1.0]) + np.array([0.1, -0.2, 0.05])


def test_gauges_read_what_those_of_one_field_read() -> None:
    field = make_field(stretched, rows=12, cols=14)
    x, y = field.x_px, field.y_px
    ends = np.array([[x[0, 3] + 2.3, y[3, 0] + 1.1], [x[0, 10] + 0.7, y[8, 0] + 2.9]])
    inside = (x >= x[0, 2]) & (x <= x[0, 9]) & (y >= y[2, 0]) & (y <= y[9, 0])
    shared = SharedPixels.of(field, SUBSET)
    gauges = (
        LiveGauge("e", "extensometer", ends_px=ends),
        LiveGauge("p", "point", ends_px=ends[:1]),
        LiveGauge("a", "area", inside=inside),
    )
    found = GaugeSet(gauges, SUBSET, field).read(field)
    one = extensometer(field, ends[0], ends[1], shared=shared)
    for name in UNITS["extensometer"]:
        value, sigma = found["e"].values[name][:2]
        assert value == pytest.approx(getattr(one, name).value, abs=1e-12)
        assert sigma == pytest.approx(getattr(one, name).sigma, rel=1e-9)
    at = sample(field, ends[:1])
    variance = np.diagonal(at.covariance(shared, [0], [0])[0])[3:]
    assert field.uvw_mm is not None
    for k, name in enumerate(UNITS["point"]):
        assert found["p"].values[name].value == pytest.approx(at.of(field.uvw_mm)[0, k], abs=1e-12)
        assert found["p"].values[name].sigma == pytest.approx(np.sqrt(variance[k]), rel=1e-9)
    for k, name in enumerate(("u_mm", "v_mm", "w_mm")):
        sigma = np.sqrt(field.covariance[..., 3 + k, 3 + k])
        mean = area_statistics(field, field.uvw_mm[..., k], sigma, inside, shared=shared)
        assert found["a"].values[name].value == pytest.approx(mean.mean, abs=1e-12)
        # the roots of whole covariances, there of one component's variance: they differ by the points' unequal noise
        assert found["a"].values[name].sigma == pytest.approx(mean.mean_sigma, rel=0.05)


def test_an_area_reads_the_strain_of_a_uniform_stretch() -> None:
    def plane(x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        x, y = 0.02 * (x_px - 100.0), 0.02 * (y_px - 80.0)
        return np.stack([x, y, 0.05 * x - 0.1 * y], axis=-1)

    field = make_field(stretched, rows=12, cols=14, shape=plane)
    found = GaugeSet((LiveGauge("a", "area", inside=np.ones(field.shape, bool)),), SUBSET, field).read(field)
    values = found["a"].values
    # Green-Lagrange on a plane with the tangents (1, 0, 0.05) and (0, 1, -0.1): e_ab = t_a . E t_b over the metric
    E = 0.5 * (np.diag([1.003**2, 0.999**2, 1.0]) - np.eye(3))
    T = np.linalg.qr(np.array([[1.0, 0.0], [0.0, 1.0], [0.05, -0.1]]))[0]
    truth = T.T @ E @ T
    seen = np.array([[values["exx"].value, values["exy"].value], [values["exy"].value, values["eyy"].value]])
    # whatever the axes in the plane are
    assert np.trace(seen) == pytest.approx(np.trace(truth), rel=1e-9)
    assert np.linalg.det(seen) == pytest.approx(np.linalg.det(truth), rel=1e-9)


def test_a_gauge_names_what_it_lacks() -> None:
    field = make_field(stretched, rows=12, cols=14)
    inside = np.zeros(field.shape, bool)
    inside[2:8, 2:8] = True
    gauges = (
        LiveGauge("a", "area", inside=inside),
        LiveGauge("p", "point", ends_px=np.array([[field.x_px[4, 4], field.y_px[4, 4]]])),
    )
    both = GaugeSet(gauges, SUBSET, field)
    assert not both.read(field)["a"].missing
    status = field.status.copy()
    status[2:6, 2:8] = 3
    found = both.read(replace(field, status=status))
    assert found["a"].missing == "occluded"
    assert found["p"].missing
    assert not found["p"].values


def test_a_gauge_off_the_region_is_refused() -> None:
    far = LiveGauge("far", "point", ends_px=np.array([[20.0, 20.0]]))
    with pytest.raises(RegionError, match="far"):
        far.points(GRID.x_px, GRID.y_px, GRID.spacing_px)


# frames ---------------------------------------------------------------------------------------------------------


@cache
def pictures() -> list[list[np.ndarray]]:
    """A reference, and frames of a plate that is stretched and moves by half a pixel from frame to frame."""
    at = [plate(shift_mm=(0.02 * k, 0.01 * k, 0.0), in_plane=np.eye(2) + (STRETCH - np.eye(2)) * k) for k in range(5)]
    return [capture(scene, seed) for seed, scene in enumerate(at)]


def reference() -> ReferencePair:
    return ReferencePair(rig().pair, *(MeasureImage(image) for image in pictures()[0]))


def test_a_followed_frame_is_what_the_step_would_be() -> None:
    live = LiveMeasurement(reference(), GRID, OPTIONS, GAUGES, LiveOptions(whole_field=True))
    frames = [live.measure(*pair) for pair in pictures()[1:]]
    assert [frame.how for frame in frames] == ["step", "followed", "followed", "followed"]
    pair = reference()
    shape = pair.shape(GRID, OPTIONS)
    step = pair.motion(*(MeasureImage(image) for image in pictures()[-1]), GRID, OPTIONS, shape=shape)
    last = frames[-1].field
    assert last.uvw_mm is not None
    assert step.uvw_mm is not None
    both = last.valid & step.valid
    assert both.sum() == step.valid.sum()
    sigma = step.sigma_mm[both][:, 3:]
    # the demand on what is measured live: 2 % of a standard uncertainty
    assert np.sqrt(np.mean(((last.uvw_mm - step.uvw_mm)[both] / sigma) ** 2)) < 0.02
    assert np.median(last.sigma_mm[both][:, 3:] / sigma) == pytest.approx(1.0, abs=0.1)
    ordinary = GaugeSet(GAUGES, OPTIONS.subset_px, shape).read(step)
    for name, gauge in ordinary.items():
        for quantity, reading in gauge.values.items():
            seen = frames[-1].readings[name].values[quantity]
            assert abs(seen.value - reading.value) < 0.02 * reading.sigma
            assert seen.sigma == pytest.approx(reading.sigma, rel=0.1)


def fitted_by_itself(images: tuple[MeasureImage, MeasureImage], previous: Field, shape: Field) -> Field:
    """The frame by the parts that a field of any kind is measured with, from the points of another frame."""
    pair = reference()
    inputs = prepare(pair.pair, (pair.image1, pair.image2), images, GRID, OPTIONS).on_shape(shape, previous)
    assert previous.starts is not None
    assert previous.starts.G is not None
    n, points = len(inputs.xy_px), inputs.matcher.empty(len(inputs.xy_px))
    w, G = previous.starts.w.reshape(n, 3), previous.starts.G.reshape(n, 3, 3)
    index = np.flatnonzero(inputs.usable & previous.valid.ravel())
    fit_in_batches(inputs.matcher, points, index, inputs.xy_px, w[index], G[index], far_px=3.0)
    return assemble(points, pair=pair.pair, grid=inputs.grid, fits_image=inputs.fits_image, shape=shape)


def test_a_followed_frame_is_converted_as_a_field_is() -> None:
    pair = reference()
    shape = pair.shape(GRID, OPTIONS)
    before, now = (tuple(MeasureImage(image) for image in pictures()[k]) for k in (1, 2))
    first = pair.motion(*before, GRID, OPTIONS, shape=shape)
    followed = Follower(pair, shape, GRID, OPTIONS).measure(now, first, None, np.ones((*GRID.shape, 6)), None)
    truth = fitted_by_itself(now, first, shape)
    assert 0.0 < followed.rate < 0.1
    both = truth.valid & followed.field.valid
    assert both.sum() == truth.valid.sum()
    sigma = truth.sigma_mm[both][:, 3:]
    assert followed.field.uvw_mm is not None
    assert truth.uvw_mm is not None
    off = (followed.field.uvw_mm - truth.uvw_mm)[both] / sigma
    assert np.sqrt(np.mean(off**2)) < 0.02
    # the normal equations are those of a start a twentieth of a pixel away
    units = truth.sigma_mm[both]
    off = (followed.field.covariance[both] - truth.covariance[both]) / (units[:, :, None] * units[:, None, :])
    assert np.abs(off).max() < 0.01
    np.testing.assert_allclose(followed.field.zncc[both], truth.zncc[both], atol=1e-3)


def test_a_frame_that_jumped_is_fitted_until_it_settles() -> None:
    live = LiveMeasurement(reference(), GRID, OPTIONS, (), LiveOptions())
    for k in (1, 2, 1, 2):  # back and forth by half a pixel: the velocity is wrong each time
        frame = live.measure(*pictures()[k])
    assert frame.how == "followed"
    pair = reference()
    step = pair.motion(*(MeasureImage(image) for image in pictures()[2]), GRID, OPTIONS)
    assert step.uvw_mm is not None
    assert frame.field.uvw_mm is not None
    off = (frame.field.uvw_mm - step.uvw_mm) / step.sigma_mm[..., 3:]
    assert np.sqrt(np.nanmean(off**2)) < 0.02


def test_after_skipped_frames_points_start_further_on() -> None:
    live = LiveMeasurement(reference(), GRID, OPTIONS, (), LiveOptions())
    at_rest = capture(plate(), 9)
    for k in (0, 1, 2, 4):
        frame = live.measure(*(pictures()[k] if k else at_rest), 0.02 * k)
    assert frame.how == "followed"
    # one step is enough where the plate moves evenly in time, though twice as far as before
    assert np.mean(frame.field.iterations[frame.field.valid] == 1) > 0.9


def test_the_calibrations_part_is_in_the_readings() -> None:
    source = ParameterCovariance(rig().pair, ("cam1.phd_px",), np.array([[4.0]]))
    live = LiveMeasurement(reference(), GRID, OPTIONS, GAUGES, source=source)
    reading = live.measure(*pictures()[2]).readings["e1"].values["length_mm"]
    pair = reference()
    shape = pair.shape(GRID, OPTIONS)
    step = pair.motion(*(MeasureImage(image) for image in pictures()[2]), GRID, OPTIONS, shape=shape)
    whole = with_common_parts(step, source, rig().pair)
    truth = extensometer(whole, *ENDS, shared=SharedPixels.of(whole, OPTIONS.subset_px)).length_mm
    assert reading.sigma_calibration == pytest.approx(truth.sigma_calibration, rel=0.01)
    assert reading.sigma == pytest.approx(truth.sigma, rel=0.01)


def test_only_points_that_gauges_need_are_measured() -> None:
    live = LiveMeasurement(reference(), GRID, OPTIONS, GAUGES[2:])
    frame = live.measure(*pictures()[1])
    assert 0 < frame.field.valid.sum() <= 25
    assert not frame.readings["p1"].missing


def test_an_occluded_gauge_is_named_and_comes_back() -> None:
    live = LiveMeasurement(reference(), GRID, OPTIONS, GAUGES, LiveOptions(whole_field=True, retry_every=1))
    live.measure(*pictures()[1])
    one, two = (image.copy() for image in pictures()[2])
    rng = np.random.default_rng(5)
    one[:, :270] = rng.normal(60.0, 3.0, one[:, :270].shape).astype(np.uint8)
    hidden = live.measure(one, two)
    assert hidden.readings["e1"].missing
    assert not hidden.readings["e1"].values
    seen = live.measure(*pictures()[3])
    assert not seen.readings["e1"].missing
    assert seen.readings["e1"].values["strain"].value == pytest.approx(0.0006 * 3, abs=0.003)


def test_a_frame_that_cannot_be_used_leaves_the_measurement_as_it_was() -> None:
    live = LiveMeasurement(reference(), GRID, OPTIONS, GAUGES)
    live.measure(*pictures()[1])
    one, _ = pictures()[2]
    with pytest.raises(ImageError, match="grey level"):
        live.measure(one, np.full_like(one, 90))
    with pytest.raises(ImageError, match="same image"):
        live.measure(one, one)
    assert live.measure(*pictures()[2]).number == 2


def test_later_references_are_taken_live_as_in_a_sequence() -> None:
    live = LiveMeasurement(reference(), GRID, OPTIONS, GAUGES, reference_update="always")
    frames = [live.measure(*pair) for pair in pictures()[1:4]]
    assert [frame.how for frame in frames] == ["step"] * 3
    references = [frame.field.references for frame in frames]
    assert [None if one is None else one.step for one in references] == [None, 1, 2]
    pair = reference()
    shape = pair.shape(GRID, OPTIONS)
    step = pair.motion(*(MeasureImage(image) for image in pictures()[3]), GRID, OPTIONS, shape=shape)
    assert step.uvw_mm is not None
    assert frames[-1].field.uvw_mm is not None
    off = (frames[-1].field.uvw_mm - step.uvw_mm) / frames[-1].field.sigma_mm[..., 3:]
    # totals over two later references: other noise, of the same size
    assert np.nanmedian(np.abs(off)) < 2.0


# clocks ---------------------------------------------------------------------------------------------------------


def test_a_channel_is_read_between_its_readings_and_not_over_a_gap() -> None:
    t, y = [0.0, 0.1, 0.2, 1.0], [0.0, 10.0, 20.0, 100.0]
    assert value_at(t, y, 0.15, 0.3) == pytest.approx(15.0)
    assert value_at(t, y, 0.1, 0.3) == 10.0
    assert np.isnan(value_at(t, y, 0.5, 0.3))
    assert np.isnan(value_at(t, y, 1.01, 5.0))
    assert np.isnan(value_at([], [], 0.0, 1.0))


def knock(t: np.ndarray) -> np.ndarray:
    ringing = np.exp(-(t - 2.0) / 0.15) * np.sin(2 * np.pi * 6.0 * (t - 2.0))
    return np.where(t > 2.0, ringing, 0.0)


def ramp(t: np.ndarray) -> np.ndarray:
    return np.clip(t - 1.5, 0.0, 2.0)


@pytest.mark.parametrize("motion", [knock, ramp])
@pytest.mark.parametrize(("channel_hz", "gauge_hz"), [(1000.0, 50.0), (20.0, 50.0), (40.0, 90.0)])
def test_the_clocks_offset_is_found_within_its_uncertainty(motion, channel_hz: float, gauge_hz: float) -> None:
    if motion is knock and channel_hz < 50.0:
        pytest.skip("a knock of 6 Hz is not resolved by 20 readings a second on lines between them")
    truth, errors, stated = 0.137, [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        gauge_s = np.arange(0.0, 5.0, 1.0 / gauge_hz)
        true_s = np.arange(0.3, 4.8, 1.0 / channel_hz)
        channel = 3.0 * motion(true_s) + 1.0 + 0.003 * rng.normal(size=true_s.size)
        gauge = motion(gauge_s) + 0.01 * rng.normal(size=gauge_s.size)
        found = clock_offset(true_s - truth, channel, gauge_s, gauge)
        errors.append(found.offset_s - truth)
        stated.append(found.u_s)
        assert found.gain == pytest.approx(1 / 3.0, rel=0.1)
    # 40 draws: their root mean square is known to 11 %
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) / np.median(stated) < 1.6


def test_a_straight_line_has_no_offset() -> None:
    t = np.arange(0.0, 5.0, 0.02)
    rng = np.random.default_rng(1)
    with pytest.raises(MeasurementError, match="not determined"):
        clock_offset(t, t, t, t)
    with pytest.raises(MeasurementError, match="not determined"):
        clock_offset(t, rng.normal(size=t.size), t, 0.0 * t)


def test_readings_out_of_order_are_refused() -> None:
    t = np.arange(10.0)
    with pytest.raises(InputError, match="in order"):
        clock_offset(t[::-1], t, t, t)
    with pytest.raises(InputError, match="readings"):
        clock_offset(t[:3], t[:3], t, t)
