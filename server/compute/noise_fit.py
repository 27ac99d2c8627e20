"""The fit of both cameras' noise models, in the worker."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from stereorig.core.errors import ImageError, InputError
from stereorig.core.names import CAMERAS
from stereorig.core.noise import NoiseModel, measure_noise, measure_pattern
from stereorig.server.compute.tasks import NoiseTask
from stereorig.server.formats.noise_json import noise_content, read_frames, write_noise


def fit_noise(task: NoiseTask) -> dict[str, object]:
    """Measure both cameras' noise from a folder's frames and write ``noise.json``.

    Raises
    ------
    InputError, ImageError
        As :func:`stereorig.core.noise.measure_noise` and :func:`stereorig.core.noise.measure_pattern`, with ``camera``.
    """
    folder = Path(task.folder)
    document = json.loads((folder / "frames.json").read_text())
    models: dict[str, NoiseModel] = {}
    sources: dict[str, object] = {}
    for cam in CAMERAS:
        files = [entry for entry in document["frames"] if entry["camera"] == cam]
        try:
            models[cam] = measure_noise(
                read_frames([folder / entry["file"] for entry in files]),
                full_scale=float((1 << document["bit_depth"][cam]) - 1),
            )
            if document.get("even"):
                whole = read_frames([folder / entry["file"] for entry in files], whole=True)
                models[cam] = replace(models[cam], sensor=measure_pattern(whole))
        except (ImageError, InputError) as error:
            raise type(error)(f"{cam}: {error.cause}", code=error.code, remedy=error.remedy, camera=cam) from error
        sources[cam] = [{"file": entry["file"], "sha256": entry["sha256"]} for entry in files]
    content = noise_content(models, sources=sources, settings=document["settings"])
    write_noise(folder / "noise.json", content, checksum=True)
    return {"noise_id": folder.name, **{cam: {"coefficients": list(m.coefficients)} for cam, m in models.items()}}
