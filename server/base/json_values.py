"""Values that JSON can hold."""

from __future__ import annotations

import math
from typing import Any

from typing_extensions import TypeAliasType

#: rows of numbers, nested as deep as an array has axes; null where a value is missing
Nested = TypeAliasType("Nested", "list[float | int | str | Nested | None]")


def without_nan(value: Any) -> Any:
    """Replace NaN and infinities by None, tuples by lists, in nested JSON-like data."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(k): without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    return value
