"""What a certificate found, as lines of text: the same for one made here and for one that a service made."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol


class Finding(Protocol):
    """A suspect: its stable name, its figures, what to do."""

    @property
    def code(self) -> str: ...
    @property
    def text(self) -> str: ...
    @property
    def remedy(self) -> str: ...


class Reason(Finding, Protocol):
    """Why a verdict is no pass."""

    @property
    def outcome(self) -> str: ...


def finding_lines(reasons: Iterable[Reason], suspects: Iterable[Finding]) -> list[str]:
    """Return reasons and suspects as text, a line each."""
    lines = [f"{one.outcome}: {one.code}: {one.text} Remedy: {one.remedy}" for one in reasons]
    return lines + [f"suspect: {one.code}: {one.text} Remedy: {one.remedy}" for one in suspects]
