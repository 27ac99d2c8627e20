"""A live measurement in a process of its own: the reference once, then frame after frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import StateError
from stereorig.core.field.points.images import MeasureImage, check_calibrated_size
from stereorig.core.field.region.lay_points import make_grid, points_inside
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.live.gauges import LiveGauge, status_counts
from stereorig.core.live.measurement import LiveFrame, LiveMeasurement, LiveOptions
from stereorig.core.measure import ReferencePair
from stereorig.core.names import CAMERAS
from stereorig.core.settings import Outline
from stereorig.server.base.priority import settle
from stereorig.server.compute.tasks import LiveTask, Plain
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.calibrations.volume import parameter_covariance, volume_of
from stereorig.server.formats.images import read_image
from stereorig.server.formats.noise_json import load_noise

_running: LiveMeasurement | None = None
_whole = False


def begin(task: LiveTask) -> Plain:
    """Measure the reference, in place of the live measurement before.

    Raises
    ------
    StereorigError
        As an analysis' reference.
    """
    global _running, _whole
    _running, _whole = None, task.whole_field
    loaded = load_calibration(task.calibration)
    models = (None, None) if task.noise is None else load_noise(task.noise).models
    options = MeasureOptions.of(task.settings)
    images = []
    for k, (path, model) in enumerate(zip(task.reference.files, models, strict=True)):
        pixels = read_image(path)
        size = (loaded.image_size1_px, loaded.image_size2_px)[k]
        check_calibrated_size(f"The image of {CAMERAS[k]}", pixels.shape, size)
        noise = None if model is None else model.averaged(*task.reference.averages)
        images.append(MeasureImage(pixels, str(path), noise=noise))
    grid = make_grid(task.settings, None, images[0].shape)
    gauges = [_gauge(given, grid.x_px, grid.y_px) for given in task.gauges]
    _running = LiveMeasurement(
        ReferencePair(loaded.pair, *images),
        grid,
        options,
        gauges,
        LiveOptions(audit_every=task.audit_every, whole_field=task.whole_field),
        reference_update=task.settings.reference_update,
        noise=models,
        source=parameter_covariance(loaded),
        volume=volume_of(loaded),
    )
    settle()  # it lasts as long as the process: the collector's round after each frame leaves it out
    shape = _running.shape
    return {
        "points": int(shape.valid.sum()),
        "status": status_counts(shape),
        "field": _grid_of(shape.x_px, shape.y_px) if task.whole_field else None,
    }


def measure(pixels: tuple[Any, Any], time_s: float) -> Plain:
    """Measure a frame, exposed at a time.

    Raises
    ------
    StateError
        ``live_ended`` if none was begun in this process.
    StereorigError
        The frame is refused; the next one can follow.
    """
    if _running is None:
        raise StateError("No live measurement was begun here.", code="live_ended", remedy="Begin it again.")
    return _plain(_running.measure(*pixels, time_s))


def _gauge(given: Plain, x_px: Float, y_px: Float) -> LiveGauge:
    if given["kind"] != "area":
        return LiveGauge(given["name"], given["kind"], ends_px=np.array(given["ends_px"], dtype=np.float64))
    inside = points_inside(Outline.model_validate(given["outline"]), x_px, y_px)
    return LiveGauge(given["name"], "area", inside=inside)


def _plain(frame: LiveFrame) -> Plain:
    gauges = {
        name: {
            "missing": gauge.missing,
            "values": {
                q: (r.value, r.sigma, r.sigma_calibration, r.budget.document()) for q, r in gauge.values.items()
            },
        }
        for name, gauge in frame.readings.items()
    }
    found: Plain = {
        "how": frame.how,
        "points": int(frame.field.valid.sum()),
        "status": status_counts(frame.field),
        "gauges": gauges,
    }
    if _whole and frame.field.uvw_mm is not None:
        # float32 keeps five digits and more, and a picture shows some hundred colours
        found["field"] = frame.field.uvw_mm.astype(np.float32)
    return found


def _grid_of(x_px: Float, y_px: Float) -> Plain:
    return {"x_px": x_px[0].tolist(), "y_px": y_px[:, 0].tolist()}
