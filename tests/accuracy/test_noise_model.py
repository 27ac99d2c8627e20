"""The noise model against the simulated sensor's own numbers, and against scenes that move."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import fourier_shift, gaussian_filter

from stereorig.core.errors import ImageError, InputError
from stereorig.core.noise import NoiseModel, measure_noise, rows_looked_at
from stereorig.sim.sensor import Sensor

SENSORS = {
    "read noise rules, 8 bit": Sensor(),
    "shot noise rules, 12 bit": Sensor(bit_depth=12, full_well_e=10500.0, read_noise_e=2.4),
    "shot noise, 8 bit": Sensor(full_well_e=1200.0, read_noise_e=8.0),
}


def scene(shape=(300, 320), seed=0):
    base = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.0)
    base = 0.45 + 0.16 * base / base.std()
    return np.clip(base, 0.03, 0.9)


def true_variance(sensor, grey):
    # rounding to whole grey levels adds a twelfth
    return sensor.noise_sd(np.asarray(grey) / sensor.full_scale) ** 2 + 1.0 / 12.0


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("frames", [2, 8])
def test_variance_is_the_sensors(name, frames):
    sensor, rng = SENSORS[name], np.random.default_rng(3)
    model = measure_noise([sensor.expose(scene(), rng) for _ in range(frames)])
    grey = np.linspace(0.1, 0.85, 8) * sensor.full_scale
    # two frames leave noise in the level that sorts a pixel
    np.testing.assert_allclose(model.variance(grey), true_variance(sensor, grey), rtol=0.05 if frames == 2 else 0.03)
    assert model.frames == frames
    assert model.misfit < 1.6
    assert abs(model.excess) < 0.05


def test_stated_uncertainty_is_that_of_many_measurements():
    sensor, bright = SENSORS["shot noise, 8 bit"], scene((120, 120))
    rng = np.random.default_rng(8)
    models = [measure_noise([sensor.expose(bright, rng) for _ in range(4)]) for _ in range(60)]
    c = np.array([m.coefficients[:2] for m in models])
    sd = np.array([m.coefficients_sd[:2] for m in models])
    np.testing.assert_allclose(np.sqrt((sd**2).mean(axis=0)), c.std(axis=0), rtol=0.35)
    expected = true_variance(sensor, np.array([0.0, 100.0]))
    slope = (expected[1] - expected[0]) / 100.0
    assert abs(c[:, 1].mean() - slope) < 4 * c[:, 1].std() / np.sqrt(60) + 0.01 * slope


def test_drifting_light_and_a_shaking_stand_are_taken_out():
    sensor, rng, bright = SENSORS["read noise rules, 8 bit"], np.random.default_rng(4), scene()
    spectrum = np.fft.fft2(bright)
    frames = []
    for k in range(6):
        moved = np.fft.ifft2(fourier_shift(spectrum, rng.normal(0.0, 0.02, 2))).real
        frames.append(sensor.expose(moved * (1.0 + 0.004 * k), rng))
    model = measure_noise(frames)
    grey = np.linspace(40, 200, 6)
    np.testing.assert_allclose(model.variance(grey), true_variance(sensor, grey), rtol=0.05)
    assert 0.003 < model.drift < 0.006
    assert 0.01 < model.shift_px < 0.1


def test_saturated_pixels_do_not_lower_the_variance():
    sensor, rng = SENSORS["read noise rules, 8 bit"], np.random.default_rng(4)
    bright = np.clip(scene() * 1.6 - 0.2, 0.0, 1.2)
    model = measure_noise([sensor.expose(bright, rng) for _ in range(6)])
    grey = np.linspace(30, 235, 6)
    np.testing.assert_allclose(model.variance(grey), true_variance(sensor, grey), rtol=0.06)


def test_a_fly_does_not_count_and_a_turning_specimen_is_refused():
    sensor, rng, bright = SENSORS["read noise rules, 8 bit"], np.random.default_rng(4), scene()
    frames = [sensor.expose(bright, rng) for _ in range(5)]
    frames[2][100:130, 50:80] = 10
    model = measure_noise(frames)
    np.testing.assert_allclose(model.variance([60, 180]), true_variance(sensor, [60, 180]), rtol=0.08)
    y, x = np.mgrid[: bright.shape[0], : bright.shape[1]]
    gy, gx = np.gradient(bright)
    turn = 1e-3 * (gx * (y - 150) - gy * (x - 160))  # a milliradian about the middle: no shift on the whole
    with pytest.raises(ImageError) as error:
        measure_noise([sensor.expose(bright + k % 2 * turn, rng) for k in range(4)])
    assert error.value.code == "frames_not_static"
    shifted = np.roll(bright, 1, axis=1)
    with pytest.raises(ImageError) as error:
        measure_noise([sensor.expose(b, rng) for b in (bright, shifted)])
    assert error.value.code == "frames_not_static"


def test_one_grey_level_gives_one_variance():
    sensor, rng = SENSORS["shot noise rules, 12 bit"], np.random.default_rng(1)
    model = measure_noise([sensor.expose(np.full((128, 128), 0.5), rng) for _ in range(5)])
    np.testing.assert_allclose(model.variance([0.0, 2048.0, 4095.0]), true_variance(sensor, 2047.5), rtol=0.05)


def test_large_frames_are_looked_at_in_part():
    sensor, rng = SENSORS["shot noise rules, 12 bit"], np.random.default_rng(1)
    bright = np.tile(scene((100, 320)), (24, 1))
    frames = [sensor.expose(bright, rng) for _ in range(3)]
    rows = rows_looked_at(frames[0].shape)
    assert frames[0][rows].size < frames[0].size
    whole, part = measure_noise(frames), measure_noise([f[rows] for f in frames])
    assert whole.coefficients == part.coefficients
    np.testing.assert_allclose(whole.variance([800.0, 3000.0]), true_variance(sensor, [800.0, 3000.0]), rtol=0.04)


def test_means_of_frames_have_less_noise():
    model = NoiseModel(coefficients=(4.0, 0.1, 0.001), range_grey=(0.0, 255.0))
    mean = model.averaged(4, 64.0)
    np.testing.assert_allclose(mean.variance(64.0 * np.array([10.0, 200.0])), 1024.0 * model.variance([10.0, 200.0]))


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda f: f[:1], "too_few_frames"),
        (lambda f: [f[0], f[0]], "frames_identical"),
        (lambda f: [f[0], f[1][:-2]], "image_size_mismatch"),
        (lambda f: [f[0].astype(complex), f[1]], "image_type"),
        (lambda f: [np.where(f[0] > 90, np.nan, f[0]), f[1]], "image_not_finite"),
        (
            lambda f: [np.where(i > k, 255, 0).astype(np.uint8) for k, i in zip((3, 4), f, strict=True)],
            "image_saturated",
        ),
    ],
)
def test_what_cannot_be_measured_is_refused(make, code):
    rng = np.random.default_rng(1)
    frames = [SENSORS["read noise rules, 8 bit"].expose(scene((60, 60)), rng) for _ in range(2)]
    with pytest.raises((InputError, ImageError)) as error:
        measure_noise(make(frames))
    assert error.value.code == code


def test_a_model_of_negative_variance_is_refused():
    with pytest.raises(InputError):
        NoiseModel(coefficients=(-5.0, 0.1, 0.0), range_grey=(0.0, 255.0))
