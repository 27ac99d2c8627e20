"""Warnings of results, as they travel."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from stereorig.server.base.models import Reply


class AnalysisWarning(Reply):
    """A reason for which a result is not to be used as it is."""

    code: str = Field(
        description="Stable name: `epipolar_check_failed`, `low_coverage`, `cameras_off_zero`, `steps_failed` ...",
        examples=["epipolar_check_failed"],
    )
    level: Literal["failed", "warning"] = Field(
        description="`failed`: no number of it should be reported; `warning`: with care."
    )
    text: str = Field(description="The finding, with its figures.")
    remedy: str = Field(description="What to do.")
    steps: list[int] = Field(
        default_factory=list, description="Steps that it holds for, 100 at most; empty: all of it."
    )
    n_steps: int | None = Field(None, description="Number of the steps, if there are more than 100.")


# Systematic terms of a step, as they travel.


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
