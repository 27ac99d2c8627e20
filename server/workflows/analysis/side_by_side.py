"""The steps of an analysis in blocks: the plan's asks as tasks of the executor, their outcomes back to the plan."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from stereorig.core.errors import StereorigError
from stereorig.server.compute.functions import measure_step
from stereorig.server.compute.tasks import StepTask
from stereorig.server.documents.tests import AnalysisRecord, StepOutcome
from stereorig.server.formats.results.layout import stored_settings
from stereorig.server.jobs.job import Job
from stereorig.server.worker.executor import TaskFuture
from stereorig.server.workflows.analysis.block import BlockStep, Outcome
from stereorig.server.workflows.analysis.blocks import SHORTEST, Blocks
from stereorig.server.workflows.analysis.tasks import task_of
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import SideBySide


def goes_in_blocks(
    service: Service, document: AnalysisRecord, steps: Sequence[int], summaries: Mapping[int, StepOutcome]
) -> bool:
    """Return True if the rest is measured in blocks: it was begun so, or has enough steps for several workers.

    Parameters
    ----------
    steps
        The steps left; of a continued run also some that are measured.
    summaries
        Summaries of the measured steps.
    """
    settings = stored_settings(document.settings)
    if settings.side_by_side == "never" or settings.reference_update == "always":
        return False
    open_steps = [n for n in steps if not is_certain(summaries.get(n)) and n != document.steps[0]]
    if open_steps and service.tests.analyses.has_heads(document.test_id, document.id):
        return True
    return len(open_steps) >= 2 * SHORTEST and service.executor.width > 1


def is_certain(summary: StepOutcome | None) -> bool:
    """Return True for an announced step; a worker's summary alone does not show that the steps before it are final."""
    return summary is not None and summary.wall_s is not None


def measure_in_blocks(
    service: Service,
    document: AnalysisRecord,
    job: Job,
    plan: Blocks,
    prepare: Callable[[int], None],
    refuse: Callable[[int, StereorigError], None],
    take: Callable[[Job, int, Outcome], None],
    progress: Callable[[float], None],
) -> None:
    """Do the measurements that a plan asks for, as many at once as the executor takes.

    Parameters
    ----------
    prepare
        Called with a step before it is measured; raises an error if it cannot be.
    refuse
        Called with an error; raises it if it ends the whole.
    take
        Called with each step and its outcome once that is certain, in order.
    progress
        Called with the number of steps measured.
    """
    parts: dict[int, float] = {}
    asked: dict[TaskFuture, tuple[BlockStep, float]] = {}
    certain = 0

    def shown(number: int, _phase: str, share: float) -> None:
        parts[number] = share
        progress(plan.ahead + sum(parts.values()))

    def outcome_of(ask: BlockStep, future: TaskFuture, started: float) -> Outcome:
        try:
            return {**future.result(), "wall_s": time.monotonic() - started}
        except StereorigError as error:
            refuse(ask.n, error)
            return error

    def ended(ask: BlockStep, outcome: Outcome) -> None:
        nonlocal certain
        plan.ended(ask, outcome)
        for n, found in itertools.islice(plan.certain(), certain, None):
            certain += 1
            take(job, n, found)

    with SideBySide(service.executor, job, shown) as side:
        while not plan.through:
            while side.has_room and (ask := plan.ask()) is not None:
                try:
                    prepare(ask.n)
                    task = _task_of(service, document, ask)
                except StereorigError as error:
                    refuse(ask.n, error)
                    ended(ask, error)
                else:
                    asked[side.submit(ask.n, measure_step, task)] = ask, time.monotonic()
            for n, future in side.ended():
                parts.pop(n, None)
                ask, started = asked.pop(future)
                ended(ask, outcome_of(ask, future, started))


def _task_of(service: Service, document: AnalysisRecord, ask: BlockStep) -> StepTask:
    needed = [n for n in ask.references if n != ask.previous] + ([] if ask.previous is None else [ask.previous])
    earlier = {n: service.tests.steps.read(document.test_id, n) for n in needed}
    if ask.against is None:  # a head is no result
        service.tests.analyses.begin_step(document.test_id, document.id, ask.n)
    return replace(
        task_of(service.tests, document, ask.n, earlier, None),
        previous=ask.previous,
        against=ask.against,
        from_head=ask.from_head,
        compared=ask.compared,
        generation=ask.generation,
    )
