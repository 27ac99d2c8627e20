"""An error as plain data: code, cause, remedy, and the values that a program may want."""

from __future__ import annotations

from typing import Any

from core.errors import StateError, StereorigError
from server.base.json_values import without_nan

RESTART = StateError(
    "The service ended while the job was not finished.",
    code="interrupted",
    remedy="What was finished has been kept; start the job again for the rest.",
)


def problem_of(error: BaseException) -> dict[str, Any]:
    """Describe an error as a job's ``problem``: code, cause, remedy and the values that a program may want."""
    if isinstance(error, StereorigError):
        context = {k: v for k, v in error.context.items() if isinstance(v, str | int | float | bool | list | dict)}
        described = {"code": error.code, "cause": error.cause, "remedy": error.remedy, "context": context}
        return dict(without_nan(described))
    return {
        "code": "internal_error",
        "cause": f"{type(error).__name__}: {error}",
        "remedy": "Report this with the service's log.",
        "context": {},
    }
