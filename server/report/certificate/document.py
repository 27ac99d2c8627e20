"""A certificate: its object, its findings, its validity; as a document and as a page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from stereorig.core.certify.certify import CertificateVerdict, certify, text_of
from stereorig.core.certify.comparison import Group, Judged
from stereorig.core.names import CAMERAS
from stereorig.server.base.json_values import without_nan
from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.version import software_version
from stereorig.server.report.certificate.evidence import Gathered, gather
from stereorig.server.report.page import render
from stereorig.server.report.source import Source
from stereorig.server.results.certificate.findings import finding_lines
from stereorig.server.results.certificate.plan import CertificatePlan

FORMAT = 1
_HEADS: tuple[tuple[Group, str], ...] = (
    ("length", "Lengths over the volume"),
    ("displacement", "Displacement of known translations"),
    ("rotation", "Angles of known rotations"),
    ("strain", "Strain of a body that only moves"),
    ("static", "Rest in static pairs"),
)


@dataclass(frozen=True)
class Certificate:
    """A certificate.

    Attributes
    ----------
    document
        Plain values, for ``certificate.json``.
    page
        One HTML file that needs nothing else; a browser prints it as PDF.
    policy
        Its Content-Security-Policy.
    outcome
        ``pass``, ``conditional`` or ``fail``.
    lines
        The verdict, its reasons and the suspected causes, as text.
    """

    document: dict[str, object]
    page: bytes
    policy: str
    outcome: str
    lines: list[str]


def make_certificate(
    source: Source,
    plan: CertificatePlan,
    *,
    certificate_id: str = "",
    folder: Path | None = None,
    on_step: Callable[[int, int], None] = lambda _done, _total: None,
) -> Certificate:
    """Read the steps that a plan names, judge them, and write the certificate.

    Parameters
    ----------
    source, plan
        As in :func:`stereorig.server.report.certificate.evidence.gather`, with its errors.
    certificate_id
        Id in a data folder; empty for a certificate from files.
    folder, on_step
        As there.
    """
    gathered = gather(source, plan, folder=folder, on_step=on_step)
    verdict = certify(gathered.evidence, plan.limits)
    made = datetime.now(UTC)
    until = made + timedelta(days=plan.valid_days)
    document: dict[str, object] = {
        "format": FORMAT,
        "id": certificate_id,
        "title": plan.title or source.title,
        "outcome": verdict.outcome,
        "created_utc": _text(made),
        "valid_until_utc": None if verdict.outcome == "fail" else _text(until),
        "software_version": software_version(),
        "simulated": source.rig.simulated,
        "k": verdict.k,
        "reasons": [asdict(one) for one in verdict.reasons],
        "suspects": [asdict(one) for one in verdict.suspects],
        "noise_floor": [asdict(one) for one in verdict.floor],
        "comparisons": [_judged(one) for one in verdict.judged],
        "scales": asdict(verdict.scales),
        "extensometer": None if verdict.extensometer is None else asdict(verdict.extensometer),
        "cameras": [asdict(one) for one in gathered.evidence.cameras],
        "plan": {**plan.model_dump(mode="json"), "static_steps": gathered.static},
        "made_of": _made_of(source, gathered),
    }
    document = without_nan(document)
    page, policy = _page(document, verdict, plan, gathered)
    return Certificate(document, page, policy, verdict.outcome, lines_of(verdict))


def lines_of(verdict: CertificateVerdict) -> list[str]:
    """Return a verdict as text, the outcome last."""
    lines = finding_lines(verdict.reasons, verdict.suspects)
    largest = verdict.largest("length")
    if largest is not None:
        error, expanded = largest.comparison.error, largest.expanded
        lines.append(f"largest length error {text_of(error, 'mm')}, U {text_of(expanded, 'mm')} (k = {verdict.k:.2f})")
    if verdict.extensometer is not None:
        lines.append(f"class of the virtual extensometer: {verdict.extensometer.reached or 'none'}")
    return [*lines, f"verdict: {verdict.outcome}"]


def _text(time: datetime) -> str:
    return time.isoformat(timespec="seconds").replace("+00:00", "Z")


def _judged(one: Judged) -> dict[str, object]:
    return {**asdict(one.comparison), "error": one.comparison.error, "expanded": one.expanded, "outcome": one.outcome}


def _made_of(source: Source, gathered: Gathered) -> dict[str, object]:
    """Return ids and checksums of everything that the certificate rests on."""
    head = source.heads[max(source.heads)]
    steps: dict[str, dict[str, str | None]] = {
        str(n): {cam: one.inputs_sha256.get(cam) for cam in CAMERAS} for n, one in source.heads.items()
    }
    steps |= {str(n): {**images} for n, images in gathered.pictured.items()}
    return {
        "test_id": source.test_record.id or None,
        "analysis_id": source.analysis.id or None,
        "calibration_sha256": head.inputs_sha256.get("calibration"),
        "reference_step": source.reference,
        "steps": steps,
        "pictures_sha256": gathered.images_sha256,
        "results_sha256": {path.name: sha256_of(path) for path in source.files.values()},
        "settings": head.settings,
    }


def _page(
    document: dict[str, object], verdict: CertificateVerdict, plan: CertificatePlan, gathered: Gathered
) -> tuple[bytes, str]:
    tables = [(title, verdict.of_group(group)) for group, title in _HEADS]
    head = f"{document['title']}  \u00b7  certificate {document['id']}  \u00b7  {document['created_utc']}"
    return render(
        head,
        template="certificate.html.j2",
        document=document,
        verdict=verdict,
        plan=plan,
        tables=[(title, found) for title, found in tables if found],
        evidence=gathered.evidence,
        static=gathered.static,
        text_of=lambda value, unit: text_of(value, unit).replace(" um", " \u00b5m"),
    )
