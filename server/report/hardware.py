"""The hardware parameters: those of the reporting tables of the iDICs Good Practices Guide (2018), and some more."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

import numpy as np

from core.names import CAMERAS
from core.pattern import PatternSize, pattern_size
from server.config.camera_facts import CameraFacts, merged
from server.report.geometry import Geometry
from server.report.items import CALIBRATION, MEASURED, RECORD, TOLD, Item, Value, of_number, of_text
from server.report.source import Source
from server.report.steps import Measured


def _rig_of(source: Source) -> dict[str, Any]:
    record = source.steps.get(source.reference, {}).get("rig")
    return record if isinstance(record, dict) else {}


def _cameras(source: Source) -> dict[str, CameraFacts]:
    recorded = _rig_of(source).get("cameras", {})
    return {cam: merged(source.facts.camera(cam), recorded.get(cam)) for cam in CAMERAS}


def hardware(source: Source, measured: Measured, found: Geometry | None) -> list[Item]:
    """Return the hardware parameters."""
    rig, facts, cameras = _rig_of(source), source.facts, _cameras(source)
    step = source.steps.get(source.reference, {})
    settings: dict[str, Any] = {cam: (rig.get("cameras") or {}).get(cam) or {} for cam in CAMERAS}
    identity = (
        step.get("cameras")
        or (source.calibration.details.get("provenance", {}).get("cameras") if source.calibration else None)
        or {}
    )
    sizes = _sizes(source)
    in_file = "as told (test or rig file)"

    def each(make: Any) -> tuple[Value | None, ...]:
        return tuple(make(cam) for cam in CAMERAS)

    def device(cam: str, name: str) -> Value | None:
        return of_text((identity.get(cam) or {}).get(name), "from the camera itself")

    def of_facts(name: str) -> tuple[Value | None, ...]:
        return each(lambda cam: of_text(getattr(cameras[cam], name), in_file))

    def of_lens(name: str, form: str = "", unit: str = "") -> tuple[Value | None, ...]:
        def one(cam: str) -> Value | None:
            lens = cameras[cam].lens
            value = None if lens is None else getattr(lens, name)
            return of_text(value, in_file) if not form else of_number(value, form, unit, in_file)

        return each(one)

    def view(make: Any) -> tuple[Value | None, ...]:
        return each(lambda cam: None if found is None else make(found.views[cam]))

    def pinhole(cam: str) -> Value | None:
        if source.calibration is None:
            return None
        lens = getattr(source.calibration.pair, cam).lens
        phd = float(lens.phd_px if hasattr(lens, "phd_px") else lens.fx_px)
        pixel = cameras[cam].pixel_um
        text = f"{phd:.1f} px" + ("" if pixel is None else f" = {phd * pixel / 1000.0:.2f} mm")
        return Value(text, phd, CALIBRATION)

    fact = "PUT /tests/{id}/facts or facts.toml"
    rig_file = f"the rig file or {fact}"
    needs = "needs the calibration that the results were measured with (--calibration)"
    lens = f"[camN.lens] of {rig_file}"
    return [
        Item("camera.maker", "Camera, maker", of_facts("maker"), f"camN.maker of {rig_file}"),
        Item(
            "camera.model",
            "Camera, model",
            each(lambda cam: device(cam, "model") or of_text(cameras[cam].model, in_file)),
            f"camN.model of {fact}",
        ),
        Item(
            "camera.serial",
            "Camera, serial number",
            each(lambda cam: device(cam, "serial")),
            "is recorded when the service captures",
        ),
        Item(
            "camera.resolution",
            "Image size",
            each(lambda cam: _size_value(sizes[cam])),
            "needs the images or the calibration",
        ),
        Item(
            "camera.depth",
            "Significant bits",
            each(lambda cam: of_number((step.get("bit_depth") or {}).get(cam), "d", "bit", RECORD)),
            "is recorded when the service captures or imports",
        ),
        Item("camera.sensor", "Sensor", of_facts("sensor"), f"camN.sensor of {rig_file}"),
        Item(
            "camera.pixel",
            "Pixel size",
            each(lambda cam: of_number(cameras[cam].pixel_um, "g", "\u00b5m", in_file)),
            f"camN.pixel_um of {rig_file}",
        ),
        Item("lens.maker", "Lens, maker", of_lens("maker"), f"maker in {lens}"),
        Item("lens.model", "Lens, model", of_lens("model"), f"model in {lens}"),
        Item(
            "lens.focal_length",
            "Lens, focal length",
            of_lens("focal_length_mm", "g", "mm"),
            f"focal_length_mm in {lens}",
        ),
        Item(
            "lens.aperture", "Lens, aperture", each(lambda cam: _aperture(cameras[cam], in_file)), f"f_number in {lens}"
        ),
        *_lens_notes(of_lens("note")),
        Item(
            "lens.pinhole",
            "Pinhole distance",
            each(pinhole),
            needs,
            "of the fitted camera; longer than the focal length, since the lens is focused near",
        ),
        Item(
            "field_of_view",
            "Field of view",
            view(
                lambda v: (
                    None
                    if v.field_of_view_mm is None
                    else Value("{:.4g} x {:.4g} mm".format(*v.field_of_view_mm), v.field_of_view_mm[0], CALIBRATION)
                )
            ),
            needs,
            "width and height of what the image shows of the surface's plane, through the image's middle",
        ),
        Item(
            "image_scale",
            "Image scale",
            view(
                lambda v: Value(
                    "{:.5g} mm/px ({:.5g} along rows, {:.5g} down columns; {:.4g} px/mm)".format(
                        v.mean_scale_mm_per_px, *v.scale_mm_per_px, 1.0 / v.mean_scale_mm_per_px
                    ),
                    v.mean_scale_mm_per_px,
                    CALIBRATION,
                )
            ),
            needs,
            "on the surface, in the middle of what was measured",
        ),
        Item(
            "stand_off",
            "Stand-off distance",
            view(lambda v: of_number(v.standoff_mm, ".2f", "mm", CALIBRATION)),
            needs,
            "from the pinhole along the optical axis to the surface's plane",
        ),
        *(
            []
            if facts.standoff_mm is None
            else [
                Item("stand_off.told", "Stand-off distance, by ruler", (of_number(facts.standoff_mm, "g", "mm", TOLD),))
            ]
        ),
        _stereo_angle(found, needs),
        Item(
            "baseline",
            "Distance of the pinholes",
            (None if found is None else of_number(found.baseline_mm, ".3f", "mm", CALIBRATION),),
            needs,
        ),
        Item("rate", "Image acquisition rate", (_rate(source, rig, measured),), f"frame_rate_hz of {fact}"),
        Item(
            "exposure",
            "Exposure",
            each(
                lambda cam: (
                    of_number(settings[cam].get("exposure_ms"), "g", "ms", "read back from the camera")
                    or of_number(facts.exposure_ms, "g", "ms", TOLD)
                )
            ),
            f"exposure_ms of {fact}",
        ),
        Item(
            "gain",
            "Gain",
            each(lambda cam: of_number(settings[cam].get("gain_db"), "g", "dB", "read back from the camera")),
            "is recorded when the service captures",
        ),
        Item(
            "frames",
            "Frames averaged for an image",
            (of_number(step.get("frames"), "d", "", RECORD),),
            "is recorded when the service captures",
        ),
        Item(
            "synchronisation",
            "Synchronisation",
            (_synchronisation(rig, measured),),
            "is recorded when the service captures",
        ),
        Item(
            "lighting",
            "Lighting",
            (of_text(facts.lighting, TOLD) or of_text(rig.get("lighting"), "as told (rig file)"),),
            f"lighting of {rig_file}",
        ),
        Item(
            "pattern.technique",
            "Patterning technique",
            (of_text(facts.pattern_technique, TOLD),),
            f"pattern_technique of {fact}",
        ),
        *_pattern(source, measured, found),
        Item(
            "noise",
            "Noise of the images",
            _noise(source, measured),
            "needs a noise model (stereorig noise) or points that were measured",
            "standard deviation in grey levels",
        ),
    ]


def _size_value(size: tuple[tuple[int, int], str] | None) -> Value | None:
    return None if size is None else Value(f"{size[0][0]} x {size[0][1]} px", None, size[1])


def _lens_notes(values: tuple[Value | None, ...]) -> list[Item]:
    # most lenses have nothing on them: no item that is missing
    none = Value("none told")
    told = any(v is not None for v in values)
    return [Item("lens.note", "Lens, accessories", tuple(v or none for v in values))] if told else []


def _aperture(camera: CameraFacts, origin: str) -> Value | None:
    number = None if camera.lens is None else camera.lens.f_number
    return None if number is None else Value(f"f/{number:g}", number, origin)


def _stereo_angle(found: Geometry | None, needs: str) -> Item:
    if found is None:
        return Item("stereo_angle", "Stereo angle", (None,), needs)
    angle, sight = float(np.degrees(found.stereo_angle_rad)), float(np.degrees(found.sight_angle_rad))
    comment = f"between the optical axes; between both lines of sight to the middle of the surface {sight:.3f} degrees"
    return Item("stereo_angle", "Stereo angle", (Value(f"{angle:.3f} degrees", angle, CALIBRATION),), "", comment)


def _sizes(source: Source) -> dict[str, tuple[tuple[int, int], str] | None]:
    """Width and height of each camera's images, and where they are from."""
    recorded = source.steps.get(source.reference, {}).get("image_size_px") or {}
    calibration = source.calibration
    calibrated = (None, None) if calibration is None else (calibration.image_size1_px, calibration.image_size2_px)
    sizes: dict[str, tuple[tuple[int, int], str] | None] = {}
    for cam, size in zip(CAMERAS, calibrated, strict=True):
        sizes[cam] = None
        if recorded.get(cam):
            sizes[cam] = (int(recorded[cam][0]), int(recorded[cam][1])), RECORD
        elif size is not None:
            sizes[cam] = size, CALIBRATION
        else:
            image = source.reference_image(cam)
            if image is not None:
                sizes[cam] = (image.shape[1], image.shape[0]), "of the reference image"
    return sizes


