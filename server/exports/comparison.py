"""Comparisons with models as tasks of the export process."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stereorig.server.formats.models.read import ModelFile
from stereorig.server.results.models.request import CompareRequest

VTU = "comparison.vtu"


def compare_task(
    files: Sequence[str], model: str, read: ModelFile, name: str, request: CompareRequest, out: str | None = None
) -> dict[str, object]:
    """Compare a step with a model; return the comparison's document, and write the VTU into the folder ``out``."""
    from stereorig.server.exports.vtu import write_vtu
    from stereorig.server.results.models.compare import compare_files
    from stereorig.server.results.steps import ExportSource, read_step

    paths = [Path(file) for file in files]
    found = compare_files(paths, Path(model), request, read=read, model_name=name)
    if out is not None:
        path = next(file for file in paths if file.name in found.document.inputs_sha256)
        source = ExportSource(paths, "comparison", about={"model": found.document.model.model_dump(mode="json")})
        write_vtu(Path(out) / VTU, found.added_to(read_step(path)), source)
    return found.document.model_dump(mode="json")
