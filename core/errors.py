"""The exception tree of the whole project.

Every error raised to a caller has a stable ``code``, the cause in one sentence with the values that disagree, and a
remedy. The service sends the same code as problem+json; the command line prints them in one line.

::

    StereorigError
    +-- InputError                 the caller's data or settings cannot be used
    |   +-- ImageError             an image file or array is not usable
    |   +-- TargetError            the calibration grid was not found or not indexed without doubt
    |   +-- CalibrationInputError  views that cannot determine the camera
    |   +-- RegionError            region, mask, subset or seed that leaves nothing to measure
    |   +-- FileFormatError        a file that is not of the format that it is given as
    +-- MeasurementError           the computation could not be done
    |   +-- CalibrationError       no usable minimum
    |   +-- SeedError              no start values found
    |   +-- Cancelled              the caller asked for it
    +-- DeviceError                a camera or stage
    |   +-- CameraError
    |   +-- StageError
    +-- StateError                 right call, wrong moment
    +-- StorageError               the disk lost or refused data
"""

from __future__ import annotations

from typing import Any


class StereorigError(Exception):
    """Base of every error the project raises on purpose.

    Parameters
    ----------
    cause
        One sentence, with the values that disagree.
    code
        Stable snake_case code; the class's own when left out.
    remedy
        Remedy for the caller; the class's own when left out.
    **context
        Values for programs (``view="cam1_+0.000mm.tif"``, ``found=10, expected=11``).
    """

    code = "error"
    remedy = "Report this with the message above."

    def __init__(self, cause: str, *, code: str | None = None, remedy: str | None = None, **context: Any) -> None:
        super().__init__(cause)
        self.cause = cause
        if code is not None:
            self.code = code
        if remedy is not None:
            self.remedy = remedy
        self.context: dict[str, Any] = context

    def __str__(self) -> str:
        stop = "" if self.cause.endswith((".", "!", "?")) else "."
        return f"{self.code}: {self.cause}{stop} Remedy: {self.remedy}"

    def __reduce__(self) -> tuple[Any, ...]:
        # keyword-only arguments would be lost on the way back from a worker process
        return (_rebuild, (type(self), self.cause, self.code, self.remedy, self.context))


def _rebuild(cls: type[StereorigError], cause: str, code: str, remedy: str, context: dict[str, Any]) -> StereorigError:
    return cls(cause, code=code, remedy=remedy, **context)


class InputError(StereorigError):
    """The caller's data or settings cannot be used."""

    code = "invalid_input"
    remedy = "Correct the value named above."


class ImageError(InputError):
    """An image is missing, of the wrong size or type, or has no texture."""

    code = "image_unusable"
    remedy = "Check the image file named above."


class TargetError(InputError):
    """The calibration target was not found, or could not be indexed without doubt."""

    code = "target_not_found"
    remedy = "Show the whole target, clean, evenly lit and in focus."


class CalibrationInputError(InputError):
    """The views given cannot determine the camera."""

    code = "calibration_underdetermined"
    remedy = "Take views at two or more stage positions that lie millimetres apart."


class RegionError(InputError):
    """Region, mask, subset or seed leave nothing to measure."""

    code = "region_unusable"
    remedy = "Give a region inside camera 1's image that is larger than one subset."


class FileFormatError(InputError):
    """A file is not of the format that it is given as."""

    code = "file_unreadable"
    remedy = "Check the file named above."


class MeasurementError(StereorigError):
    """The computation could not be done."""

    code = "measurement_failed"


class CalibrationError(MeasurementError):
    """The calibration has no usable minimum; nothing is stored as usable."""

    code = "calibration_failed"
    remedy = "Check the target description, the stage positions and the nominal rig, then take the views again."


class SeedError(MeasurementError):
    """No start values were found for the field."""

    code = "not_seeded"
    remedy = "Check that both cameras see the same textured surface, or give a seed point."


class Cancelled(MeasurementError):
    """The caller asked for the work to stop."""

    code = "cancelled"
    remedy = "Start it again when wanted."


class DeviceError(StereorigError):
    """A camera or stage failed or refused a request."""

    code = "device_fault"
    remedy = "Check cables and power, then reconnect."


class CameraError(DeviceError):
    """A frame grabber failed."""

    code = "camera_fault"


class StageError(DeviceError):
    """A stage controller failed or refused."""

    code = "stage_fault"


class StateError(StereorigError):
    """The call is right but the moment is wrong."""

    code = "wrong_state"
    remedy = "Wait for the work that uses the resource, or cancel it."


class StorageError(StereorigError):
    """The disk lost or refused data."""

    code = "storage_failed"
    remedy = "Check free space and the health of the disk; nothing unsaved was acknowledged."
