"""The service's own exceptions: unknown things, held hardware, full queues."""

from __future__ import annotations

from typing import Any

from stereorig.core.errors import InputError, StateError


class NotFoundError(InputError):
    """No such calibration, test, step, analysis, job or camera."""

    code = "not_found"
    remedy = "List the entries, and use one of their ids."


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