def image_sizes(source: Source) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """Width and height of both cameras' images, None where nothing says so."""
    one, two = (_sizes(source)[cam] for cam in CAMERAS)
    return None if one is None else one[0], None if two is None else two[0]


def _rate(source: Source, rig: Mapping[str, Any], measured: Measured) -> Value | None:
    if source.facts.frame_rate_hz is not None:
        return of_number(source.facts.frame_rate_hz, "g", "Hz", TOLD)
    rate = rig.get("frame_rate_hz")
    if rate is not None and rig.get("trigger") in ("free", "hardware"):
        return Value(f"{rate:g} Hz (trigger: {rig['trigger']})", float(rate), RECORD)
    times = [step.seconds for step in measured.steps if step.seconds is not None]
    if len(times) < 2:
        return None
    gaps = [b - a for a, b in zip(sorted(times), sorted(times)[1:], strict=False)]
    usual = statistics.median(gaps)
    text = f"single pairs on command; median of {usual:.3g} s between steps"
    return Value(text, 1.0 / usual if usual > 0.0 else None, RECORD)


def _synchronisation(rig: Mapping[str, Any], measured: Measured) -> Value | None:
    skews = [abs(step.skew_ms) for step in measured.steps if step.skew_ms is not None]
    if not skews:
        return None
    trigger = f"{rig['trigger']} trigger; " if rig.get("trigger") else ""
    limit = f", at most {rig['max_skew_ms']:g} ms is allowed" if rig.get("max_skew_ms") is not None else ""
    return Value(f"{trigger}largest skew of a pair {max(skews):.3g} ms{limit}", max(skews), RECORD)


