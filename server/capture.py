"""Taking a step into a test: from the cameras, or from files."""

from __future__ import annotations

from typing import Any

from core.errors import ImageError
from server.io.images import GrayImage, decode_image, encode_tiff
from server.quality import image_quality, pair_quality
from server.rig.cameras import CAMERAS
from server.service import Service
from server.store.folder import now_utc
from server.store.index import step_entry

#: a camera further from its calibrated place than this is off: 10 um of 400 mm change the scale by 2.5e-5
OFF_ZERO_MM = 0.01


def capture_step(service: Service, test_id: str, facts: dict[str, Any], *, frames: int) -> dict[str, Any]:
    """Capture a pair and commit it as the test's next step; returns ``step.json``."""
    rig = service.rig
    with service.gate.hold("the capture of a step", test_id=test_id):
        shot, positions = service.gate.call(lambda: (rig.shoot(frames), rig.positions_mm()))
        depth = {cam: 16 if shot.scale > 1 else shot.bit_depth[cam] for cam in CAMERAS}
        quality = pair_quality(*(image_quality(shot.pixels[cam], depth[cam]) for cam in CAMERAS))
        dz = {cam: rig.dz_of(cam, positions[rig.config.camera(cam).stage_axis]) for cam in CAMERAS}
        if quality["code"] == "ok" and max(abs(v) for v in dz.values()) > OFF_ZERO_MM:
            quality["code"] = "cameras_off_zero"
        document = {
            **facts,
            "source": "capture",
            "captured_utc": now_utc(),
            "host_monotonic_ns": shot.host_ns,
            "skew_ms": shot.skew_ms,
            "frames": shot.frames,
            "grey_scale": shot.scale,
            "bit_depth": shot.bit_depth,
            "frame_sequence": shot.sequence,
            "dz_mm": dz,
            "scene": rig.scene,
            "quality": quality,
            "image_size_px": {cam: [shot.pixels[cam].shape[1], shot.pixels[cam].shape[0]] for cam in CAMERAS},
        }
        images: dict[str, bytes] = {cam: encode_tiff(shot.pixels[cam]) for cam in CAMERAS}
        step = service.tests.add_step(test_id, images, document)
    return _announce(service, step)


def import_step(service: Service, test_id: str, data: dict[str, bytes], facts: dict[str, Any]) -> dict[str, Any]:
    """Commit two image files as the test's next step; returns ``step.json``.

    Raises
    ------
    ImageError
        A file is no gray image, or its size is not that of the test's other images.
    """
    images: dict[str, GrayImage] = {cam: decode_image(data[cam], name=f"the image of {cam}") for cam in CAMERAS}
    numbers = service.tests.step_numbers(test_id)
    if numbers:
        known = service.tests.step(test_id, numbers[0]).document.get("image_size_px", {})
        for cam in CAMERAS:
            size = [images[cam].shape[1], images[cam].shape[0]]
            if known.get(cam, size) != size:
                raise ImageError(
                    f"The image of {cam} is {size[0]} x {size[1]} px, the test's others are "
                    f"{known[cam][0]} x {known[cam][1]} px.",
                    code="image_size",
                    remedy="Import images of the same cameras, unscaled.",
                )
    depth = {cam: 8 * images[cam].dtype.itemsize for cam in CAMERAS}
    document = {
        **facts,
        "source": "import",
        "captured_utc": now_utc(),
        "skew_ms": None,
        "bit_depth": depth,
        "quality": pair_quality(*(image_quality(images[cam], depth[cam]) for cam in CAMERAS)),
        "image_size_px": {cam: [images[cam].shape[1], images[cam].shape[0]] for cam in CAMERAS},
    }
    data = {cam: encode_tiff(images[cam]) for cam in CAMERAS}
    return _announce(service, service.tests.add_step(test_id, data, document))


def _announce(service: Service, step: dict[str, Any]) -> dict[str, Any]:
    entry = step_entry(step)
    service.catalog.put_entry("step", step["test_id"], f"{step['n']:04d}", entry)
    service.hub.publish("step", {"test_id": step["test_id"], **entry})
    return step
