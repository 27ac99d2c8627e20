"""Comparisons with models as tasks of the process beside the service."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from server.results.models.request import CompareRequest, ModelReading

VTU = "comparison.vtu"


def check_model_task(model: str, reading: ModelReading) -> dict[str, object]:
    """Read a model, so that what is wrong with it is said before it is kept; return what it holds."""
    from server.formats.models.read import read_model

    read = read_model(Path(model), unit=reading.unit, displacement=reading.displacement, time=reading.time)
    return {"unit": read.unit, "displacement": read.displacement_name, "nodes": len(read.nodes_mm)}


def compare_task(
    files: Sequence[str], model: str, name: str, request: CompareRequest, out: str | None = None
) -> dict[str, object]:
    """Compare a step with a model; return what it says, and write the VTU into the folder ``out``."""
    from server.exports.vtu import write_vtu
    from server.results.models.compare import compare_files
    from server.results.steps import Source, read_step

    paths = [Path(file) for file in files]
    found = compare_files(paths, Path(model), request, model_name=name)
    if out is not None:
        path = next(file for file in paths if file.name in found.document.inputs_sha256)
        source = Source(paths, "comparison", about={"model": found.document.model.model_dump(mode="json")})
        write_vtu(Path(out) / VTU, found.added_to(read_step(path)), source)
    return found.document.model_dump(mode="json")
