"""The service's own exceptions: unknown things, held hardware, full queues."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from stereorig.core.errors import InputError, StateError


class NotFoundError(InputError):
    """No such calibration, test, step, analysis, job or camera."""

    code = "not_found"
    remedy = "List the entries, and use one of their ids."


def no_variable(where: str, name: str, names: Iterable[str]) -> NotFoundError:
    """Return ``field_missing`` for a variable that a result lacks, with the names that it has, similar ones first."""
    known = sorted(names)
    similar = difflib.get_close_matches(name, known)
    first = f"Perhaps {' or '.join(similar)} is meant; there are" if similar else "There are"
    return NotFoundError(
        f"{where} has no variable {name!r} with one number a point.",
        code="field_missing",
        remedy=f"{first} {', '.join(known)}.",
        available=known,
    )


class BusyError(StateError):
    """The hardware is held by another client."""

    code = "hardware_busy"
    remedy = "Wait until the holder is done, or cancel its job."

    def __init__(self, holder: dict[str, object]) -> None:
        super().__init__(f"The hardware is held by {holder.get('purpose', 'another task')}.", holder=holder)

    def __reduce__(self) -> tuple[Any, ...]:
        return (BusyError, (self.context["holder"],))


class QueueFullError(StateError):
    """More computations are waiting than the configuration allows."""

    code = "queue_full"
    remedy = "Send the request again after the time in Retry-After."


class TooLargeError(InputError):
    """A body or an image beyond the limits of the service."""

    code = "body_too_large"
    remedy = "Send less."
