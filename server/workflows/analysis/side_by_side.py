"""The steps of an analysis in blocks: the plan's asks as tasks of the executor, their outcomes back to the plan."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from core.errors import StereorigError
from server.formats.results.settings import stored_settings
from server.jobs.job import Job
from server.store.documents import AnalysisRecord, StepOutcome
from server.worker.executor import TaskFuture
from server.worker.tasks import StepTask, measure_step
from server.workflows.analysis.block import Ask, Outcome
from server.workflows.analysis.blocks import SHORTEST, Blocks
from server.workflows.analysis.tasks import task_of
from server.workflows.service import Service
from server.workflows.waiting import SideBySide


def goes_in_blocks(
    service: Service, document: AnalysisRecord, steps: Sequence[int], summaries: Mapping[int, StepOutcome]
) -> bool:
    """Return True if what is left is measured in blocks: what was begun so, or enough steps for several workers.

    Parameters
    ----------
    steps
        Those that are left, and of a run that goes on some that are measured.
    summaries
        Of the steps that are measured.
    """
    settings = stored_settings(document.settings)
    if settings.side_by_side == "never" or settings.reference_update == "always":
        return False
    open_steps = [n for n in steps if not is_certain(summaries.get(n)) and n != document.steps[0]]
    if open_steps and service.tests.analyses.has_heads(document.test_id, document.id):
        return True
    return len(open_steps) >= 2 * SHORTEST and service.executor.width > 1


def has_helpers(service: Service, document: AnalysisRecord, steps: int) -> bool:
    """Return True if workers are left to help where so many steps are measured at once."""
    executor = service.executor
    if stored_settings(document.settings).split_step == "never" or not executor.shares_files:
        return False
    return executor.width > steps


def is_certain(summary: StepOutcome | None) -> bool:
    """Return True for a step that was announced: its worker alone does not know that what came before it stands."""
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
    """Do what a plan asks for, as much at once as the executor takes.

    Parameters
    ----------
    prepare
        Called with a step before it is measured; raises what is wrong with it.
    refuse
        Called with an error; raises it if it ends the whole.
    take
        Called with each step and its outcome once that is certain, in order.
    progress
        Called with the number of steps measured.
    """
    parts: dict[int, float] = {}
    # a block has at least so many steps: where there are fewer, workers have nothing to do
    shares = has_helpers(service, document, plan.size // SHORTEST)
    asked: dict[TaskFuture, tuple[Ask, float]] = {}
    certain = 0

    def shown(number: int, _phase: str, share: float) -> None:
        parts[number] = share
        progress(plan.ahead + sum(parts.values()))

    def outcome_of(ask: Ask, future: TaskFuture, started: float) -> Outcome:
        try:
            return {**future.result(), "wall_s": time.monotonic() - started}
        except StereorigError as error:
            refuse(ask.n, error)
            return error

    def ended(ask: Ask, outcome: Outcome) -> None:
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
                    task = _task_of(service, document, ask, shares=shares)
                except StereorigError as error:
                    refuse(ask.n, error)
                    ended(ask, error)
                else:
                    asked[side.submit(ask.n, measure_step, task)] = ask, time.monotonic()
            for n, future in side.ended():
                parts.pop(n, None)
                ask, started = asked.pop(future)
                ended(ask, outcome_of(ask, future, started))


def _task_of(service: Service, document: AnalysisRecord, ask: Ask, *, shares: bool) -> StepTask:
    needed = [n for n in ask.references if n != ask.previous] + ([] if ask.previous is None else [ask.previous])
    earlier = {n: service.tests.steps.read(document.test_id, n) for n in needed}
    return replace(
        task_of(service.tests, document, ask.n, earlier, None, shares=shares),
        previous=ask.previous,
        against=ask.against,
        from_head=ask.from_head,
        compared=ask.compared,
        generation=ask.generation,
    )
