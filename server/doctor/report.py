"""Findings of the doctor: checks with a state, and the verdict over all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from stereorig.core.errors import StereorigError

State = Literal["ok", "warning", "failed", "not checked"]


class Check(BaseModel):
    """One check."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    part: str = Field(description="Part of the bench: `software`, `machine`, `disk`, `cam1`, `pairs`, `stage` ...")
    name: str = Field(description="Name of the check.")
    state: State = Field(description="`failed` makes the verdict bad; `warning` and `not checked` do not.")
    found: str = Field(description="The measured value, or the cause, in words.")
    limit: str | None = Field(None, description="Limit of the value; null if there is none.")
    remedy: str | None = Field(None, description="Remedy, when it is not ok.")
    figures: dict[str, float | None] = Field(
        default_factory=dict, description="The measured values; units are in the names, null is unknown."
    )


class AllChecks(BaseModel):
    """All checks."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    version: str = Field(description="Version of this software.")
    rig: str | None = Field(description="Name of the rig; null if the rig file could not be read.")
    config: str = Field(description="The rig file.")
    seconds: float = Field(description="Longest time that the cameras were watched for, s.")
    checks: list[Check] = Field(description="In the order in which they were made.")
    good: bool = Field(description="True if no check failed.")
    verdict: str = Field(description="The verdict in one line.")


class Notebook:
    """Takes checks as they are made.

    Parameters
    ----------
    on_check
        Called with each check at once.
    """

    def __init__(self, on_check: Callable[[Check], None] | None = None) -> None:
        self.checks: list[Check] = []
        self._on_check = on_check

    def note(
        self,
        part: str,
        name: str,
        state: State,
        found: str,
        *,
        limit: str | None = None,
        remedy: str | None = None,
        figures: Mapping[str, float | None] | None = None,
        **more: float | None,
    ) -> None:
        """Write a check down; figures come as a mapping or by keyword."""
        shown = None if state == "ok" else remedy
        check = Check(
            part=part,
            name=name,
            state=state,
            found=found,
            limit=limit,
            remedy=shown,
            figures={**(figures or {}), **more},
        )
        self.checks.append(check)
        if self._on_check is not None:
            self._on_check(check)

    def fail(self, part: str, name: str, error: StereorigError) -> None:
        """Record an error as a failed check."""
        self.note(part, name, "failed", f"{error.code}: {error.cause}", remedy=error.remedy)

    @contextmanager
    def guard(self, part: str, name: str) -> Iterator[None]:
        """Turn an expected error of the body into a failed check."""
        try:
            yield
        except StereorigError as error:
            self.fail(part, name, error)

    def verdict(self) -> tuple[bool, str]:
        """Return whether all is good, and the verdict in one line."""
        count = {state: sum(check.state == state for check in self.checks) for state in ("failed", "warning")}
        skipped = sum(check.state == "not checked" for check in self.checks)
        rest = [f"{count['warning']} warning{'s' * (count['warning'] != 1)}"] if count["warning"] else []
        rest += [f"{skipped} not checked"] if skipped else []
        tail = f" ({', '.join(rest)})" if rest else ""
        if count["failed"]:
            return False, f"NOT GOOD: {count['failed']} of {len(self.checks)} checks failed{tail}"
        return True, f"GOOD: none of {len(self.checks)} checks failed{tail}"


def line_of(check: Check) -> str:
    """Return a check as text: one line, and a second one with the remedy if it has one."""
    limit = f"   [limit: {check.limit}]" if check.limit else ""
    text = f"{check.state:<12}{check.part + ' ' + check.name:<28}{check.found}{limit}"
    return text if check.remedy is None else f"{text}\n{'':<12}-> {check.remedy}"


def percentile(values: list[float], share: float) -> float:
    """Return the smallest value that ``share`` of all values do not exceed."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]
