"""noise.json: the noise models of both cameras; the frames that they are measured from."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.errors import FileFormatError, ImageError, StereorigError
from stereorig.core.names import CAMERAS
from stereorig.core.noise import NoiseModel, SensorMap, rows_looked_at
from stereorig.server.formats.files import write_bytes
from stereorig.server.formats.images import GrayImage, decode, read_file, read_image
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.formats.version import software_version

FORMAT = "stereorig noise"
FORMAT_VERSION = 1
_OF_SD = 1 / 128  # step of a map's pattern: far below a pixel's noise, and short in the file
_LARGEST, _FINEST = 32_000.0, 1e-6  # of 16 bits with a sign; grey levels


@dataclass(frozen=True)
class LoadedNoise:
    """A noise file's models.

    Attributes
    ----------
    models
        Models of camera 1 and camera 2; None if the file has none.
    sha256
        SHA-256 of the file's bytes.
    created
        Time of the measurement, as the file states it.
    """

    models: tuple[NoiseModel | None, NoiseModel | None]
    sha256: str
    created: object

    def record(self) -> dict[str, object]:
        """Return the entries for a result file: the numbers that were used, and their source."""
        cameras: dict[str, object] = {
            cam: None if model is None else _used(model) for cam, model in zip(CAMERAS, self.models, strict=True)
        }
        return {"sha256": self.sha256, "created": self.created, **cameras}


def noise_content(
    models: Mapping[str, NoiseModel], *, sources: Mapping[str, object] | None = None, **more: object
) -> dict[str, object]:
    """Return the content of noise.json; ``sources`` names the frames by camera."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "software_version": software_version(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        **more,
        **{cam: {**_plain(model), "source": (sources or {}).get(cam)} for cam, model in models.items()},
    }


def write_noise(path: Path, content: Mapping[str, object], *, checksum: bool = False) -> None:
    """Write noise.json as a temporary file, sync it and rename it.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``; an older file of that name is then untouched.
    """
    write_bytes(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode(), checksum=checksum)


def load_noise(path: str | Path) -> LoadedNoise:
    """Read noise.json.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``noise_unreadable`` or ``format_too_new``.
    """
    path = Path(path)
    try:
        data = checked_bytes(path)
    except OSError as error:
        raise FileFormatError(
            f"The noise file {path} cannot be read ({error.strerror or error}).",
            code="file_missing",
            remedy="Check the path; stereorig noise makes such a file.",
        ) from error
    return noise_from(data, name=str(path))


