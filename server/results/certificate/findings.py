"""Findings of a certificate as lines of text: the same for one made here and for one that a service made."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol


class FindingText(Protocol):
    """A suspect."""

    @property
    def code(self) -> str:
        """Its stable name."""

    @property
    def text(self) -> str:
        """The finding with its figures."""

    @property
    def remedy(self) -> str:
        """Advice on the finding."""


class ReasonText(FindingText, Protocol):
    """Why a verdict is no pass."""

    @property
    def outcome(self) -> str:
        """Lowest verdict that this finding allows."""


def finding_lines(reasons: Iterable[ReasonText], suspects: Iterable[FindingText]) -> list[str]:
    """Return reasons and suspects as text, a line each."""
    lines = [f"{one.outcome}: {one.code}: {one.text} Remedy: {one.remedy}" for one in reasons]
    return lines + [f"suspect: {one.code}: {one.text} Remedy: {one.remedy}" for one in suspects]
