"""Models of a test."""

from __future__ import annotations

from pydantic import Field

from server.base.models import Listing
from server.store.models import ModelRecord


class ModelList(Listing):
    """Models, oldest first."""

    models: list[ModelRecord] = Field(description="Each with how it is read and where it lies.")
