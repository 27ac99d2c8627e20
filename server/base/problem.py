"""An error as plain data: code, cause, remedy, and the values that a program may want."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, model_validator

from core.errors import StateError, StereorigError
from server.base.json_values import without_nan
from server.base.models import Document


class JobProblem(Document):
    """Reason why a job has no result."""

    code: str = Field(description="Stable code.")
    detail: str = Field(
        "", description="The cause, with the values that disagree; the same word as in an answer's problem."
    )
    cause: str = Field(description="Earlier name of `detail`, the same text.", json_schema_extra={"deprecated": True})
    remedy: str = Field(description="Remedy.")
    context: dict[str, object] = Field(default_factory=dict, description="Values that a program may want.")

    @model_validator(mode="before")
    @classmethod
    def _one_text_by_both_names(cls, value: Any) -> Any:
        # documents of earlier versions have the cause alone
        if isinstance(value, Mapping):
            texts = {name: value[name] for name in ("detail", "cause") if name in value}
            return {**{name: text for text in texts.values() for name in ("detail", "cause")}, **value}
        return value


RESTART = StateError(
    "The service ended while the job was not finished.",
    code="interrupted",
    remedy="What was finished has been kept; start the job again for the rest.",
)


def problem_of(error: BaseException) -> JobProblem:
    """Describe an error as a job's problem: code, cause, remedy and the values that a program may want."""
    if isinstance(error, StereorigError):
        context = {k: v for k, v in error.context.items() if isinstance(v, str | int | float | bool | list | dict)}
        return JobProblem(code=error.code, cause=error.cause, remedy=error.remedy, context=without_nan(context))
    return JobProblem(
        code="internal_error", cause=f"{type(error).__name__}: {error}", remedy="Report this with the service's log."
    )
