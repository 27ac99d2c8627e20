"""Check that images come from the cameras that were calibrated, where both records hold serial numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS
from stereorig.server.store.durable import read_json

Identities = Mapping[str, object]


def calibrated_cameras(calibration: Path) -> Identities | None:
    """Return model and serial number of each camera from a calibration.json; None if it has none."""
    provenance = read_json(calibration).get("provenance")
    cameras = provenance.get("cameras") if isinstance(provenance, dict) else None
    return cameras if isinstance(cameras, dict) else None


def check_same_cameras(calibration: Path, cameras: Identities | None, images: str) -> None:
    """Refuse images of other cameras than the calibration's.

    Parameters
    ----------
    calibration
        A calibration.json.
    cameras
        Cameras that took the images; None where not known, as with imported files.
    images
        The images, for the text: ``step 3``.

    Raises
    ------
    CameraError
        ``wrong_camera``, which states if the two were exchanged.
    """
    known = calibrated_cameras(calibration)
    if known is None or not cameras:
        return
    serials = {cam: (_serial(known, cam), _serial(cameras, cam)) for cam in CAMERAS}
    other = {cam: pair for cam, pair in serials.items() if None not in pair and pair[0] != pair[1]}
    if not other:
        return
    exchanged = serials["cam1"] == serials["cam2"][::-1]
    texts = [f"{cam} is {now}, calibrated was {then}" for cam, (then, now) in other.items()]
    raise CameraError(
        f"{images} was not taken with the cameras that were calibrated: {'; '.join(texts)}."
        + (" The two are exchanged." if exchanged else ""),
        code="wrong_camera",
        remedy="Put the cameras back, or calibrate these and make a new test.",
        cameras={cam: {"calibrated": then, "now": now} for cam, (then, now) in other.items()},
    )


def _serial(identities: Identities, cam: str) -> str | None:
    record = identities.get(cam)
    serial = record.get("serial") if isinstance(record, Mapping) else getattr(record, "serial", None)
    return serial if isinstance(serial, str) and serial else None
