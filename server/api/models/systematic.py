"""Systematic terms of a step, as they travel."""

from __future__ import annotations

from pydantic import Field

from stereorig.server.base.models import Reply


class SystematicFigure(Reply):
    """Size of a systematic term for one quantity."""

    rms: float | None = Field(description="Root mean square over the points; null if noise hides it.")
    largest: float | None = Field(description="The largest; null if noise hides it.")
    below: float = Field(description="Upper bound of the root mean square, about two standard deviations above it.")


class SystematicTerm(Reply):
    """One systematic term of a step, which no standard uncertainty holds."""

    text: str = Field(description="Method of the estimate, or the reason why there is none.")
    figures: dict[str, SystematicFigure] = Field(
        description="By quantity with its unit, as `u_um` or `exx_microstrain`; empty if there is no estimate."
    )


class SystematicTerms(Reply):
    """Systematic terms of a step, estimated from its own field."""

    interpolation: SystematicTerm | None = Field(description="Bias of interpolation between the pixels.")
    patch_order: SystematicTerm | None = Field(
        description="Bias of patches on a surface that bends more than they can."
    )
    strain_window: SystematicTerm | None = Field(description="Bias of the strain's window; null: no strain.")
