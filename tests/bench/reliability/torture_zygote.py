"""A process that has loaded everything and forks services: a thousand starts must not load the modules a thousand times.

Reads a JSON object a line (``argv``, ``out``, ``err``) and answers with the process number of a service that was forked for
it. What is forked runs the same command line on the same files as one that is started from the shell; only loading is
spared, of the service's modules and of its worker's.

    python -m tests.bench.reliability.torture_zygote
"""

from __future__ import annotations

import gc
import json
import multiprocessing
import os
import signal
import sys
import time
import types
from typing import Any

from stereorig.server.base.priority import end_with_parent
from stereorig.server.worker.process import pin_threads


def load() -> None:
    """Load what service and worker need, and run the kernels once; no thread may be left running."""
    pin_threads(1)
    import cv2

    cv2.setNumThreads(1)
    import uvicorn  # noqa: F401

    import stereorig.server.api.app
    import stereorig.server.cli.operation.serve
    import stereorig.server.compute.calibration.fit
    import stereorig.server.compute.measurement
    import stereorig.server.compute.noise_fit

    stereorig.server.compute.measurement.compile_here(1)


def fork_workers() -> None:
    """Let the services of this process fork their workers too, before they have threads and locks of their own."""
    import stereorig.server.worker.embedded

    fork = multiprocessing.get_context("fork")
    stereorig.server.worker.embedded.multiprocessing = types.SimpleNamespace(get_context=lambda _: fork)  # type: ignore[attr-defined]
    start = stereorig.server.worker.embedded.ComputeWorker.start

    def started(worker: stereorig.server.worker.embedded.ComputeWorker) -> None:
        start(worker)
        while worker.pid is None:
            time.sleep(0.001)

    stereorig.server.worker.embedded.ComputeWorker.start = started  # type: ignore[method-assign]


def serve(order: dict[str, Any]) -> None:
    """Be the service; never returns."""
    status = 70
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        end_with_parent()
        os.setsid()
        for fd, path in ((1, order["out"]), (2, order["err"])):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), fd)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        from stereorig.server.cli.main import main

        status = main(order["argv"])
    except BaseException:  # noqa: BLE001 - a client of the service finds it there
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def main() -> int:
    """Load, then fork for every line."""
    load()
    gc.collect()
    gc.freeze()  # what all services share: the rounds of the collector at their starts would copy it, page by page
    fork_workers()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # killed processes are not waited for
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        pid = os.fork()
        if pid == 0:
            serve(order)
        print(json.dumps({"pid": pid}), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
