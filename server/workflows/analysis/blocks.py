"""Plan of a sequence in blocks that are measured side by side, with the results of one after the other.

Steps of a block follow one another. The first of a block, its head, is matched against the current reference from
seeds; once the block before is through, it is measured again from that block's last step: the joint. If both agree,
the block is accepted. If not, its steps are measured again from the joint on, until one agrees with its earlier
result. A step that changed to another reference gives all later blocks new heads. A block whose head cannot be found
waits, and begins from the last step of the block before.

The plan only decides: the next measurement, and the consequences of an outcome. Nothing here measures or waits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

from stereorig.core.errors import StereorigError
from stereorig.server.compute.tasks import Earlier
from stereorig.server.workflows.analysis.block import Block, BlockStep, Kind, Outcome, Summary, agrees, reference_of

#: a head and a joint cost two to four steps
SHORTEST = 4
#: the steps whose outcome is certain grow block by block
LONGEST = 64


class Blocks:
    """The plan: :meth:`ask` returns the next measurement, :meth:`ended` takes its outcome.

    Parameters
    ----------
    order
        The steps to measure, in their order; at least one.
    previous
        The last good step before them: the first reference at the beginning.
    reference
        Reference that the next step is matched against first; the first one is ``first``.
    width
        Number of measurements that run at once.
    known
        Summaries of steps in ``order`` that were measured, but not from the steps before them.
    """

    def __init__(
        self,
        order: Sequence[int],
        *,
        previous: int,
        reference: int,
        first: int,
        width: int,
        references: Sequence[int] = (),
        known: Mapping[int, Summary] | None = None,
    ) -> None:
        self._before, self._first, self._reference = previous, first, reference
        self._references = list(references)
        self._generation = 0
        self._busy: set[int] = set()
        known = dict(known or {})
        length = min(max(-(-len(order) // max(width, 1)), SHORTEST), LONGEST)
        self._blocks: list[Block] = []
        for run in _runs(order, known):
            if run[0] in known:
                outcomes: dict[int, Outcome] = {n: known[n] for n in run}
                reference = reference_of(known[run[0]], first)
                block = Block(run, reference, "there", "open", "step", at=len(run), outcomes=outcomes)
                self._blocks.append(block)
                reference = reference_of(known[run[-1]], first)
            else:
                for start in range(0, len(run), length):
                    whole = self._blocks and len(run) - start >= SHORTEST
                    head: Literal["none", "open"] = "open" if whole else "none"
                    self._blocks.append(Block(run[start : start + length], reference, head))
                    if start + length < len(run) < start + length + SHORTEST:  # too short for one of its own
                        self._blocks[-1].steps += run[start + length :]
                        break

    @property
    def through(self) -> bool:
        """True if nothing is left to do."""
        return all(b.through and b.joint != "open" and b.running is None for b in self._blocks)

    @property
    def size(self) -> int:
        """Number of steps."""
        return sum(len(b.steps) for b in self._blocks)

    @property
    def ahead(self) -> int:
        """Number of steps that are measured, accepted or not."""
        return sum(b.at for b in self._blocks)

    def ask(self) -> BlockStep | None:
        """Return the next possible measurement, the earliest step first; None if all must wait for the end of another.

        If no block has work, the block with the most steps left is cut in two.
        """
        found = self._next()
        return self._next() if found is None and self._cut() else found

    def _next(self) -> BlockStep | None:
        for i, block in enumerate(self._blocks):
            if block.running is None:
                ask = self._of(i, block)
                if ask is not None and ask.n not in self._busy:
                    block.running = ask
                    self._busy.add(ask.n)
                    return ask
        return None

    def ended(self, ask: BlockStep, outcome: Outcome) -> None:
        """Take the outcome of a measurement: a step's summary, or the error that prevented it."""
        self._busy.discard(ask.n)
        block = ask.block
        block.running = None
        if block not in self._blocks:
            return  # of another reference
        i = self._blocks.index(block)
        if ask.kind == "head":
            if isinstance(outcome, StereorigError):
                block.head = "missing"
            else:
                block.head, block.joint, block.at = "there", "open", 1
        elif ask.kind == "step":
            block.at += 1
            if block.stale:  # from a step that has been replaced
                block.stale = False
                self._from_start(block)
            self._put(i, ask.n, outcome)
        elif ask.kind == "joint" and block.stale:
            block.stale, block.compared = False, None  # the result that it was compared with is overwritten
        elif ask.kind == "joint":
            block.joint = "through"
            self._put(i, ask.n, outcome)
            agreed = agrees(outcome)
            if not agreed:
                self._generation += 1
                block.again = 1 if block.at > 1 else None
                self._replaced(i, ask.n)
            if block.again is None and not any(map(block.good, block.steps[1:])):
                self._if_last(i)
        else:
            assert block.again is not None
            block.again += 1
            self._put(i, ask.n, outcome)
            agreed = agrees(outcome)
            if not agreed:
                self._replaced(i, ask.n)
            if block.stale:
                block.stale = False
                self._from_start(block)
            elif agreed and block.again >= block.at_least:
                block.again, block.at_least = None, 0
            elif block.again == block.at:
                block.again, block.at_least = None, 0
                self._if_last(i)

    def certain(self) -> Iterator[tuple[int, Outcome]]:
        """Yield in order the steps whose outcome is the same as if all were measured one after another."""
        for block in self._blocks:
            if block.joint == "open" or block.stale:
                return
            for n in block.steps[: block.at if block.again is None else block.again]:
                if n in block.outcomes:
                    yield n, block.outcomes[n]
            if not block.through or block.head == "open":
                return

    def _cut(self) -> bool:
        """Make a block of its own of the last steps of another one; return False if all are short."""
        left = [len(b.steps) - b.at if b.at > 0 or b.running is not None else 0 for b in self._blocks]
        i = left.index(max(left))
        if left[i] < 2 * SHORTEST + 1:
            return False
        block = self._blocks[i]
        half = len(block.steps) - left[i] // 2
        steps, block.steps = block.steps[half:], block.steps[:half]
        measured = [n for n in block.steps if block.good(n)]
        reference = self._reference_before(i, block.steps[block.at])
        if measured:
            reference = reference_of(block.outcomes[measured[-1]], self._first)
        self._blocks.insert(i + 1, Block(steps, reference, "open"))
        return True

    # measurements that are possible -----------------------------------------------------------------------------

    def _of(self, i: int, block: Block) -> BlockStep | None:
        through_before = all(b.through for b in self._blocks[max(i - 1, 0) : i])
        if block.again == 0 and not through_before:
            return None
        if block.again is not None:
            n = block.steps[block.again]
            return self._make(block, "again", n, previous=self._good_before(i, block.again), compared="step")
        if block.head == "open":
            return self._make(block, "head", block.steps[0], against=block.against)
        if block.joint == "open" and through_before and block.at > 0:
            return self._make(block, "joint", block.steps[0], previous=self._good_before(i, 0), compared=block.compared)
        if block.at < len(block.steps) and (block.at > 0 or through_before):
            from_head = block.joint == "open" and not any(map(block.good, block.steps[1 : block.at]))
            previous = block.steps[0] if from_head else self._good_before(i, block.at)
            return self._make(block, "step", block.steps[block.at], previous=previous, from_head=from_head)
        return None

    def _make(
        self,
        block: Block,
        kind: Kind,
        n: int,
        *,
        previous: int | None = None,
        from_head: bool = False,
        against: int | None = None,
        compared: Earlier | None = None,
    ) -> BlockStep:
        return BlockStep(
            block, kind, n, previous, from_head, against, compared, tuple(self._references), self._generation
        )

    def _good_before(self, i: int, index: int) -> int:
        """Return the last step that was measured before one of a block."""
        for k in range(i, -1, -1):
            block = self._blocks[k]
            for n in reversed(block.steps[: index if k == i else len(block.steps)]):
                if block.good(n):
                    return n
        return self._before

    # consequences of an outcome ---------------------------------------------------------------------------------

    def _put(self, i: int, n: int, outcome: Outcome) -> None:
        """Take an outcome; if the step changed to a later reference, later blocks begin again from it."""
        block, old = self._blocks[i], set()
        if block.good(n):
            old.add(reference_of(block.outcomes[n], self._first))
        block.outcomes[n] = outcome
        if isinstance(outcome, StereorigError):
            return
        reference = reference_of(outcome, self._first)
        old.add(self._reference_before(i, n))
        if reference not in (self._first, *self._references):
            self._references.append(reference)
        if old != {reference}:
            self._begin_anew(i, old - {reference}, reference)

    def _reference_before(self, i: int, n: int) -> int:
        """Return the reference of the last step before one."""
        block = self._blocks[i]
        index = block.steps.index(n)
        own = [k for k in block.steps[:index] if block.good(k)]
        if not own and index > 0 and block.joint == "open" and block.against is not None:
            return block.against  # as its head
        last = own[-1] if own else self._good_before(i, 0)
        for one in self._blocks:
            if one.good(last):
                return reference_of(one.outcomes[last], self._first)
        return self._reference

    def _begin_anew(self, i: int, old: set[int], reference: int) -> None:
        anew = [k for k in range(i + 1, len(self._blocks)) if self._blocks[k].against in old]
        for k in anew:
            self._blocks[k] = Block(self._blocks[k].steps, reference, "open")
        for k in anew:
            self._if_last(k)

    def _replaced(self, i: int, n: int) -> None:
        """Begin again the steps that are matched against a step that was measured again with another outcome."""
        if n in self._references:
            self._begin_anew(i, {n}, n)

    def _if_last(self, i: int) -> None:
        """The last step of a block may have changed: steps that began from it are measured again."""
        if i + 1 == len(self._blocks):
            return
        after = self._blocks[i + 1]
        running = None if after.running is None else after.running.kind
        alone = after.joint == "none"
        if running == "joint" or (alone and (running == "again" or (running == "step" and after.at == 0))):
            after.stale = True
        elif after.joint == "through":
            after.joint, after.compared = "open", "step"
        elif alone and after.at > 0:
            self._from_start(after)

    def _from_start(self, block: Block) -> None:
        """Measure a block without a head again, since the step before it was replaced."""
        if block.again is not None:
            block.at_least = max(block.at_least, block.again + 1)
        block.again = 0
        self._generation += 1


def _runs(order: Sequence[int], known: Mapping[int, Summary]) -> Iterator[list[int]]:
    """Yield the steps cut where measured and other ones meet."""
    run: list[int] = []
    for n in order:
        if run and (n in known) != (run[-1] in known):
            yield run
            run = []
        run.append(n)
    if run:
        yield run
