"""The hardware parameters: the reporting tables of the iDICs Good Practices Guide (2018), and some more."""

from __future__ import annotations

import statistics
from typing import Literal

import numpy as np

from stereorig.core.calibration.checks.measures import focal_lengths_px
from stereorig.core.names import CAMERAS, CameraName
from stereorig.core.pattern import PatternSize, pattern_size
from stereorig.server.config.camera_metadata import CameraMetadata, LensMetadata, merged
from stereorig.server.documents.steps import CameraRecord
from stereorig.server.formats.calibrations.record import RecordedCamera
from stereorig.server.report.geometry import Geometry, View
from stereorig.server.report.items import (
    CALIBRATION,
    MEASURED,
    METADATA_FORM,
    RECORD,
    STATED,
    Item,
    Value,
    each,
    of_number,
    of_text,
    one,
)
from stereorig.server.report.source import Source
from stereorig.server.report.steps import MeasuredSteps

_RIG_FILE = f"the rig file or {METADATA_FORM}"
_IN_FILE = "as stated (test or rig file)"
_BY_SERVICE = "is recorded when the service captures"
_NEEDS_CALIBRATION = "needs the calibration that the results were measured with (--calibration)"


def hardware(source: Source, measured: MeasuredSteps, found: Geometry | None) -> list[Item]:
    """Return the hardware parameters."""
    cameras = {}
    for cam in CAMERAS:
        recorded = source.rig.cameras.get(cam, CameraRecord())
        cameras[cam] = merged(source.metadata.camera(cam), recorded.plain())
    return [
        *_camera_items(source, cameras),
        *_lens_items(source, cameras),
        *_geometry_items(source, found),
        *_recording_items(source, measured),
        *_pattern(source, measured, found),
        Item(
            "noise",
            "Noise of the images",
            _noise(source, measured),
            "needs a noise model (stereorig noise) or points that were measured",
            "standard deviation in grey levels",
        ),
    ]


def _camera_items(source: Source, cameras: dict[CameraName, CameraMetadata]) -> list[Item]:
    step, sizes = source.reference_step, _sizes(source)
    identity = step.cameras or {}
    if not identity and source.calibration is not None:
        identity = source.calibration.record.provenance.cameras

    def device(cam: CameraName, name: Literal["model", "serial"]) -> Value | None:
        return of_text(getattr(identity.get(cam, RecordedCamera()), name), "from the camera itself")

    def recorded_text(name: Literal["maker", "model", "sensor"], cam: CameraName) -> Value | None:
        return of_text(getattr(cameras[cam], name), _IN_FILE)

    def size(cam: CameraName) -> Value | None:
        found = sizes[cam]
        return None if found is None else Value(f"{found[0][0]} x {found[0][1]} px", None, found[1])

    return [
        each("camera.maker", "Camera, maker", lambda cam: recorded_text("maker", cam), f"camN.maker of {_RIG_FILE}"),
        each(
            "camera.model",
            "Camera, model",
            lambda cam: device(cam, "model") or recorded_text("model", cam),
            f"camN.model of {METADATA_FORM}",
        ),
        each("camera.serial", "Camera, serial number", lambda cam: device(cam, "serial"), _BY_SERVICE),
        each("camera.resolution", "Image size", size, "needs the images or the calibration"),
        each(
            "camera.depth",
            "Significant bits",
            lambda cam: of_number((step.bit_depth or {}).get(cam), "d", "bit", RECORD),
            f"{_BY_SERVICE} or imports",
        ),
        each("camera.sensor", "Sensor", lambda cam: recorded_text("sensor", cam), f"camN.sensor of {_RIG_FILE}"),
        each(
            "camera.pixel",
            "Pixel size",
            lambda cam: of_number(cameras[cam].pixel_um, "g", "\u00b5m", _IN_FILE),
            f"camN.pixel_um of {_RIG_FILE}",
        ),
    ]


