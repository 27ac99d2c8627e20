"""Models of a test."""

from __future__ import annotations

from pydantic import Field

from stereorig.server.base.models import Listing
from stereorig.server.store.models import ModelRecord


class ModelList(Listing):
    """Models, oldest first."""

    models: list[ModelRecord] = Field(description="Each with its reading options and its placement.")
