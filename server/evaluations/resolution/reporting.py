"""The reporting tables of the iDICs Good Practices Guide (2018), filled from records, settings and the study itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.names import CAMERAS
from stereorig.core.pattern import pattern_size
from stereorig.server.config.camera_metadata import CameraMetadata, LensMetadata, merged
from stereorig.server.documents.steps import CameraRecord, RigRecord, StepRecord
from stereorig.server.documents.tests import TestRecord
from stereorig.server.evaluations.cards import CardNumber
from stereorig.server.evaluations.resolution.document import Reported, SettingFound, SubsetFound
from stereorig.server.evaluations.resolution.origin import Origin
from stereorig.server.results.metadata import TestMetadata, parse_metadata
from stereorig.server.store.durable import known_record

_TENSORS = {"green_lagrange": "Green-Lagrange", "infinitesimal": "infinitesimal", "hencky": "Hencky (logarithmic)"}


def reporting(
    origin: Origin, points: Field, subset: SubsetFound, setting: SettingFound | None, mm_per_px: float
) -> list[Reported]:
    """Return the tables, of the subset and of the strain's setting that are reported; none without stated settings."""
    if _known(lambda: origin.settings.interpolation) is None:
        return []
    return [
        Reported(item=name, value=value)
        for name, value in (*_hardware(origin, points, mm_per_px), *_analysis(origin, subset, setting))
    ]


def _hardware(origin: Origin, points: Field, mm_per_px: float) -> Iterator[tuple[str, str | None]]:
    test, step = origin.test, StepRecord(n=0)
    stated = TestMetadata.model_validate({})
    if test is not None:
        number = origin.settings.reference
        step = known_record(StepRecord, test / "steps" / f"{number:04d}" / "step.json", n=number)
        stated = parse_metadata(
            known_record(TestRecord, test / "test.json", id="").metadata, name="the test's metadata"
        )
    rig = step.rig or RigRecord()
    set_to = {cam: rig.cameras.get(cam, CameraRecord()) for cam in CAMERAS}
    cameras = {cam: merged(stated.camera(cam), set_to[cam].plain()) for cam in CAMERAS}
    lenses = {cam: cameras[cam].lens or LensMetadata.model_validate({}) for cam in CAMERAS}
    exposures = [one.exposure_ms or stated.exposure_ms for one in set_to.values()]
    yield "Camera", _both(_named(one) for one in cameras.values())
    sizes = [step.image_size_px.get(cam) for cam in CAMERAS]
    yield "Image resolution", _both(None if size is None else f"{size[0]} x {size[1]} px" for size in sizes)
    yield "Lens", _both(_named(one) for one in lenses.values())
    yield "Focal length", _both(_number(one.focal_length_mm, "mm") for one in lenses.values())
    yield "Aperture", _both(None if one.f_number is None else f"f/{one.f_number:g}" for one in lenses.values())
    width = sizes[0]
    yield "Field of view", None if width is None else f"{width[0] * mm_per_px:.4g} x {width[1] * mm_per_px:.4g} mm"
    yield "Image scale", f"{mm_per_px:.4g} mm/px"
    yield "Stereo-angle", _known(lambda: f"{np.degrees(origin.calibration.pair.stereo_angle_rad):.3g} degrees")
    yield "Stand-off distance", _number(stated.standoff_mm, "mm")
    yield "Image acquisition rate", _number(stated.frame_rate_hz or rig.frame_rate_hz, "Hz")
    yield "Exposure", _both(_number(one, "ms") for one in exposures)
    yield "Patterning technique", stated.pattern_technique
    yield "Pattern feature size", _known(lambda: _feature(origin, points, mm_per_px))


def _analysis(origin: Origin, subset: SubsetFound, setting: SettingFound | None) -> Iterator[tuple[str, str | None]]:
    settings = origin.settings
    yield "DIC software", f"stereorig {origin.results.head(origin.step).software_version}"
    yield "Image filtering", f"Gaussian, {settings.prefilter_px:g} px" if settings.prefilter_px else "none"
    yield "Subset size", f"{subset.subset_px} px"
    yield "Step size", f"{settings.spacing_px if setting is None else setting.spacing_px:g} px"
    yield "Subset shape function", subset.patch
    yield "Matching criterion", "zero-mean normalised sum of squared differences (ZNSSD)"
    yield "Interpolant", f"{settings.interpolation} B-spline"
    for name in "uvw":
        yield f"Noise-floor of {name}", _shown(subset.numbers[f"noise_{name}"])
        yield f"Bias of {name} at the steepest place", _shown(subset.numbers[f"bias_{name}"])
    yield "Spatial resolution of displacement, l10", f"{subset.l10_px:.4g} px, {subset.l10_mm:.4g} mm"
    if setting is None:
        return
    yield "Strain window", f"{setting.strain_window} x {setting.strain_window} points, planes"
    yield "Virtual strain gauge size", f"{setting.gauge_px:g} px"
    yield "Strain formulation", _TENSORS["green_lagrange"]
    yield "Post-filtering of strain", "none"
    for name in ("exx", "eyy", "exy"):
        yield f"Noise-floor of {name}", _shown(setting.numbers[f"noise_{name}"])
        yield f"Bias of {name} at the steepest place", _shown(setting.numbers[f"bias_{name}"])
    yield "Spatial resolution of strain, l10", f"{setting.l10_px:.4g} px, {setting.l10_mm:.4g} mm"


def _named(of: CameraMetadata | LensMetadata) -> str | None:
    return " ".join(part for part in (of.maker, of.model) if part) or None


def _number(value: float | None, unit: str) -> str | None:
    return None if value is None else f"{value:g} {unit}"


def _shown(one: CardNumber) -> str | None:
    if one.value is None:
        return None
    unit = "" if one.units == "1" else f" {one.units}"
    doubt = f" ({one.why})" if one.why else ""
    return f"{one.value:.3g}{unit}, u {one.u:.2g}{doubt}"


def _both(values: Iterable[str | None]) -> str | None:
    """Return the cameras' values, one where they are alike."""
    found = ["not stated" if value is None else value for value in values]
    if set(found) == {"not stated"}:
        return None
    return found[0] if len(set(found)) == 1 else f"{found[0]}; camera 2: {found[1]}"


def _known(read: Callable[[], str | None]) -> str | None:
    """Return what is read from images and calibration; None if these are not at hand."""
    try:
        return read()
    except InputError as error:
        if error.code != "images_missing":
            raise
        return None


def _feature(origin: Origin, points: Field, mm_per_px: float) -> str | None:
    image = origin.reference[0]
    inside, half = np.zeros(image.shape, bool), origin.settings.subset_px // 2
    for x, y in zip(points.x_px[points.valid], points.y_px[points.valid], strict=True):
        c, r = round(float(x)), round(float(y))
        inside[max(r - half, 0) : r + half + 1, max(c - half, 0) : c + half + 1] = True
    size = pattern_size(image, inside)
    return None if size is None else f"{size.feature_px:.3g} px, {size.feature_px * mm_per_px:.3g} mm"
