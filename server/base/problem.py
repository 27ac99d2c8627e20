"""An error as plain data: code, cause, remedy, and the values that a program may want."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from pydantic import Field

from stereorig.core.errors import StateError, StereorigError
from stereorig.server.base.json_values import without_nan
from stereorig.server.base.models import Document


class JobProblem(Document):
    """Reason why a job has no result."""

    code: str = Field(description="Stable code.")
    detail: str = Field(description="The cause, with the values that disagree.")
    remedy: str = Field(description="Remedy.")
    context: dict[str, object] = Field(default_factory=dict, description="Values that a program may want.")


RESTART = StateError(
    "The service ended while the job was not finished.",
    code="interrupted",
    remedy="Finished results have been kept; start the job again for the rest.",
)


# places of a server; a text may name the paths of requests too, and of devices, which are the user's own
_ABSOLUTE = re.compile(
    r"(?<![\w.:/~-])/(?:bin|boot|data|etc|home|lib|media|mnt|opt|private|proc|root|run|srv|sys|tmp|usr|var|work|Users)/"
    r"[^\s'\"<>|;,()]*"
)
_roots: set[str] = set()


def hide_folder(root: Path) -> Callable[[], None]:
    """Have problems name the files below a folder from there on, until the returned function is called."""
    hidden = {str(path) for path in (root.absolute(), root.resolve()) if path != path.parent}
    _roots.update(hidden)
    return lambda: _roots.difference_update(hidden)


def without_paths(text: str) -> str:
    """Return a text with paths that begin in the data folder, and with the names alone of other files of the server.

    If no folder is hidden, as on the command line, the files are the user's own: the text stays as it is.
    """
    if not _roots:
        return text
    for root in sorted(_roots, key=len, reverse=True):
        text = text.replace(f"{root}/", "").replace(root, "the data folder")
    return _ABSOLUTE.sub(lambda found: found[0].rstrip("/.:").rpartition("/")[2] + _end_of(found[0]), text)


def _end_of(path: str) -> str:
    return path[len(path.rstrip("/.:")) :].replace("/", "")


def without_paths_in(value: object) -> object:
    """Return a value of a problem's context, its texts as `without_paths`."""
    if isinstance(value, str):
        return without_paths(value)
    if isinstance(value, list | tuple):
        return [without_paths_in(one) for one in value]
    return {name: without_paths_in(one) for name, one in value.items()} if isinstance(value, dict) else value


def problem_of(error: BaseException) -> JobProblem:
    """Describe an error as a job's problem: code, cause, remedy and the values that a program may want."""
    if isinstance(error, StereorigError):
        context = {
            k: without_paths_in(v)
            for k, v in error.context.items()
            if isinstance(v, str | int | float | bool | list | dict)
        }
        return JobProblem(
            code=error.code,
            detail=without_paths(error.cause),
            remedy=without_paths(error.remedy),
            context=without_nan(context),
        )
    detail = without_paths(f"{type(error).__name__}: {error}")
    return JobProblem(code="internal_error", detail=detail, remedy="Report this with the service's log.")
