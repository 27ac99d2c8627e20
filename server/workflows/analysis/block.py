"""A block of a sequence, and the measurements that a plan of blocks asks for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from stereorig.core.errors import StereorigError
from stereorig.server.compute.tasks import Earlier

Summary = Mapping[str, object]
Outcome = Summary | StereorigError
Kind = Literal["head", "step", "joint", "again"]


@dataclass(frozen=True, eq=False)
class BlockStep:
    """A measurement that can be done now.

    Attributes
    ----------
    block, kind, n
        The block, the kind of measurement, and the step's number.
    previous
        Step that gives the start values, None for a head; ``from_head``: as the head of its block measured it.
    against
        The reference of a head; None for other kinds.
    compared
        The earlier result that the measurement is compared with.
    references
        Steps that have been references so far, the first one not among them.
    generation
        Larger once results have been replaced.
    """

    block: Block
    kind: Kind
    n: int
    previous: int | None
    from_head: bool
    against: int | None
    compared: Earlier | None
    references: tuple[int, ...]
    generation: int


@dataclass(eq=False)
class Block:
    """Steps that follow one another, and how far they are."""

    steps: list[int]
    against: int | None  # reference of its head; None: it begins from the last step of the block before
    head: Literal["none", "open", "there", "missing"] = "none"
    joint: Literal["none", "open", "through"] = "none"
    compared: Earlier | None = "head"
    at: int = 0  # index of the step to be measured next
    again: int | None = None  # index of the step to be measured again next
    at_least: int = 0  # agreement before this index does not end measuring again: an earlier round had to reach it
    running: BlockStep | None = None
    stale: bool = False  # the step before the one that runs was replaced
    outcomes: dict[int, Outcome] = field(default_factory=dict)

    @property
    def through(self) -> bool:
        """True if all its steps are measured, and none is to be measured again."""
        return self.at == len(self.steps) and self.again is None

    def good(self, n: int) -> bool:
        """Return True if a step is measured."""
        return n in self.outcomes and not isinstance(self.outcomes[n], StereorigError)


def reference_of(outcome: Outcome, first: int) -> int:
    """Return the reference that a step was matched against; the first one of a step that failed."""
    found = None if isinstance(outcome, StereorigError) else outcome.get("reference_step")
    return first if found is None else int(str(found))


def agrees(outcome: Outcome) -> bool:
    """Return True if the new measurement agrees with the earlier one from the same step before."""
    return not isinstance(outcome, StereorigError) and bool(outcome.get("agrees"))
