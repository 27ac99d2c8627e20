"""Systematic terms of a step, as they travel."""

from __future__ import annotations

from pydantic import Field

from server.base.models import Reply


class SystematicFigure(Reply):
    """Size of a systematic term for one quantity."""

    rms: float | None = Field(description="Root mean square over the points; null where noise hides it.")
    largest: float | None = Field(description="The largest; null where noise hides it.")
    below: float = Field(description="What the root mean square is below, by about two standard deviations.")


class SystematicTerm(Reply):
    """One systematic term of a step, which no standard uncertainty holds."""

    text: str = Field(description="How it was estimated, or why it cannot be told.")
    figures: dict[str, SystematicFigure] = Field(
        description="By quantity with its unit, as `u_um` or `exx_microstrain`; empty where it cannot be told."
    )


class SystematicTerms(Reply):
    """Systematic terms of a step, estimated from its own field."""

    interpolation: SystematicTerm | None = Field(description="Bias of interpolation between the pixels.")
    patch_order: SystematicTerm | None = Field(description="Bias of patches on what bends more than they.")
    strain_window: SystematicTerm | None = Field(description="Bias of the strain's window; null: no strain.")
