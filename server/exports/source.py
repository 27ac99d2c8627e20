"""Folders of results: an analysis of a data folder, a test's folder, or the output of ``stereorig measure``."""

from __future__ import annotations

from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.formats.calibrations.in_test import calibration_id_in
from stereorig.server.formats.results.folder import first_results, home_of, results_in
from stereorig.server.formats.results.reading import read_head
from stereorig.server.results.naming import analysis_name
from stereorig.server.results.staleness import stale_results
from stereorig.server.results.steps import ExportSource, failed_steps
from stereorig.server.store.durable import known_json


def find_source(folder: Path, analysis: str | None = None) -> ExportSource:
    """Return the results of a folder, with their records.

    Parameters
    ----------
    folder
        An analysis' folder, a test's, or one that ``stereorig measure --out`` wrote.
    analysis
        Id of one of a test's analyses.

    Raises
    ------
    InputError
        ``results_missing``; ``analysis_ambiguous`` if a test has several and none is named.
    """
    if (folder / "analyses").is_dir() or (folder / "steps").is_dir():
        folder = _of_test(folder, analysis)
    elif analysis is not None:
        raise InputError(
            f"{folder} is not a test's folder; it has no analyses.",
            code="option_conflict",
            remedy="Leave the analysis out, or give the test's folder.",
        )
    return source_of(folder.absolute(), first_results(folder, [folder]))


def source_of(folder: Path, files: list[Path]) -> ExportSource:
    """Return the source of an analysis' folder, or of a folder of ``stereorig measure``; or of its dense fields."""
    heads = [read_head(path) for path in files]
    # dense fields are in a folder of their own, and their copies in another frame elsewhere
    dense = "_dense" if "dense" in heads[0].attributes else ""
    folder = home_of(folder / files[0].name)
    stale, mask = stale_results(files, heads, folder), _mask(folder, heads[0].settings)
    about: dict[str, object] = {}
    failed = failed_steps(folder)
    if failed:
        about["steps_failed"] = failed
    test = folder.parent.parent  # <test>/analyses/<id>, or <test>/exports/measure
    document = known_json(test / "test.json")
    reference = heads[0].step if heads[-1].reference_step is None else heads[-1].reference_step
    image = test / "steps" / f"{reference:04d}" / "cam1.tif"
    if document or image.is_file():
        about |= {
            "test_id": document.get("id", test.name),
            "test": document.get("name", ""),
            "calibration_id": calibration_id_in(document, heads[0].inputs_sha256.get("calibration")),
            "specimen": document.get("specimen", ""),
        }
        title = str(document.get("name") or test.name)
        if folder.parent.name == "analyses":
            about["analysis_id"] = folder.name
        return ExportSource(files, analysis_name(folder) + dense, title, image, about, mask, stale, home=folder)
    image_file = heads[0].image_file("cam1")
    calibration = known_json(folder / "summary.json").get("calibration")
    if isinstance(calibration, dict) and calibration.get("file"):
        about["calibration_file"] = str(calibration["file"])
    return ExportSource(
        files,
        (folder.name or "results") + dense,
        folder.name,
        Path(image_file) if image_file else None,
        about,
        mask,
        stale,
        home=folder,
    )


def _mask(folder: Path, settings: object) -> Path | None:
    """Return the mask of the points, if it still exists: an analysis keeps its own copy."""
    region = settings.get("region") if isinstance(settings, dict) else None
    named = region.get("mask") if isinstance(region, dict) else None
    for path in (folder / "mask.png", *([Path(named)] if isinstance(named, str) else [])):
        if path.is_file():
            return path
    return None


def _of_test(test: Path, analysis: str | None) -> Path:
    there = sorted(p for p in (test / "analyses").glob("*") if results_in(p)) if (test / "analyses").is_dir() else []
    if analysis is not None:
        found = [p for p in there if p.name == analysis]
        if not found:
            known = ", ".join(p.name for p in there) or "none with results"
            raise InputError(
                f"{test} has no results of an analysis {analysis}; it has {known}.",
                code="results_missing",
                remedy="Name one of these.",
            )
        return found[0]
    measured = test / "exports" / "measure"
    if results_in(measured):
        there.append(measured)
    if len(there) > 1:
        names = ", ".join(p.name for p in there)
        raise InputError(
            f"{test} has several results: {names}.",
            code="analysis_ambiguous",
            remedy="Name one with --analysis, or give its folder.",
        )
    return there[0] if there else test