def _lens_items(source: Source, cameras: dict[CameraName, CameraMetadata]) -> list[Item]:
    nothing = LensMetadata.model_validate({})
    lenses = {cam: camera.lens or nothing for cam, camera in cameras.items()}
    where = f"in [camN.lens] of {_RIG_FILE}"

    def aperture(cam: CameraName) -> Value | None:
        number = lenses[cam].f_number
        return None if number is None else Value(f"f/{number:g}", number, _IN_FILE)

    def pinhole(cam: CameraName) -> Value | None:
        if source.calibration is None:
            return None
        lens, pixel = getattr(source.calibration.pair, cam).lens, cameras[cam].pixel_um
        phd = focal_lengths_px(lens)[0]
        mm = "" if pixel is None else f" = {phd * pixel / 1000.0:.2f} mm"
        return Value(f"{phd:.1f} px{mm}", phd, CALIBRATION)

    items = [
        each("lens.maker", "Lens, maker", lambda cam: of_text(lenses[cam].maker, _IN_FILE), f"maker {where}"),
        each("lens.model", "Lens, model", lambda cam: of_text(lenses[cam].model, _IN_FILE), f"model {where}"),
        each(
            "lens.focal_length",
            "Lens, focal length",
            lambda cam: of_number(lenses[cam].focal_length_mm, "g", "mm", _IN_FILE),
            f"focal_length_mm {where}",
        ),
        each("lens.aperture", "Lens, aperture", aperture, f"f_number {where}"),
    ]
    if any(lens.note for lens in lenses.values()):  # most lenses have none: then the item is not listed as missing
        note = "Lens, accessories"
        items.append(each("lens.note", note, lambda cam: of_text(lenses[cam].note, _IN_FILE) or Value("none stated")))
    remark = "of the fitted camera; longer than the focal length, since the lens is focused near"
    return [*items, each("lens.pinhole", "Pinhole distance", pinhole, _NEEDS_CALIBRATION, remark)]


def _geometry_items(source: Source, found: Geometry | None) -> list[Item]:
    views: dict[str, View] = {} if found is None else found.views

    def field_of_view(cam: CameraName) -> Value | None:
        extent = views[cam].field_of_view_mm if views else None
        return None if extent is None else Value("{:.4g} x {:.4g} mm".format(*extent), extent[0], CALIBRATION)

    def scale(cam: CameraName) -> Value | None:
        if not views:
            return None
        mean, (rows, columns) = views[cam].mean_scale_mm_per_px, views[cam].scale_mm_per_px
        text = f"{mean:.5g} mm/px ({rows:.5g} along rows, {columns:.5g} down columns; {1.0 / mean:.4g} px/mm)"
        return Value(text, mean, CALIBRATION)

    def stand_off(cam: CameraName) -> Value | None:
        return of_number(views[cam].standoff_mm, ".2f", "mm", CALIBRATION) if views else None

    items = [
        each(
            "field_of_view",
            "Field of view",
            field_of_view,
            _NEEDS_CALIBRATION,
            "width and height of the part of the surface's plane in the image, through the image's middle",
        ),
        each(
            "image_scale",
            "Image scale",
            scale,
            _NEEDS_CALIBRATION,
            "on the surface, in the middle of the measured points",
        ),
        each(
            "stand_off",
            "Stand-off distance",
            stand_off,
            _NEEDS_CALIBRATION,
            "from the pinhole along the optical axis to the surface's plane",
        ),
    ]
    if source.metadata.standoff_mm is not None:
        ruler = of_number(source.metadata.standoff_mm, "g", "mm", STATED)
        items.append(one("stand_off.stated", "Stand-off distance, by ruler", ruler))
    baseline, angle, between, remedy = None, None, "", _NEEDS_CALIBRATION
    if found is not None:
        degrees, viewing = float(np.degrees(found.stereo_angle_rad)), float(np.degrees(found.viewing_angle_rad))
        angle, remedy = Value(f"{degrees:.3f} degrees", degrees, CALIBRATION), ""
        between = "between the optical axes; between both lines of sight to the middle of the surface "
        between += f"{viewing:.3f} degrees"
        baseline = of_number(found.baseline_mm, ".3f", "mm", CALIBRATION)
    items.append(one("stereo_angle", "Stereo angle", angle, remedy, between))
    return [*items, one("baseline", "Distance of the pinholes", baseline, _NEEDS_CALIBRATION)]


