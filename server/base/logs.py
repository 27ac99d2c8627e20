"""Log lines with the request and the job that they belong to, as text or as JSON lines."""

from __future__ import annotations

import contextvars
import json
import logging
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, Literal

LogFormat = Literal["text", "json"]
FORMATS: tuple[LogFormat, ...] = ("text", "json")

_about: contextvars.ContextVar[dict[str, str] | None] = contextvars.ContextVar("stereorig_log_about", default=None)
_jobs = logging.getLogger("stereorig.jobs")
# attributes that a logger's caller gave as `extra`, not those that every record has
_USUAL = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message", "about", "taskName"}
# a client's text must not begin a line of its own, nor talk to a terminal
_CONTROL = re.compile(r"[\x00-\x08\x0a-\x1f\x7f-\x9f\u2028\u2029]")


@contextmanager
def about(**ids: str) -> Iterator[None]:
    """Add these ids to every log line of the block, in this thread or task and those it starts."""
    token = _about.set({**(_about.get() or {}), **ids})
    try:
        yield
    finally:
        _about.reset(token)


def current_ids() -> dict[str, str]:
    """Return the ids that a log line would name here."""
    return dict(_about.get() or {})


class AboutFilter(logging.Filter):
    """Puts the ids into each record."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Add the ids; let every record pass."""
        if not hasattr(record, "about"):
            record.about = current_ids()
        return True


class TextFormatter(logging.Formatter):
    """One line, with the ids at its end; a traceback follows it."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the base class' name
        """Return the line without traceback."""
        line = _CONTROL.sub(lambda found: repr(found[0])[1:-1], super().formatMessage(record))
        ids = " ".join(f"{name}={value}" for name, value in getattr(record, "about", {}).items())
        return f"{line} [{ids}]" if ids else line


class JsonFormatter(logging.Formatter):
    """One JSON object a line: utc, level, logger, message, ids, the caller's further entries, and the traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        when = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        line: dict[str, Any] = {
            "utc": when,
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "about", {}),
        }
        line |= {name: value for name, value in vars(record).items() if name not in _USUAL and name not in line}
        if record.exc_info or record.exc_text:
            line["traceback"] = record.exc_text or self.formatException(record.exc_info)  # type: ignore[arg-type]
        return json.dumps(line, ensure_ascii=False, default=str)


def configure(level: str, form: LogFormat) -> None:
    """Send every log line of this process to standard error.

    Parameters
    ----------
    level
        Name of the minimum level that is shown.
    form
        ``text`` or ``json``.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(JsonFormatter() if form == "json" else TextFormatter())
    handler.addFilter(AboutFilter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())


def log_job_event(name: str, data: Mapping[str, Any]) -> None:
    """Write a line where the event hub reports a job's new state."""
    if name != "job" or data.get("change") == "progress":
        return
    problem = data.get("problem") or {}
    with about(job_id=str(data["id"])):
        _jobs.log(
            logging.WARNING if data["state"] == "failed" else logging.INFO,
            "%s %s%s",
            data["kind"],
            data["state"],
            f": {problem.get('cause')}" if problem else "",
            extra={"kind": data["kind"], "state": data["state"], "code": problem.get("code")},
        )
