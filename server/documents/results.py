"""Parts of results: a variable without its values, a point with all its numbers, a calibration's residuals."""

from __future__ import annotations

from pydantic import Field

from stereorig.server.base.json_values import Nested
from stereorig.server.base.models import Reply
from stereorig.server.formats.results.variables import Group, Kind


class Uncertainty(Reply):
    """Meaning of an answer's uncertainties, and the terms that they include."""

    k: float = Field(description="Coverage factor of `expanded`; `sigma` is one standard uncertainty.", examples=[1.0])
    coverage: float = Field(description="Share of the distribution within k standard uncertainties.", examples=[0.6827])
    distribution: str = Field(description="The distribution, and the number of degrees of freedom.")
    includes: list[str] = Field(description="Causes that are included.", examples=[["matching", "calibration"]])
    not_included: list[str] = Field(
        description="Missing terms: `calibration` if its covariance is not known; systematic terms."
    )
    text: str = Field(
        description="The same in one line; `calibration not included` if so.",
        examples=["u (k = 1) includes matching, calibration"],
    )


class FieldVariable(Reply):
    """A variable of a result."""

    name: str = Field(description="Name.", examples=["w_mm"])
    units: str = Field(description="Unit.", examples=["mm"])
    long_name: str = Field(description="Meaning.")
    dimensions: list[str] = Field(description="Names of its dimensions.", examples=[["row", "col"]])
    shape: list[int] = Field(description="Length of each dimension.", examples=[[4, 6]])
    flags: dict[str, str] | None = Field(None, description="For a status: the meaning of each value.")
    comparisons: list[str] | None = Field(
        None, description="For a correlation: the images that its last axis compares."
    )
    label: str = Field("", description="Name that people read.", examples=["W"])
    group: Group = Field("Internals", description="Heading that it is listed under.")
    kind: Kind = Field("number", description="`strain` is shown in um/m, `angle` in degrees, `number` in its unit.")
    relative: bool = Field(False, description="True if it is zero at the reference step by definition.")


class ProbeValue(Reply):
    """A number, or several, of a point."""

    value: float | int | Nested | None = Field(description="The value; null if the point failed.")
    units: str = Field(description="Its unit; `1` for a pure number.", examples=["mm"])
    sigma: float | None = Field(None, description="Standard uncertainty; null if it is not known.")
    expanded: float | None = Field(None, description="k times it, where another k than 1 was asked for.")
    budget: dict[str, float | None] | None = Field(
        None, description="Standard uncertainty by cause; their squares add up to sigma's square. Null: not known."
    )
    not_included: str = Field("", description="`calibration not included` if so.")


class Probe(Reply):
    """A measurement point with everything that is known about it."""

    row: int = Field(description="Row of the point.")
    col: int = Field(description="Column of the point.")
    distance_px: float = Field(description="Distance of the pixel asked for from the point.")
    status: str = Field(description="Status of the point.")
    values: dict[str, ProbeValue] = Field(description="Its numbers, by variable.")
    uncertainty: Uncertainty = Field(description="Meaning of the uncertainties, and the terms that they include.")


class ViewResiduals(Reply):
    """Residuals of one view."""

    name: str = Field(description="Name of the view.", examples=["cam1 dZ 5.000 mm"])
    camera: int | str = Field(description="Which camera.")
    dz_mm: float | None = Field(None, description="Travel; null for a free pose.")
    frame: int | None = Field(None, description="Number of the free pose; null at a stage position.")
    held_out: bool = Field(description="True if it was kept for the check.")
    rbe_px: float | None = Field(description="Rms residual.")
    raz_mm: float | None = Field(description="Rms error in space.")
    nsce: float | None = Field(description="Normalised stereo calibration error.")
    found_px: Nested = Field(
        description="Column and row where each intersection was found: rows of lines of pairs; null: not seen."
    )
    residual_px: Nested = Field(description="Measured minus projected position, in the same order.")