def _recording_items(source: Source, measured: MeasuredSteps) -> list[Item]:
    metadata, rig, read_back = source.metadata, source.rig, "read back from the camera"
    set_to = {cam: rig.cameras.get(cam, CameraRecord()) for cam in CAMERAS}
    lighting = of_text(metadata.lighting, STATED) or of_text(rig.lighting, "as stated (rig file)")
    return [
        one("rate", "Image acquisition rate", _rate(source, measured), f"frame_rate_hz of {METADATA_FORM}"),
        each(
            "exposure",
            "Exposure",
            lambda cam: (
                of_number(set_to[cam].exposure_ms, "g", "ms", read_back)
                or of_number(metadata.exposure_ms, "g", "ms", STATED)
            ),
            f"exposure_ms of {METADATA_FORM}",
        ),
        each("gain", "Gain", lambda cam: of_number(set_to[cam].gain_db, "g", "dB", read_back), _BY_SERVICE),
        one(
            "frames",
            "Frames averaged for an image",
            of_number(source.reference_step.frames, "d", "", RECORD),
            _BY_SERVICE,
        ),
        one("synchronisation", "Synchronisation", _synchronisation(source, measured), _BY_SERVICE),
        one("lighting", "Lighting", lighting, f"lighting of {_RIG_FILE}"),
        one(
            "pattern.technique",
            "Patterning technique",
            of_text(metadata.pattern_technique, STATED),
            f"pattern_technique of {METADATA_FORM}",
        ),
    ]


def _sizes(source: Source) -> dict[str, tuple[tuple[int, int], str] | None]:
    """Width and height of each camera's images, and the source that states them."""
    recorded = source.reference_step.image_size_px
    calibration = source.calibration
    calibrated = (None, None) if calibration is None else (calibration.image_size1_px, calibration.image_size2_px)
    sizes: dict[str, tuple[tuple[int, int], str] | None] = {}
    for cam, size in zip(CAMERAS, calibrated, strict=True):
        sizes[cam] = None
        if cam in recorded:
            sizes[cam] = recorded[cam], RECORD
        elif size is not None:
            sizes[cam] = size, CALIBRATION
        else:
            image = source.reference_image(cam)
            if image is not None:
                sizes[cam] = (image.shape[1], image.shape[0]), "of the reference image"
    return sizes


def image_sizes(source: Source) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """Width and height of both cameras' images, None if they are not known."""
    one, two = (_sizes(source)[cam] for cam in CAMERAS)
    return None if one is None else one[0], None if two is None else two[0]


def _rate(source: Source, measured: MeasuredSteps) -> Value | None:
    if source.metadata.frame_rate_hz is not None:
        return of_number(source.metadata.frame_rate_hz, "g", "Hz", STATED)
    rate, trigger = source.rig.frame_rate_hz, source.rig.trigger
    if rate is not None and trigger in ("free", "hardware"):
        return Value(f"{rate:g} Hz (trigger: {trigger})", rate, RECORD)
    times = [step.seconds for step in measured.steps if step.seconds is not None]
    if len(times) < 2:
        return None
    gaps = [b - a for a, b in zip(sorted(times), sorted(times)[1:], strict=False)]
    usual = statistics.median(gaps)
    text = f"single pairs on command; median of {usual:.3g} s between steps"
    return Value(text, 1.0 / usual if usual > 0.0 else None, RECORD)


