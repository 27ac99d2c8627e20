"""Errors of a camera in the project's words."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.pixels import BY_NAME

RECONNECT = "Check its cable and power, then reconnect."


class NamedCamera:
    """A camera's name, and the errors that bear it.

    Parameters
    ----------
    name
        The camera's, as the rig file has it.
    check
        Called before each question; raises when the camera was closed in the meantime.
    """

    def __init__(self, name: str, check: Callable[[], None]) -> None:
        self.name = name
        self._check = check

    def busy(self) -> CameraError:
        """Return the error of a camera that another program controls."""
        return CameraError(
            f"Another program controls {self.name}.",
            code="camera_busy",
            remedy="Close the other program, then reconnect; a program that crashed holds a camera for 3 s more.",
            camera=self.name,
        )

    def lost(self, why: str) -> CameraError:
        """Return the error of a camera that cannot be used any more."""
        return CameraError(f"{self.name} {why}.", code="camera_lost", remedy=RECONNECT, camera=self.name)

    def out_of_range(self, name: object, value: object, allowed: str) -> CameraError:
        """Return the error for a value that is refused, with the allowed ones."""
        return CameraError(
            f"{self.name} cannot set {name} to {value!r}, only {allowed}.",
            code="out_of_range",
            remedy="Give a value as named above.",
            camera=self.name,
            setting=str(name),
        )

    def unknown(self, name: object, why: str) -> CameraError:
        """Return the error for a feature or setting that the camera does not have."""
        return CameraError(
            f"{self.name}: {name} {why}.",
            code="unknown_feature",
            remedy="Take one of the names in the camera's description (feature_names), or leave it out.",
            camera=self.name,
            setting=str(name),
        )


def several(name: str, ids: Iterable[str]) -> CameraError:
    """Return the error of a name that several cameras answer to, with the names that only one has."""
    return CameraError(
        f"Several cameras answer to {name}: {', '.join(ids)}.",
        code="camera_lost",
        remedy="Name the camera by one of these.",
        camera=name,
    )


def unreadable(name: str, code: int) -> CameraError:
    """Return the error of a camera that sends pixels of an unknown format."""
    return CameraError(
        f"{name} sends pixel format 0x{code:08x}, which is none of {', '.join(BY_NAME)}.",
        code="frame_format",
        remedy="Choose a Mono pixel format in the camera's settings.",
        camera=name,
    )
