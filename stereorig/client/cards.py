"""Tests and analyses of a service as a notebook shows them."""

from __future__ import annotations

from stereorig.client import operations
from stereorig.client.operations import Ask, Operation
from stereorig.core.errors import StereorigError
from stereorig.server.api.models import AnalysisReply, TestReply
from stereorig.server.formats.figures.card import card

_WIDTH_PX = 420


def test_card(test_id: str, url: str) -> Operation[str]:
    """Return HTML of a test: name, steps, analyses, the newest step's image of camera 1."""
    test = yield from operations.get(f"/tests/{test_id}", TestReply)
    newest, picture = test.newest_step, b""
    if newest is not None:
        shown = {"width_px": _WIDTH_PX}
        picture = yield from _picture(Ask("GET", f"/tests/{test_id}/steps/{newest.n}/cam1/preview", params=shown))
    return card(
        f"Test {test.name}",
        [
            ("id", test.id),
            ("specimen", test.specimen),
            ("steps", test.n_steps),
            ("newest step", None if newest is None else f"{newest.n} {newest.label}".strip()),
            ("analyses", ", ".join(one.id for one in test.analyses)),
            ("calibration", test.calibration_id),
            ("service", url),
        ],
        picture,
        f"camera 1 in the newest step of {test.name}",
    )


def analysis_card(path: str) -> Operation[str]:
    """Return HTML of an analysis: state, steps, settings, warnings, a map of its last finished step."""
    found = yield from operations.get(path, AnalysisReply)
    picture, last = b"", None
    if found.n_finished:
        last = (yield from operations.finished_steps(path))[-1]
        shown = {"format": "png", "step": last, "width_px": _WIDTH_PX}
        picture = yield from _picture(Ask("GET", f"{path}/export", params=shown))
    settings = found.settings
    return card(
        f"Analysis {found.id}",
        [
            ("test", found.test_id),
            ("state", found.state),
            ("steps finished", f"{found.n_finished} of {found.n_steps}, {found.n_failed} failed"),
            ("subset, spacing", f"{settings.subset_px} px, {settings.spacing_px} px"),
            ("warnings", "; ".join(one.text for one in found.warnings)),
            ("stale", "; ".join(found.stale_reasons)),
        ],
        picture,
        f"map of step {last}",
    )


def _picture(asked: Ask) -> Operation[bytes]:
    try:
        return (yield asked).content
    except StereorigError:
        return b""  # a card without its picture is better than none