def _synchronisation(source: Source, measured: MeasuredSteps) -> Value | None:
    known = [(abs(step.skew_ms), step.skew_by) for step in measured.steps if step.skew_ms is not None]
    if not known:
        return None
    skew, by = max(known, key=lambda one: one[0])
    shown = f" ({by})" if by else ""
    rig = source.rig
    trigger = f"{rig.trigger} trigger; " if rig.trigger else ""
    limit = "" if rig.max_skew_ms is None else f", at most {rig.max_skew_ms:g} ms is allowed"
    return Value(f"{trigger}maximum skew of a pair {skew:.3g} ms{shown}{limit}", skew, RECORD)


def _pattern(source: Source, measured: MeasuredSteps, found: Geometry | None) -> list[Item]:
    size, metadata = _pattern_size(source, measured), source.metadata
    feature, contrast, needs = None, None, "needs the reference image of camera 1"
    remark = (
        "full width of the autocorrelation's peak at half of its height, over the measured region of camera 1's "
        "reference image; noise and slow changes of light taken out"
    )
    if size is not None:
        mm = "" if found is None else f" = {size.feature_px * found.views['cam1'].mean_scale_mm_per_px:.4g} mm"
        feature = Value(f"{size.feature_px:.2f} px{mm}", size.feature_px, MEASURED)
        remark += f" ({size.width_x_px:.2f} px along rows, {size.width_y_px:.2f} px down columns)"
        contrast = Value(f"{size.contrast_grey:.1f} grey levels", size.contrast_grey, MEASURED)
    items = [one("pattern.size", "Pattern feature size", feature, needs, remark)]
    if metadata.pattern_feature_mm is not None:
        feature = of_number(metadata.pattern_feature_mm, "g", "mm", STATED)
        method = metadata.pattern_feature_method or "the method was not stated"
        items.append(one("pattern.stated", "Pattern feature size, as stated", feature, "", method))
    of = "standard deviation of the pattern's grey levels in the same region"
    return [*items, one("pattern.contrast", "Pattern contrast", contrast, needs, of)]


def _pattern_size(source: Source, measured: MeasuredSteps) -> PatternSize | None:
    image = source.reference_image("cam1")
    if image is None:
        return None
    field, half = measured.reference, int(source.settings.subset_px or 21) // 2
    inside = np.zeros(image.shape, dtype=bool)
    for x, y in zip(field.x_px[field.valid], field.y_px[field.valid], strict=True):
        c, r = round(float(x)), round(float(y))
        inside[max(r - half, 0) : r + half + 1, max(c - half, 0) : c + half + 1] = True
    return pattern_size(image, inside)


def _noise(source: Source, measured: MeasuredSteps) -> tuple[Value | None, ...]:
    depth = source.reference_step.bit_depth or {}
    residual = measured.noise_grey
    values: list[Value | None] = []
    for cam in CAMERAS:
        model = getattr(source.settings.noise, cam)
        if model is not None:
            image = source.reference_image(cam)
            a = model.coefficients
            grey = None if image is None else float(np.median(image))
            formula = " + ".join(f"{c:.4g}{('', ' g', ' g^2')[k]}" for k, c in enumerate(a[:3]))
            sd = None if grey is None else float(np.sqrt(max(sum(c * grey**k for k, c in enumerate(a)), 0.0)))
            at = "" if sd is None else f"{sd:.3g} at grey level {grey:.0f}; "
            values.append(Value(f"{at}variance {formula}, from {model.frames} frames", sd, "from the noise model"))
        elif cam == "cam1" and residual is not None:
            full = f" ({100.0 * residual / (2.0 ** depth[cam] - 1.0):.2f} % of full scale)" if cam in depth else ""
            values.append(
                Value(f"{residual:.3g}{full}", residual, "from the residuals of the matching, median of the points")
            )
        else:
            values.append(None)
    if values[1] is None and values[0] is not None and "residuals" in values[0].origin:
        return (values[0],)  # the residuals of both images, reported as camera 1's
    return tuple(values)
