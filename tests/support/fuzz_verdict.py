"""What a run of the schema fuzzer must not find."""

from __future__ import annotations

from pathlib import Path

from tests.support.requirements import missing


def check_fuzz(folder: Path, *, phases: tuple[str, ...], each: int, seed: int, min_cases: int) -> None:
    """Run phases, and fail with everything that they found."""
    try:
        from tests.support.api_fuzz import fuzz, running_service
    except ImportError:  # pragma: no cover - CI has it
        missing("schemathesis (pip install '.[dev]')")
        return
    with running_service(folder) as service:
        report = fuzz(service, cases_each=each, seed=seed, phases=phases)
    print(f"{report.cases} cases in {report.seconds:.0f} s, {report.phases}, {dict(sorted(report.statuses.items()))}")
    found = "\n\n".join(f"{name}\n{text}" for name, text in report.failures.items())
    assert not report.failures, found
    assert not report.errors, report.errors
    undocumented = {status for status in report.statuses if status >= 500} - {503, 507}
    assert not undocumented
    assert report.cases >= min_cases
    # enough must get past the door, or nothing is tried; most values at and beyond bounds are wrong on purpose
    assert sum(n for status, n in report.statuses.items() if status < 300) > 0.03 * report.cases
