"""The plan of a sequence in blocks, against the same sequence one step after another, in a world of simple rules."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from stereorig.core.errors import MeasurementError, SeedError, StereorigError
from stereorig.server.workflows.analysis.block import BlockStep
from stereorig.server.workflows.analysis.blocks import LONGEST, Blocks

FIRST = 0


@dataclass
class World:
    """Steps whose outcome depends on the step before, on the reference, and on nothing else.

    A reference serves for ``reach`` steps; then the step before replaces it. From step ``flips`` on a kind is kept that
    a head does not see before step ``seen``. Steps in ``broken`` cannot be measured; heads in ``lost`` cannot be found.
    """

    steps: int
    reach: int = 10_000
    flips: int = 10_000
    seen: int = 0
    broken: frozenset[int] = frozenset()
    lost: frozenset[int] = frozenset()
    #: by name, what is on the disk: the reference of a step, and its kind
    files: dict[tuple[str, int], tuple[int, str]] = field(default_factory=dict)

    def follow(self, n: int, before: int, found: tuple[int, str]) -> tuple[int, str]:
        """A step measured from the one before it."""
        if n in self.broken:
            raise MeasurementError(f"step {n}")
        reference, kind = found
        return before if n - reference > self.reach else reference, "b" if kind == "b" or n == self.flips else "a"

    def begin(self, n: int, against: int) -> tuple[int, str]:
        """A step measured from seeds."""
        if n in self.broken | self.lost or n - against > self.reach:
            raise SeedError(f"step {n}")
        return against, "b" if n >= max(self.flips, self.seen) else "a"

    def in_order(self) -> dict[int, tuple[int, str] | None]:
        last, found = FIRST, (FIRST, "a")
        out: dict[int, tuple[int, str] | None] = {}
        for n in range(1, self.steps):
            try:
                found = out[n] = self.follow(n, last, found)
                last = n
            except MeasurementError:
                out[n] = None
        return out

    def work(self, ask: BlockStep) -> tuple[str, Any]:
        """Read what an ask needs when it begins; return what is to be written when it ends."""
        try:
            if ask.kind == "head":
                assert ask.against is not None
                return "head", self.begin(ask.n, ask.against)
            assert ask.previous is not None
            name = "head" if ask.from_head else "step"
            before = (FIRST, "a") if ask.previous == FIRST else self.files[name, ask.previous]
            return "step", self.follow(ask.n, ask.previous, before)
        except StereorigError as error:
            return "", error

    def end(self, ask: BlockStep, done: tuple[str, Any]) -> Any:
        name, found = done
        if isinstance(found, StereorigError):
            return found
        more = {}
        if ask.compared is not None:
            more["agrees"] = self.files.get((ask.compared, ask.n)) == found
        self.files[name, ask.n] = found
        if name == "head":
            return {"n": ask.n}
        return {"n": ask.n, "reference_step": None if found[0] == FIRST else found[0], "kind": found[1], **more}


def run(world: World, plan: Blocks, width: int, seed: int, stop_after: int | None = None) -> list[tuple[int, Any]]:
    """Let ``width`` workers do what the plan asks for, ending in any order; return what was certain, as it came."""
    rng = np.random.default_rng(seed)
    running: list[tuple[BlockStep, tuple[str, Any]]] = []
    certain: list[tuple[int, Any]] = []
    for count in itertools.count():
        assert count < 50 * world.steps, "it never ends"
        while len(running) < width and (ask := plan.ask()) is not None:
            assert all(ask.n != other.n for other, _ in running), "two write the same file"
            running.append((ask, world.work(ask)))
        if not running:
            break
        ask, done = running.pop(int(rng.integers(len(running))))
        plan.ended(ask, world.end(ask, done))
        now = list(plan.certain())
        assert [n for n, _ in now[: len(certain)]] == [n for n, _ in certain]
        assert all(a is b for (_, a), (_, b) in zip(certain, now, strict=False)), "what was certain has changed"
        certain = now
        if stop_after is not None and len(world.files) >= stop_after:
            return certain
    assert plan.through
    return certain


def plan_of(world: World, width: int, **more: Any) -> Blocks:
    order = list(range(1, world.steps))
    return Blocks(order, previous=FIRST, reference=FIRST, first=FIRST, width=width, **more)


def assert_in_order(world: World, certain: list[tuple[int, Any]]) -> None:
    wanted = world.in_order()
    assert [n for n, _ in certain] == list(wanted)
    for n, outcome in certain:
        if wanted[n] is None:
            assert isinstance(outcome, StereorigError)
        else:
            assert (outcome["reference_step"] or FIRST, outcome["kind"]) == wanted[n]
            assert world.files["step", n] == wanted[n]


WORLDS = {
    "one reference": {},
    "a new reference now and then": {"reach": 9},
    "a new reference every other step": {"reach": 2},
    "a kind that heads do not see for a while": {"flips": 7, "seen": 40},
    "a kind that heads never see, and references": {"flips": 11, "seen": 10_000, "reach": 13},
    "steps that fail": {"broken": frozenset({5, 6, 17, 18, 33, 59}), "reach": 20},
    "whole blocks that fail": {"broken": frozenset(range(16, 33))},
    "heads that are not found": {"lost": frozenset(range(9, 60, 3))},
}


@pytest.mark.parametrize("width", [2, 5, 64])
@pytest.mark.parametrize("name", list(WORLDS))
def test_blocks_give_the_same_outcomes_as_one_step_after_another(name: str, width: int) -> None:
    for seed in range(12):
        world = World(61, **WORLDS[name])  # type: ignore[arg-type]
        assert_in_order(world, run(world, plan_of(world, width), width, seed))


@pytest.mark.parametrize("name", list(WORLDS))
def test_a_plan_continues_from_another_plan_s_results(name: str) -> None:
    for seed in range(12):
        world = World(61, **WORLDS[name])  # type: ignore[arg-type]
        certain = run(world, plan_of(world, 5), 5, seed, stop_after=20 + seed)
        assert len(certain) < 60
        done = [(n, found) for n, found in certain if not isinstance(found, StereorigError)]
        after = done[-1][0] if done else FIRST
        known = {
            n: {"n": n, "reference_step": found[0], "kind": found[1]}
            for (name_, n), found in world.files.items()
            if name_ == "step" and n > after
        }
        references = [found["reference_step"] for _, found in done if found["reference_step"] is not None]
        plan = Blocks(
            list(range(after + 1, world.steps)),
            previous=after,
            reference=references[-1] if references else FIRST,
            first=FIRST,
            width=5,
            references=list(dict.fromkeys(references)),
            known=known,
        )
        rest = run(world, plan, 5, seed + 100)
        before = [(n, found) for n, found in certain if n <= after]
        assert_in_order(world, before + rest)


def test_with_one_reference_only_heads_and_joints_are_measured_besides() -> None:
    world = World(129)
    plan, asked = plan_of(world, 4), []
    while (ask := plan.ask()) is not None:
        asked.append(ask)
        plan.ended(ask, world.end(ask, world.work(ask)))
    kinds = [ask.kind for ask in asked]
    assert (kinds.count("step"), kinds.count("head"), kinds.count("joint")) == (125, 3, 3)
    assert LONGEST >= 129 // 4
    assert all(set(ask.references) == set() for ask in asked)
