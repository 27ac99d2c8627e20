"""A projected pattern does not move with the surface: shape can be measured, displacement cannot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from stereorig.core.errors import InputError
from stereorig.core.settings import AnalysisSettings
from stereorig.server.formats.results.variables import VARIABLES

if TYPE_CHECKING:  # a measurement's start needs no gauges' models
    from stereorig.server.results.gauges.request import GaugeRequest

_OF_DISPLACEMENT = frozenset(name for name, one in VARIABLES.items() if one.relative)


def check_settings(settings: AnalysisSettings, *, displacement: bool) -> None:
    """Refuse settings that need a texture on the surface.

    Parameters
    ----------
    settings
        Those asked for.
    displacement
        True if displacements are asked for.

    Raises
    ------
    InputError
        ``pattern_projected``.
    """
    if settings.pattern != "projected":
        return
    for asked, what in (
        (displacement, "displacement"),
        (settings.strain is not None, "strain"),
        (settings.smoothing_window is not None, "a smoothed displacement"),
        (settings.reference_update != "never", "a later reference"),
    ):
        if asked:
            raise _refusal(what)


def check_gauges(request: GaugeRequest, settings: Mapping[str, object]) -> None:
    """Refuse gauges on results of a projected pattern that follow points of the surface.

    Raises
    ------
    InputError
        ``pattern_projected``.
    """
    if settings.get("pattern") != "projected":
        return
    moving = [name for name in request.variables or () if name in _OF_DISPLACEMENT]
    for asked, what in (
        (bool(request.extensometers), "an extensometer"),
        (request.remove_rigid is not None, "a rigid motion"),
        (bool(moving), ", ".join(moving)),
    ):
        if asked:
            raise _refusal(what)


def _refusal(what: str) -> InputError:
    return InputError(
        f"The pattern is projected and does not move with the surface: {what} cannot be measured from it.",
        code="pattern_projected",
        remedy="Measure the shape of each step (kind = 'profile'; stereorig measure --projected), or put a texture on "
        "the surface.",
    )