def noise_from(data: bytes, *, name: str) -> LoadedNoise:
    """Read the bytes of a noise.json; raises as :func:`load_noise`."""
    try:
        content = json.loads(data)
    except ValueError as error:
        raise _unreadable(name, f"it is no JSON ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise _unreadable(name, f"its format is not {FORMAT!r}")
    version = content.get("format_version")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise FileFormatError(
            f"{name} has the format version {version}; this program reads up to {FORMAT_VERSION}.",
            code="format_too_new",
            remedy="Read it with the program's version that wrote it.",
        )
    models = [_model(content[cam], f"{name}, {cam}") if content.get(cam) is not None else None for cam in CAMERAS]
    if models == [None, None]:
        raise _unreadable(name, "it has neither cam1 nor cam2")
    return LoadedNoise((models[0], models[1]), hashlib.sha256(data).hexdigest(), content.get("created"))


def _used(model: NoiseModel) -> dict[str, object]:
    used: dict[str, object] = {"coefficients": list(model.coefficients), "frames": model.frames}
    if model.sensor is not None:
        used["sensor"] = sensor_figures(model.sensor)
    return used


def sensor_figures(sensor: SensorMap) -> dict[str, object]:
    """Return a map in two numbers."""
    return {"pattern_sd_grey": float(sensor.pattern.std()), "defective_pixels": len(sensor.defects)}


def _packed_sensor(sensor: SensorMap) -> dict[str, object]:
    """Return a map as JSON holds it: steps of a power of two, compressed."""
    sd, largest = float(sensor.pattern.std()), float(np.abs(sensor.pattern).max())
    step = 2.0 ** np.ceil(np.log2(max(_OF_SD * sd, largest / _LARGEST, _FINEST)))
    steps = np.rint(sensor.pattern / step).astype("<i2")
    return {
        **sensor_figures(sensor),
        "shape": list(sensor.pattern.shape),
        "step_grey": float(step),
        "pattern": base64.b64encode(zlib.compress(steps.tobytes())).decode(),
        "defects": base64.b64encode(zlib.compress(sensor.defects.astype("<i8").tobytes())).decode(),
    }


def _unpacked_sensor(part: Mapping[str, Any]) -> SensorMap:
    rows, cols = (int(v) for v in part["shape"])
    steps, defects = (
        np.frombuffer(_inflated(part[name], limit), kind)
        for name, kind, limit in (("pattern", "<i2", 2 * rows * cols), ("defects", "<i8", 8 * rows * cols))
    )
    if defects.size and not (defects.min() >= 0 and defects.max() < rows * cols):
        raise ValueError("a defective pixel outside its sensor")
    step = float(part["step_grey"])
    if not 0.0 < step < math.inf:
        raise ValueError(f"step_grey is {step:g}")
    pattern = (step * steps.reshape(rows, cols)).astype(np.float32)
    return SensorMap(pattern, defects.astype(np.int64))


def _inflated(text: str, limit: int) -> bytes:
    """The bytes of a packed array, of a size that its shape allows."""
    unpacker = zlib.decompressobj()
    found = unpacker.decompress(base64.b64decode(text, validate=True), limit + 1)
    if len(found) > limit or not unpacker.eof:
        raise ValueError("a packed array does not have the size that its shape says")
    return found


def _plain(model: NoiseModel) -> dict[str, object]:
    plain: dict[str, object] = {}
    for field in fields(model):
        value = getattr(model, field.name)
        if isinstance(value, SensorMap):
            value = _packed_sensor(value)
        elif value is None:
            continue
        if isinstance(value, tuple):
            value = [v if math.isfinite(v) else None for v in value]
        plain[field.name] = value
    return plain


def _model(part: Any, name: str) -> NoiseModel:
    try:
        values = {field.name: part[field.name] for field in fields(NoiseModel) if field.name in part}
        if values.get("sensor") is not None:
            values["sensor"] = _unpacked_sensor(values["sensor"])
        for key in ("coefficients", "coefficients_sd", "levels", "variances", "variances_sd"):
            if key in values:
                values[key] = tuple(float(v) for v in values[key])
        low, high = values.get("range_grey", (None, None))
        values["range_grey"] = (-math.inf if low is None else float(low), math.inf if high is None else float(high))
        if len(values["coefficients"]) != 3:
            raise ValueError(f"{len(values['coefficients'])} coefficients")
        return NoiseModel(**values)
    except StereorigError as error:
        raise _unreadable(name, error.cause) from error
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        raise _unreadable(name, f"{type(error).__name__}: {error}") from error


def _unreadable(name: str, why: str) -> FileFormatError:
    return FileFormatError(
        f"{name} cannot be used as a noise file: {why}.",
        code="noise_unreadable",
        remedy="Measure it again with stereorig noise.",
    )


def stated_full_scale(file: Path) -> float | None:
    """Return the largest grey level that a frame's file states: 4095 for 12 bits; None for 8 and 16 bits.

    Raises
    ------
    ImageError
        If the file cannot be read as an image.
    """
    bits = decode(read_file(file), name=str(file)).bit_depth
    return None if bits % 8 == 0 else float((1 << bits) - 1)


def read_frames(files: Sequence[Path], *, whole: bool = False) -> list[GrayImage]:
    """Read frames of one camera: the rows that a noise model is measured from, or the whole of them.

    Raises
    ------
    ImageError
        ``image_size_mismatch``, or the error of a file.
    """
    frames: list[GrayImage] = []
    shape: tuple[int, ...] = ()
    for file in files:
        image = read_image(file)
        shape = shape or image.shape
        if image.shape != shape:
            raise ImageError(
                f"{file} is {image.shape[1]} x {image.shape[0]} px, {files[0]} {shape[1]} x {shape[0]} px.",
                code="image_size_mismatch",
                remedy="Give frames of one camera.",
            )
        frames.append(image if whole else image[rows_looked_at(shape)].copy())
    return frames
