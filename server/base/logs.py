"""Log lines with the request and the job that they belong to, as text or as JSON lines."""

from __future__ import annotations

import contextlib
import contextvars
import json
import logging
import re
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

LogFormat = Literal["text", "json"]
FORMATS: tuple[LogFormat, ...] = ("text", "json")

_about: contextvars.ContextVar[dict[str, str] | None] = contextvars.ContextVar("stereorig_log_about", default=None)
_jobs = logging.getLogger("stereorig.jobs")
_threads = logging.getLogger("stereorig.threads")
#: lines that a process writes in any second at most
LINES_PER_S = 100
#: fewer are no use of a traceback
_CUT_LINES = 6
# attributes that a logger's caller gave as `extra`, not those that every record has
_USUAL = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message", "about", "taskName"}
# a client's text must not begin a line of its own, nor talk to a terminal
_CONTROL = re.compile(r"[\x00-\x08\x0a-\x1f\x7f-\x9f\u2028\u2029]")


@contextlib.contextmanager
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


class LimitedHandler(logging.StreamHandler[TextIO]):
    """Writes to standard error, at most so many lines in any second, and then states how many messages it left out.

    A fault that repeats, as a listener without descriptors does, must not fill the disk of the log.
    """

    def __init__(self, lines_per_s: int = LINES_PER_S) -> None:
        super().__init__()
        self._most = lines_per_s - 1  # the last one is for the count
        self._written: deque[float] = deque()
        self._left_out = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count it where the last second has no room for it."""
        kept = 0 if record.levelno >= logging.WARNING else self._most // 5  # requests must not crowd out errors
        while self._written and self._written[0] <= time.monotonic() - 1.0:
            self._written.popleft()
        room = self._most - kept - len(self._written)
        lines = self._lines_of(record, room) if room > 0 else []
        if 0 < len(lines) <= room and self._write(lines):
            self._written.extend([time.monotonic()] * len(lines))
            return
        self._left_out += 1
        if self._left_out == 1:
            with contextlib.suppress(RuntimeError):  # no thread starts in a process that ends: `close` reports
                timer = threading.Timer(1.0, self.report)
                timer.daemon = True
                timer.start()

    def report(self) -> None:
        """Write how many messages were left out."""
        self.acquire()
        try:
            count, self._left_out = self._left_out, 0
            if count:
                text = f"{count} messages were left out: at most {self._most + 1} lines a second are written."
                self._write(self._lines_of(logging.makeLogRecord(_record_of(text)), 1))
                self._written.append(time.monotonic())
        finally:
            self.release()

    def close(self) -> None:
        """Report the count of messages left out so far."""
        self.report()
        super().close()

    def _lines_of(self, record: logging.LogRecord, room: int) -> list[str]:
        """Return a record's lines; of one that has more than there is room for the first and the last."""
        try:
            lines = self.format(record).split("\n")
        except Exception as error:  # noqa: BLE001 - a wrong call of the logger, which must not print a traceback itself
            lines = [self.format(logging.makeLogRecord(_record_of(f"{record.name} cannot be formatted: {error!r}")))]
        if len(lines) <= room or room < _CUT_LINES:
            return lines
        return [*lines[: room // 3], "  ...", *lines[1 + room // 3 - room :]]

    def _write(self, lines: list[str]) -> bool:
        """Write lines; return False where standard error takes none."""
        try:
            self.stream.write("\n".join(lines) + "\n")
            self.flush()
        except (OSError, ValueError):  # full, or closed at the other end
            return False
        return True


def _record_of(text: str) -> dict[str, object]:
    """Return the entries of a warning about the log itself."""
    return {"name": "stereorig.log", "levelno": logging.WARNING, "levelname": "WARNING", "msg": text}


def configure(level: str, form: LogFormat, *, lines_per_s: int = LINES_PER_S) -> None:
    """Send every log line of this process to standard error.

    Parameters
    ----------
    level
        Name of the minimum level that is shown.
    form
        ``text`` or ``json``.
    lines_per_s
        Lines in any second at most; further messages are counted.
    """
    handler = LimitedHandler(lines_per_s)
    handler.setFormatter(JsonFormatter() if form == "json" else TextFormatter())
    handler.addFilter(AboutFilter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    threading.excepthook = _log_end_of_thread


def _log_end_of_thread(args: threading.ExceptHookArgs) -> None:
    """Log the error that ended a thread, so that it counts as all lines do."""
    if args.exc_value is not None and args.exc_type is not SystemExit:
        name = None if args.thread is None else args.thread.name
        _threads.error("thread %s ended", name, exc_info=args.exc_value)


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
