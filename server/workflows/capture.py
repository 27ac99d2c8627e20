"""Taking a step into a test: from the cameras, or from files."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from core.errors import ImageError
from core.names import CAMERAS, CameraName
from server.base.metrics import timed_capture
from server.formats.calibrations.recognise import load_calibration
from server.formats.images import GrayImage, decode, encode_tiff
from server.results.images.quality import ImageQuality, image_quality, pair_quality, quality_warning
from server.rig.cameras import CapturedPair
from server.store.documents import StepMetadata, StepRecord
from server.store.folder import now_utc
from server.store.indexing.entries import step_entry
from server.workflows.camera_identity import check_same_cameras
from server.workflows.service import Service

#: a camera further from its calibrated position than this is off: 10 um of 400 mm change the scale by 2.5e-5
OFF_ZERO_MM = 0.01


@timed_capture("capture")
def capture_step(service: Service, test_id: str, metadata: StepMetadata, *, frames: int) -> StepRecord:
    """Capture a pair and commit it as the test's next step; returns ``step.json``."""
    service.require_room()
    with service.hardware.hold("the capture of a step", test_id=test_id):
        captured, positions_mm = service.hardware.call(
            lambda: (service.rig.pair.capture(frames), service.rig.positions_mm())
        )
        return commit_pair(service, test_id, metadata, captured, positions_mm)


def commit_pair(
    service: Service, test_id: str, metadata: StepMetadata, captured: CapturedPair, positions_mm: dict[int, float]
) -> StepRecord:
    """Judge a captured pair and commit it as the test's next step; with the hold. Returns ``step.json``.

    Parameters
    ----------
    positions_mm
        Of the stage, read back as the pair was taken, by axis.

    Raises
    ------
    ImageError
        ``image_size_mismatch``.
    StateError
        ``wrong_camera`` when the test's calibration is other cameras'.
    StorageError
        It is not on disk.
    """
    rig = service.rig
    sizes: dict[str, list[int]] = {cam: [*reversed(captured.pixels[cam].shape)] for cam in CAMERAS}
    _check_sizes(service, test_id, sizes)
    if service.tests.is_calibrated(test_id):
        check_same_cameras(service.tests.calibration_file(test_id), rig.identities(), "The step")
    depth = {cam: 16 if captured.scale > 1 else captured.bit_depth[cam] for cam in CAMERAS}
    rated = {cam: image_quality(captured.pixels[cam], depth[cam]) for cam in CAMERAS}
    quality = pair_quality(*rated.values())
    dz: dict[str, float] = {cam: rig.dz_of(cam, positions_mm[rig.config.camera(cam).stage_axis]) for cam in CAMERAS}
    warnings = off_zero_warnings(rig.config.calibration.moves, dz)
    if warnings and rig.config.calibration.moves != "target":
        quality["code"] = "cameras_off_zero"  # whatever else is wrong with the pair, this one cannot be seen in it
    quality |= {"skew_ms": captured.skew_ms, "max_skew_ms": rig.config.rig.skew_bound_ms, "pairs": captured.pair_counts}
    for cam in CAMERAS:
        quality[cam] |= captured.settings[cam] | {"frames": captured.frame_counts[cam]}
    document = {
        **metadata.plain(),
        "source": "capture",
        "captured_utc": now_utc(),
        "host_monotonic_ns": captured.host_ns,
        "skew_ms": captured.skew_ms,
        "image_speed_px_s": captured.image_speed_px_s,
        "cameras": rig.identities(),
        "rig": rig.record().plain(),
        "frames": captured.frames,
        "grey_scale": captured.scale,
        "bit_depth": captured.bit_depth,
        "frame_sequence": captured.sequence,
        "dz_mm": dz,
        "warnings": warnings + _quality_warnings(rated),
        "scene": None if rig.scene is None else rig.scene.model_dump(),
        "quality": quality,
        "image_size_px": sizes,
    }
    images: dict[str, bytes] = {cam: encode_tiff(captured.pixels[cam]) for cam in CAMERAS}
    return _announce(service, test_id, service.tests.steps.add(test_id, images, document))


