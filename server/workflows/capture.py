"""Taking a step into a test: from the cameras, or from files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from stereorig.core.errors import ImageError, StageError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.simultaneity import in_words
from stereorig.server.base.metrics import timed_capture
from stereorig.server.cell.images import images as read_images
from stereorig.server.documents.steps import StepMetadata, StepRecord
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.images import GrayImage, encode_tiff
from stereorig.server.results.images.quality import ImageQuality, image_quality, pair_quality, quality_warning
from stereorig.server.rig.cameras import CapturedPair
from stereorig.server.store.folder import now_utc
from stereorig.server.store.indexing.entries import step_entry
from stereorig.server.workflows.camera_identity import check_same_cameras
from stereorig.server.workflows.channels.reading import StepChannels
from stereorig.server.workflows.service import Service

#: a camera further from its calibrated position than this is off: 10 um of 400 mm change the scale by 2.5e-5
OFF_ZERO_MM = 0.01
_AT_ONCE = 2  # the next pairs are still being recorded, or the page is looked at


@timed_capture("capture")
def capture_step(service: Service, test_id: str, metadata: StepMetadata, *, frames: int) -> StepRecord:
    """Capture a pair and commit it as the test's next step; returns ``step.json``."""
    service.require_room()
    with service.hardware.hold("the capture of a step", test_id=test_id):
        captured, positions = service.hardware.call(
            lambda: (service.rig.pair.capture(frames), service.rig.known_positions())
        )
        return commit_pair(service, test_id, metadata, captured, positions)


class NewStep(NamedTuple):
    """A captured pair that becomes a step; ``channels`` at its exposure, None: those that are read now."""

    metadata: StepMetadata
    captured: CapturedPair
    channels: StepChannels | None = None


def commit_pair(
    service: Service,
    test_id: str,
    metadata: StepMetadata,
    captured: CapturedPair,
    positions: Mapping[int, float | StageError],
) -> StepRecord:
    """Judge a captured pair and commit it as the test's next step, see `commit_pairs`."""
    (step,) = commit_pairs(service, test_id, [NewStep(metadata, captured)], positions)
    return step


def commit_pairs(
    service: Service, test_id: str, new: Sequence[NewStep], positions: Mapping[int, float | StageError]
) -> Iterator[StepRecord]:
    """Judge captured pairs and commit them as the test's next steps; with the hold. Each ``step.json`` that is durable.

    Parameters
    ----------
    new
        Pairs of one size, of the same cameras with the same settings.
    positions
        Stage position by axis in mm, read back as the pairs were taken, or the error if one is not known; empty on a
        rig without a stage.

    Raises
    ------
    ImageError
        ``image_size_mismatch``.
    StateError
        ``wrong_camera`` when the test's calibration is other cameras'.
    StorageError
        It is not on disk.
    """
    identities, rig = service.rig.identities(), service.rig.record().plain()
    _check_sizes(service, test_id, _sizes(new[0].captured))
    if service.tests.is_calibrated(test_id):
        check_same_cameras(service.tests.calibration_file(test_id), identities, "The step")
    service.channels.attend(test_id)

    def judged(one: NewStep) -> tuple[dict[str, bytes], dict[str, Any]]:
        images: dict[str, bytes] = {cam: encode_tiff(one.captured.pixels[cam]) for cam in CAMERAS}
        return images, _document(service, one, positions, {"cameras": identities, "rig": rig})

    if len(new) == 1:
        whole = [judged(new[0])]
    else:
        with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="pairs") as pool:
            whole = list(pool.map(judged, new))
    while whole:
        steps = _announce(service, test_id, service.tests.steps.add_some(test_id, whole))
        whole = whole[len(steps) :]
        yield from steps


def _sizes(captured: CapturedPair) -> dict[str, list[int]]:
    return {cam: [*reversed(captured.pixels[cam].shape)] for cam in CAMERAS}


