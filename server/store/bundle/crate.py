"""The RO-Crate 1.1 metadata of a bundle, by which repositories show it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath

from stereorig.server.documents.tests import AnalysisRecord, SummaryRecord, TestRecord
from stereorig.server.store.bundle.content import CRATE, MANIFEST, BundleFile

_FORMATS = {
    ".json": "application/json",
    ".tif": "image/tiff",
    ".png": "image/png",
    ".nc": "application/x-netcdf",
    ".npz": "application/zip",
    ".sha256": "text/plain",
    ".deleted": "application/json",
    ".csv": "text/csv",
}
_PERSON = ("operator", "laboratory")
Entity = dict[str, object]


@dataclass(frozen=True)
class MeasuredAnalysis:
    """An analysis and its summary, None while it has none."""

    record: AnalysisRecord
    summary: SummaryRecord | None


def crate(
    test: TestRecord,
    analyses: Iterable[MeasuredAnalysis],
    files: Mapping[str, BundleFile],
    *,
    created_utc: str,
    software_version: str,
    licence: str | None,
) -> dict[str, object]:
    """Return the content of ``ro-crate-metadata.json``.

    Parameters
    ----------
    files
        By their names in the bundle.
    licence
        Address or text of the licence of the data; None: not stated.
    """
    listed = {MANIFEST: None, **files}
    root: Entity = {
        "@id": "./",
        "@type": "Dataset",
        "name": test.name or test.id,
        "identifier": test.id,
        "description": _description(test, files),
        "datePublished": created_utc,
        "hasPart": [{"@id": name} for name in listed],
    }
    graph: list[Entity] = [
        {
            "@id": CRATE,
            "@type": "CreativeWork",
            "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
            "about": {"@id": "./"},
        },
        root,
    ]
    if licence is not None:
        root["license"] = {"@id": licence} if licence.startswith(("http://", "https://")) else licence
    if test.created_utc is not None:
        root["dateCreated"] = test.created_utc
    people = _people(test)
    if people:
        root["author"] = [{"@id": str(one["@id"])} for one in people]
    actions, programs = [], {}
    for measured in analyses:
        version = measured.record.software or "not known"
        programs[version] = {
            "@id": f"#stereorig-{version}",
            "@type": "SoftwareApplication",
            "name": "stereorig",
            "version": version,
        }
        actions.append(_action(measured, files, f"#stereorig-{version}"))
    programs.setdefault(
        software_version,
        {
            "@id": f"#stereorig-{software_version}",
            "@type": "SoftwareApplication",
            "name": "stereorig",
            "version": software_version,
        },
    )
    if actions:
        root["mentions"] = [{"@id": str(action["@id"])} for action in actions]
    graph += [_file(name, found) for name, found in listed.items()]
    return {
        "@context": ["https://w3id.org/ro/crate/1.1/context", {"sha256": "https://schema.org/sha256"}],
        "@graph": [*graph, *people, *programs.values(), *actions],
    }


def _description(test: TestRecord, files: Mapping[str, BundleFile]) -> str:
    steps = sum(name.endswith("/step.json") for name in files)
    results = sum(name.endswith(".nc") for name in files)
    about = f"{steps} pairs of images of a stereo DIC test, with calibration, settings and {results} result files"
    return f"{about}; {test.specimen}" if test.specimen else about


def _people(test: TestRecord) -> list[Entity]:
    kinds = {"operator": "Person", "laboratory": "Organization"}
    return [
        {"@id": f"#{name}", "@type": kinds[name], "name": str(test.metadata[name])}
        for name in _PERSON
        if test.metadata.get(name)
    ]


def _file(name: str, found: BundleFile | None) -> Entity:
    path = PurePosixPath(name)
    entity: Entity = {"@id": name, "@type": "File", "name": path.name, "encodingFormat": _FORMATS[path.suffix]}
    if found is None:
        return entity
    return {**entity, "contentSize": str(found.bytes), "sha256": found.sha256}


def _action(measured: MeasuredAnalysis, files: Mapping[str, BundleFile], program: str) -> Entity:
    record = measured.record
    home = f"tests/{record.test_id}"
    read = [f"{home}/steps/{n:04d}/{cam}.tif" for n in record.steps for cam in ("cam1", "cam2")]
    used = record.inputs.calibration_sha256
    copies = (f"{home}/calibrations/{used}.json", f"{home}/calibration.json")
    read += [next((name for name in copies if name in files), copies[-1])]
    made = [name for name in files if name.startswith(f"{home}/analyses/{record.id}/") and name.endswith(".nc")]
    action: Entity = {
        "@id": f"#{record.id}",
        "@type": "CreateAction",
        "name": record.label or f"{record.kind or 'displacement'} {record.id}",
        "instrument": {"@id": program},
        "object": [{"@id": name} for name in read if name in files],
        "result": [{"@id": name} for name in made],
    }
    created = None if measured.summary is None else measured.summary.plain().get("created")
    return action if created is None else {**action, "endTime": str(created)}
