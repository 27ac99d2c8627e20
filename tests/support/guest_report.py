"""A pytest plugin for the tests in the guest: reports each outcome at once, lists tests with their marks.

What was reported stays when the guest dies in the next test.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

_MARKS = ("fault",)


def pytest_collection_finish(session: pytest.Session) -> None:
    if os.environ.get("GUEST_COLLECT"):
        names = [
            (item.nodeid, [(mark.name, list(mark.args)) for mark in item.iter_markers() if mark.name in _MARKS])
            for item in session.items
        ]
        print("\nGUEST " + json.dumps(names))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> object:
    wrapped = yield
    report = wrapped.get_result()
    path = os.environ.get("GUEST_REPORT")
    if path and (report.when == "call" or report.outcome != "passed"):
        text = report.longrepr[2] if report.skipped and isinstance(report.longrepr, tuple) else report.longreprtext
        line = json.dumps(
            {
                "name": report.nodeid,
                "outcome": report.outcome,
                "text": text,
                "output": report.capstdout,
                "seconds": report.duration,
            }
        )
        with Path(path).open("a", encoding="utf-8") as out:
            out.write(line + "\n")
            out.flush()
            os.fsync(out.fileno())
    return wrapped
