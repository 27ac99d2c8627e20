"""When a later step takes over as the reference of a sequence: what can be asked for.

Apart from the measurement, so that files and requests can be read without loading the matching.
"""

from __future__ import annotations

from typing import Literal, get_args

ReferenceUpdate = Literal["never", "auto", "always"]
"""``never``: total correlation, ``always``: incremental, ``auto``: total as long as the reference serves."""
REFERENCE_UPDATES: tuple[ReferenceUpdate, ...] = get_args(ReferenceUpdate)
DEFAULT_REFERENCE_UPDATE: ReferenceUpdate = "auto"
