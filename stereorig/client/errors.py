"""Refusals of the service as the project's own errors: the same codes, causes and remedies."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from importlib import resources

import httpx

from stereorig.core import errors
from stereorig.core.errors import InputError, StateError, StereorigError, StorageError

#: of codes that several classes share, and of a newer service's
_BY_STATUS: dict[int, type[StereorigError]] = {404: InputError, 405: InputError, 413: InputError, 415: InputError}
_BY_STATUS |= {422: InputError, 507: StorageError}
_MEMBERS = frozenset({"type", "title", "status", "detail", "code", "remedy", "context"})


@functools.cache
def _kinds() -> dict[str, type[StereorigError]]:
    """Return the class of each code, from the list that the service itself shows at ``/problems``."""
    text = resources.files("stereorig.server").joinpath("static/problems.json").read_text(encoding="utf-8")
    return {code: getattr(errors, one["kind"]) for code, one in json.loads(text).items()}


def error_of(problem: Mapping[str, object], *, status: int = 409) -> StereorigError:
    """Return a problem, of an answer or of a job, as the error that it was in the service.

    Parameters
    ----------
    problem
        ``code``, ``detail``, ``remedy`` and further values, which become the error's ``context``.
    status
        Status of the answer.
    """
    code = str(problem.get("code", "http_error"))
    kind = _kinds().get(code, StereorigError)
    if kind is StereorigError:
        kind = _BY_STATUS.get(status, StateError)
    held = problem.get("context")
    context = dict(held) if isinstance(held, Mapping) else {k: v for k, v in problem.items() if k not in _MEMBERS}
    return kind(
        str(problem.get("detail") or "The service gave no reason."),
        code=code,
        remedy=str(problem.get("remedy") or "Look at the service's log."),
        **{str(name): value for name, value in context.items() if name not in ("code", "remedy", "cause")},
    )


def checked(response: httpx.Response) -> httpx.Response:
    """Return an answer that is a success.

    Raises
    ------
    StereorigError
        An error of the class, with the code, cause and remedy that the service gave.
    """
    if response.is_success:
        return response
    try:
        problem = response.json()
    except ValueError:
        problem = {"detail": f"The answer was {response.status_code}: {response.text[:200]}"}
    raise error_of(problem if isinstance(problem, dict) else {}, status=response.status_code)


def no_answer(url: str, error: httpx.TransportError) -> StateError:
    """Return the error for a service that cannot be reached."""
    return StateError(
        f"The service at {url} does not answer ({type(error).__name__}).",
        code="service_lost",
        remedy="Start it (stereorig serve), or give its address.",
    )
