"""Names of the two cameras, as spelled in files, messages and replies."""

from __future__ import annotations

from typing import Literal

CameraName = Literal["cam1", "cam2"]
CAMERAS: tuple[CameraName, CameraName] = ("cam1", "cam2")
