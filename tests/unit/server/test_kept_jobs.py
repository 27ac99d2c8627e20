"""Of a job what is kept of it, and what its events hold."""

from __future__ import annotations

import pytest

from stereorig.server.jobs.events import EventHub
from stereorig.server.jobs.job import Job, Work, new_record
from stereorig.server.jobs.manager import JobManager


@pytest.mark.parametrize(("kind", "figures"), [("analysis", 5), ("burst", 100)])
def test_an_event_holds_few_of_the_figures_of_an_analysis_steps(kind: str, figures: int) -> None:
    hub = EventHub()
    manager = JobManager.__new__(JobManager)
    manager._hub = hub
    job = Job(new_record("j000001-abcdef", kind, {}), Work([]), manager._show)
    job.result = {"steps": [{"n": n} for n in range(200)], "steps_finished": list(range(200))}
    manager._show(job, "state")
    (event,) = hub._ring
    found = event.data["result"]
    assert (len(found["steps"]), found["n_steps"]) == (figures, 200)
    assert (len(found["steps_finished"]), found["n_steps_finished"]) == (100, 200)
