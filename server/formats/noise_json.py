"""noise.json: the noise models of both cameras, and the frames they were measured from."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from core.errors import FileFormatError, StereorigError
from core.names import CAMERAS
from core.noise import NoiseModel
from server.formats.files import write_bytes
from server.formats.version import software_version

FORMAT = "stereorig noise"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class LoadedNoise:
    """A noise file's models.

    Attributes
    ----------
    models
        Of camera 1 and camera 2; None where the file has none.
    sha256
        Of the file's bytes.
    created
        Time of the measurement, as the file states it.
    """

    models: tuple[NoiseModel | None, NoiseModel | None]
    sha256: str
    created: object

    def record(self) -> dict[str, object]:
        """Return the entries for a result file: the numbers that were used, and their source."""
        cameras: dict[str, object] = {
            cam: None if model is None else {"coefficients": list(model.coefficients), "frames": model.frames}
            for cam, model in zip(CAMERAS, self.models, strict=True)
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
        data = path.read_bytes()
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


def _plain(model: NoiseModel) -> dict[str, object]:
    plain: dict[str, object] = {}
    for field in fields(model):
        value = getattr(model, field.name)
        if isinstance(value, tuple):
            value = [v if math.isfinite(v) else None for v in value]
        plain[field.name] = value
    return plain


def _model(part: Any, name: str) -> NoiseModel:
    try:
        values = {field.name: part[field.name] for field in fields(NoiseModel) if field.name in part}
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
    except (KeyError, TypeError, ValueError) as error:
        raise _unreadable(name, f"{type(error).__name__}: {error}") from error


def _unreadable(name: str, why: str) -> FileFormatError:
    return FileFormatError(
        f"{name} cannot be used as a noise file: {why}.",
        code="noise_unreadable",
        remedy="Measure it again with stereorig noise.",
    )
