"""A Dask cluster of processes on this machine, and a service whose analyses run there."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.copied_tests import CONFIG
from tests.support.patience import Deadline
from tests.support.requirements import ROOT, missing
from tests.support.service_rig import served


class Cluster:
    """A scheduler and its workers, each a process."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = folder / "scheduler.json"
        self._log = (folder / "cluster.log").open("wb")
        self.workers: list[subprocess.Popen[bytes]] = []
        self.scheduler = self._start(
            "dask_scheduler", "--port", "0", "--host", "127.0.0.1", "--scheduler-file", str(self._file)
        )
        try:
            deadline = Deadline(120.0)
            while not self._file.exists() and deadline.left:
                time.sleep(0.05)
            self.address: str = json.loads(self._file.read_text())["address"]
        except BaseException:
            self.close()
            raise

    def _start(self, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", "--no-dashboard", *arguments],
            cwd=self._folder,
            stdout=self._log,
            stderr=self._log,
            env=environment,
        )

    def add_worker(self) -> subprocess.Popen[bytes]:
        worker = self._start(
            "dask_worker",
            "--scheduler-file",
            str(self._file),
            "--nthreads",
            "1",
            "--no-nanny",
            "--host",
            "127.0.0.1",
            "--local-directory",
            str(self._folder),
        )
        self.workers.append(worker)
        return worker

    def await_workers(self, count: int, seconds: float = 120.0) -> None:
        """Wait until so many workers are known to the scheduler."""
        import distributed

        with distributed.Client(self.address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(count, timeout=seconds)

    def close(self) -> None:
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait()
        self._log.close()


@contextmanager
def cluster_of(workers: int, folder: Path) -> Iterator[Cluster]:
    """A cluster of some workers; ends with the block."""
    if importlib.util.find_spec("distributed") is None:
        missing("distributed (pip install distributed)")
    made = Cluster(folder)
    try:
        for _ in range(workers):
            made.add_worker()
        yield made
    finally:
        made.close()


class Host:
    """A service whose analyses run here or there."""

    def __init__(self, data: Path, compute: str) -> None:
        self.data = data
        self.service = Service(parse_config(f"{CONFIG}\n{compute}"), data).start()
        self._context = served(self.service)
        self.client: httpx.Client = self._context.__enter__()

    def close(self) -> None:
        self._context.__exit__(None, None, None)
        self.service.close()
