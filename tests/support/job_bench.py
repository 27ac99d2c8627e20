"""Jobs without a rig."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from stereorig.server.jobs.events import EventHub
from stereorig.server.jobs.hardware import HardwareHold
from stereorig.server.jobs.job import Job
from stereorig.server.jobs.manager import JobManager
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import IdMaker
from tests.support.patience import Deadline


class Bench:
    """Jobs without a rig."""

    def __init__(self, folder: Path, queue_limit: int = 2) -> None:
        self.catalog = Catalog(folder / "catalog.sqlite").open()
        self.hardware = HardwareHold()
        self.hub = EventHub()
        self.jobs = JobManager(self.catalog, self.hub, self.hardware, IdMaker(), queue_limit=queue_limit)
        self.jobs.start()

    def close(self) -> None:
        self.jobs.close()
        self.hardware.close()
        self.catalog.close()

    def end_of(self, job: Job, seconds: float = 20.0) -> dict[str, Any]:
        deadline = Deadline(seconds)
        while deadline.left:
            document = self.jobs.document(job.id).plain()
            if document["state"] in ("succeeded", "failed", "cancelled", "interrupted"):
                return document
            time.sleep(0.005)
        raise AssertionError(document)