def _pattern(source: Source, measured: Measured, found: Geometry | None) -> list[Item]:
    size = _pattern_size(source, measured)
    told = source.facts.pattern_feature_mm
    items = []
    value = None
    if size is not None:
        scale = None if found is None else found.views["cam1"].mean_scale_mm_per_px
        text = f"{size.feature_px:.2f} px" + ("" if scale is None else f" = {size.feature_px * scale:.4g} mm")
        value = Value(text, size.feature_px, MEASURED)
    how = (
        "full width of the autocorrelation's peak at half of its height, over the measured region of camera 1's "
        "reference image; noise and slow changes of light taken out"
    )
    if size is not None:
        how += f" ({size.width_x_px:.2f} px along rows, {size.width_y_px:.2f} px down columns)"
    items.append(Item("pattern.size", "Pattern feature size", (value,), "needs the reference image of camera 1", how))
    if told is not None:
        how = source.facts.pattern_feature_method or "how it is known was not told"
        items.append(
            Item("pattern.told", "Pattern feature size, as told", (of_number(told, "g", "mm", TOLD),), "", how)
        )
    contrast = None if size is None else Value(f"{size.contrast_grey:.1f} grey levels", size.contrast_grey, MEASURED)
    items.append(
        Item(
            "pattern.contrast",
            "Pattern contrast",
            (contrast,),
            "needs the reference image of camera 1",
            "standard deviation of the pattern's grey levels in the same region",
        )
    )
    return items


def _pattern_size(source: Source, measured: Measured) -> PatternSize | None:
    image = source.reference_image("cam1")
    if image is None:
        return None
    field, half = measured.reference, int(source.settings.get("subset_px", 21)) // 2
    inside = np.zeros(image.shape, dtype=bool)
    for x, y in zip(field.x_px[field.valid], field.y_px[field.valid], strict=True):
        c, r = round(float(x)), round(float(y))
        inside[max(r - half, 0) : r + half + 1, max(c - half, 0) : c + half + 1] = True
    return pattern_size(image, inside)


def _noise(source: Source, measured: Measured) -> tuple[Value | None, ...]:
    record = source.settings.get("noise")
    depth = source.steps.get(source.reference, {}).get("bit_depth") or {}
    residual = measured.noise_grey
    values: list[Value | None] = []
    for cam in CAMERAS:
        model = record.get(cam) if isinstance(record, dict) else None
        if isinstance(model, dict):
            image = source.reference_image(cam)
            a = [float(c) for c in model["coefficients"]]
            grey = None if image is None else float(np.median(image))
            formula = " + ".join(f"{c:.4g}{('', ' g', ' g^2')[k]}" for k, c in enumerate(a[:3]))
            sd = None if grey is None else float(np.sqrt(max(sum(c * grey**k for k, c in enumerate(a)), 0.0)))
            at = "" if sd is None else f"{sd:.3g} at grey level {grey:.0f}; "
            values.append(Value(f"{at}variance {formula}, from {model['frames']} frames", sd, "from the noise model"))
        elif cam == "cam1" and residual is not None:
            full = f" ({100.0 * residual / (2.0 ** depth[cam] - 1.0):.2f} % of full scale)" if depth.get(cam) else ""
            values.append(
                Value(f"{residual:.3g}{full}", residual, "from the residuals of the matching, median of the points")
            )
        else:
            values.append(None)
    if values[1] is None and values[0] is not None and "residuals" in values[0].origin:
        return (values[0],)  # the residuals of both images, told as camera 1's
    return tuple(values)