def _document(
    service: Service, new: NewStep, positions: Mapping[int, float | StageError], known_rig: Mapping[str, Any]
) -> dict[str, Any]:
    """Return ``step.json`` of a pair, without number and checksums."""
    rig, captured, metadata = service.rig, new.captured, new.metadata
    depth = {cam: 16 if captured.scale > 1 else captured.bit_depth[cam] for cam in CAMERAS}
    rated = {cam: image_quality(captured.pixels[cam], depth[cam]) for cam in CAMERAS}
    quality = pair_quality(*rated.values())
    known = {
        cam: position for cam in CAMERAS if (position := positions.get(rig.config.camera(cam).stage_axis)) is not None
    }
    dz = {cam: None if isinstance(p, StageError) else rig.dz_of(cam, p) for cam, p in known.items()}
    warnings = off_zero_warnings(rig.config.calibration.moves, {cam: mm for cam, mm in dz.items() if mm is not None})
    if warnings and rig.config.calibration.moves != "target":
        quality["code"] = "cameras_off_zero"  # overrides other codes: the pair itself cannot show this one
    lost = {cam: error.cause for cam, error in known.items() if isinstance(error, StageError)}
    warnings += [
        f"Position unknown of {' and '.join(cam for cam in lost if lost[cam] == cause)}: {cause}"
        for cause in dict.fromkeys(lost.values())
    ]
    quality |= {**captured.skew, "max_skew_ms": rig.config.rig.skew_bound_ms, "pairs": captured.pair_counts}
    for cam in CAMERAS:
        quality[cam] |= captured.settings[cam] | {"frames": captured.frame_counts[cam]}
    document: dict[str, Any] = {
        **metadata.plain(),
        "source": "capture",
        "captured_utc": now_utc(),
        "host_monotonic_ns": captured.host_ns,
        **captured.skew,
        "image_speed_px_s": captured.image_speed_px_s,
        **known_rig,
        "frames": captured.frames,
        "grey_scale": captured.scale,
        "bit_depth": captured.bit_depth,
        "frame_sequence": captured.sequence,
        "dz_mm": dz or None,
        "simulated": rig.config.simulated,
        "warnings": warnings + _quality_warnings(rated) + skew_warnings(captured, rig.config.rig.skew_bound_ms),
        "scene": None if rig.scene is None else rig.scene.model_dump(),
        "quality": quality,
        "image_size_px": _sizes(captured),
    }
    exposed_s = captured.host_ns / 1e9 if captured.exposed_s is None else captured.exposed_s
    channels = service.channels.at(exposed_s) if new.channels is None else new.channels
    return document | channels.with_step(metadata, document["warnings"])


def off_zero_warnings(moves: str, dz_mm: Mapping[str, float]) -> list[str]:
    """Return a warning if a stage is off the calibrated place; empty if it is there, or moves nothing."""
    worst = max(dz_mm, key=lambda cam: abs(dz_mm[cam]), default=None)
    if worst is None or moves == "free" or abs(dz_mm[worst]) <= OFF_ZERO_MM:
        return []
    who = {
        "cameras": f"{worst} is at dZ = {dz_mm[worst]:+.3f} mm: the calibration holds at dZ = 0",
        "both_cameras": f"The cameras are at dZ = {dz_mm[worst]:+.3f} mm: the calibrated volume moved with them",
        "target": f"The stage is at dZ = {dz_mm[worst]:+.3f} mm: a specimen on it is off the calibrated place",
    }[moves]
    return [f"{who}. POST /stage/moves with dz_mm 0 for both cameras takes it back."]


def skew_warnings(captured: CapturedPair, max_skew_ms: float) -> list[str]:
    """Return a warning if the pair may have more skew than is allowed, as far as is known."""
    if captured.skew_ms + captured.skew_uncertainty_ms <= max_skew_ms:
        return []
    skew = f"{captured.skew_ms:.3g} ms ({in_words(captured.skew_source, captured.skew_uncertainty_ms)})"
    return [f"A skew of {skew} does not show that the pair keeps the limit of {max_skew_ms:g} ms."]


def _quality_warnings(rated: Mapping[CameraName, ImageQuality]) -> list[str]:
    return [text for cam in CAMERAS if (text := quality_warning(cam, rated[cam])) is not None]


@timed_capture("import")
def import_step(service: Service, test_id: str, data: dict[str, bytes], metadata: StepMetadata) -> StepRecord:
    """Commit two image files as the test's next step; returns ``step.json``.

    Raises
    ------
    ImageError
        A file is no gray or RGB image, or its size differs from the test's calibration or other images;
        ``image_blank``, ``same_image``.
    """
    service.require_room()
    read = read_images(service.cell, {f"the image of {cam}": data[cam] for cam in CAMERAS})
    decoded = dict(zip(CAMERAS, read.values(), strict=True))
    images: dict[str, GrayImage] = {cam: decoded[cam].pixels for cam in CAMERAS}
    grey_from = {cam: made.grey_from for cam, made in decoded.items() if made.grey_from is not None}
    sizes: dict[str, list[int]] = {cam: [*reversed(images[cam].shape)] for cam in CAMERAS}
    _check_sizes(service, test_id, sizes)
    _check_content(images)
    depth = {cam: decoded[cam].bit_depth for cam in CAMERAS}
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
    return _announce(service, test_id, [service.tests.steps.add(test_id, data, document)])[0]


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


def _announce(service: Service, test_id: str, steps: list[StepRecord]) -> list[StepRecord]:
    entries = {f"{step.n:04d}": step_entry(step) for step in steps}
    service.catalog.put_entries("step", test_id, entries)
    for step, entry in zip(steps, entries.values(), strict=True):
        job = {} if step.burst is None else {"job_id": step.burst.job_id}
        service.hub.publish("step", {"test_id": test_id, **entry, **job})
    service.jobs.step_committed(test_id)
    return steps
