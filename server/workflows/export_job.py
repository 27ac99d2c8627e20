"""Exports as jobs: with progress, to be cancelled, their file kept for a while."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from stereorig.server.exports.request import ExportRequest
from stereorig.server.formats.results.folder import home_of
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.workflows.analysis.framed import file_in, variable_of_frame
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import result_of


def start_export(
    service: Service, test_id: str, analysis_id: str, files: Sequence[Path], request: ExportRequest, frame: str | None
) -> Job:
    """Begin an export of an analysis' result files as a job; ``GET /jobs/{id}/file`` answers with the file.

    Raises
    ------
    QueueFullError
        ``exports_waiting`` if four are on their way.
    """
    service.exports.check_room()

    def run(job: Job) -> dict[str, object]:
        folder = service.exports.new_folder()
        try:
            framed = _in_frame(service, job, files, request, frame, folder / "frame")
            task = service.exports.submit(home_of(files[0]), framed, request, folder)
            made = service.exports.keep(job.id, Path(result_of(task, job)))
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        return {"file": made.name, "bytes": made.stat().st_size, "format": request.format}

    subject = {"test_id": test_id, "analysis_id": analysis_id}
    return service.jobs.submit("export", "export", subject, [Phase("beside", run)])


def _in_frame(
    service: Service, job: Job, files: Sequence[Path], request: ExportRequest, frame: str | None, folder: Path
) -> list[Path]:
    """Return the result files in a frame: those that the page has shown are there already."""
    test_id, analysis_id = str(job.subject["test_id"]), str(job.subject["analysis_id"])
    name = variable_of_frame(request.drawn_variables)
    folder.mkdir()
    framed = []
    for k, file in enumerate(files):
        job.check()
        job.progress("reading", k, len(files))
        there = file_in(service, test_id, analysis_id, file, frame, name)
        try:  # the kept ones may go while the export reads
            os.link(there, folder / file.name)
            framed.append(folder / file.name)
        except OSError:
            framed.append(there)
    return framed