def off_zero_warnings(moves: str, dz_mm: Mapping[str, float]) -> list[str]:
    """Return what to warn of where a stage is off the calibrated place; empty where it is there, or moves nothing."""
    worst = max(dz_mm, key=lambda cam: abs(dz_mm[cam]))
    if moves == "free" or abs(dz_mm[worst]) <= OFF_ZERO_MM:
        return []
    who = {
        "cameras": f"{worst} stands at dZ = {dz_mm[worst]:+.3f} mm: the calibration holds at dZ = 0",
        "both_cameras": f"The cameras stand at dZ = {dz_mm[worst]:+.3f} mm: the calibrated volume moved with them",
        "target": f"The stage stands at dZ = {dz_mm[worst]:+.3f} mm: a specimen on it is off the calibrated place",
    }[moves]
    return [f"{who}. POST /stage/moves with dz_mm 0 for both cameras takes it back."]


def _quality_warnings(rated: Mapping[CameraName, ImageQuality]) -> list[str]:
    return [text for cam in CAMERAS if (text := quality_warning(cam, rated[cam])) is not None]


@timed_capture("import")
def import_step(service: Service, test_id: str, data: dict[str, bytes], metadata: StepMetadata) -> StepRecord:
    """Commit two image files as the test's next step; returns ``step.json``.

    Raises
    ------
    ImageError
        A file is no gray or RGB image, or its size is not that of the test's calibration or other images;
        ``image_blank``, ``same_image``.
    """
    service.require_room()
    decoded = {cam: decode(data[cam], name=f"the image of {cam}") for cam in CAMERAS}
    images: dict[str, GrayImage] = {cam: decoded[cam].pixels for cam in CAMERAS}
    grey_from = {cam: made.grey_from for cam, made in decoded.items() if made.grey_from is not None}
    sizes: dict[str, list[int]] = {cam: [*reversed(images[cam].shape)] for cam in CAMERAS}
    _check_sizes(service, test_id, sizes)
    _check_content(images)
    depth = {cam: 8 * images[cam].dtype.itemsize for cam in CAMERAS}
    rated = {cam: image_quality(images[cam], depth[cam]) for cam in CAMERAS}
    document = {
        **metadata.plain(),
        "source": "import",
        "captured_utc": now_utc(),
        "skew_ms": None,
        "bit_depth": depth,
        "quality": pair_quality(*rated.values()),
        "warnings": _quality_warnings(rated),
        "image_size_px": sizes,
        **({"grey_from": grey_from} if grey_from else {}),
    }
    data = {cam: encode_tiff(images[cam]) for cam in CAMERAS}
    return _announce(service, test_id, service.tests.steps.add(test_id, data, document))


def _check_content(images: dict[str, GrayImage]) -> None:
    """Refuse files that no camera pair can have taken; a capture of a dark scene is kept and flagged instead."""
    for cam in CAMERAS:
        if images[cam].min() == images[cam].max():
            raise ImageError(
                f"The image of {cam} is blank: every pixel is {int(images[cam].max())}.",
                code="image_blank",
                remedy="Check which files were exported, then import the pair again.",
            )
    if np.array_equal(images["cam1"], images["cam2"]):
        raise ImageError(
            "The images of cam1 and cam2 are the same, pixel by pixel.",
            code="same_image",
            remedy="Give each camera its own image.",
        )


def _check_sizes(service: Service, test_id: str, sizes: dict[str, list[int]]) -> None:
    """Refuse images that cannot be measured with the test's calibration, or with its other images."""
    known: dict[str, tuple[str, list[int]]] = {}
    number = service.tests.steps.first(test_id)
    if number is not None:
        first = service.tests.steps.read(test_id, number).document.image_size_px
        known |= {cam: ("the test's others are", list(size)) for cam, size in first.items()}
    if service.tests.is_calibrated(test_id):
        calibration = load_calibration(service.tests.calibration_file(test_id))
        theirs = {"cam1": calibration.image_size1_px, "cam2": calibration.image_size2_px}
        known |= {cam: ("the test's calibration is for", [*wh]) for cam, wh in theirs.items() if wh is not None}
    for name, size in sizes.items():
        origin, other = known.get(name, ("", size))
        if other != size:
            raise ImageError(
                f"The image of {name} is {size[0]} x {size[1]} px, {origin} {other[0]} x {other[1]} px.",
                code="image_size_mismatch",
                remedy="Use images of the cameras that were calibrated, unscaled and uncropped.",
            )


def _announce(service: Service, test_id: str, step: StepRecord) -> StepRecord:
    entry = step_entry(step)
    service.catalog.put_entry("step", test_id, f"{step.n:04d}", entry)
    job = {} if step.burst is None else {"job_id": step.burst.job_id}
    service.hub.publish("step", {"test_id": test_id, **entry, **job})
    service.jobs.step_committed(test_id)
    return step
