"""Document of a comparison with a model, for API, command line and report."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from stereorig.server.base.models import Reply


class _Part(Reply):
    model_config = ConfigDict(extra="allow", protected_namespaces=())


class ComparedNumber(_Part):
    """Mean of a difference over a region, measured less model."""

    value: float | None = Field(description="The mean; null without points.")
    sigma: float | None = Field(description="Its standard uncertainty, common part included.")
    units: str = Field(description="mm, or 1 of strain.")


class ChiSquareReply(_Part):
    """A chi-square."""

    chi_square: float | None = Field(description="The statistic.")
    degrees: int = Field(description="Its degrees of freedom.")
    probability: float | None = Field(description="Probability of a larger one, if the model is right.")


class RegionReply(_Part):
    """One region of the field."""

    number: int = Field(description="As `region` in the VTU.")
    points: int = Field(description="Points that are compared.")
    rectangle_px: tuple[float, float, float, float] = Field(description="x0, y0, x1, y1 of its points.")
    centre_mm: tuple[float, float, float] = Field(description="Mean position at the reference.")
    difference: dict[str, ComparedNumber] = Field(description="u_mm, v_mm, w_mm, and strain if it was compared.")
    displacement: ChiSquareReply = Field(description="Verdict on the three means of displacement.")
    strain: ChiSquareReply | None = Field(
        None, description="Verdict on the least probable of the three means of strain."
    )
    refuted: list[str] = Field(description="By which quantity the model is refuted here: displacement, strain.")


class FieldVerdict(_Part):
    """Verdict on a quantity over the whole field."""

    accepted: bool = Field(description="False if the model is refuted.")
    overall: ChiSquareReply = Field(description="All regions together; its probability decides the verdict.")
    scale: ChiSquareReply | None = Field(
        None, description="Part in proportion to the model's displacement: a stiffness or load that is wrong."
    )
    pattern: ChiSquareReply | None = Field(None, description="All else.")
    local: ChiSquareReply | None = Field(None, description="The region that fits worst, for the number of regions.")
    rms: dict[str, float | None] = Field(description="Root mean square of the difference over the points.")
    rms_z: dict[str, float | None] = Field(
        description="Root mean square of the difference over its standard uncertainty; 1 for noise."
    )


class PlacementReply(_Part):
    """Placement of the model: x_sys = rotation x_model + shift_mm."""

    kind: str = Field(description="given, 3-2-1, markers or best-fit.")
    rotation: list[list[float]] = Field(description="Rows.")
    shift_mm: list[float] = Field(description="The model's origin in the system frame.")
    centre_mm: list[float] = Field(description="Point about which its errors turn.")
    covariance: list[list[float]] = Field(
        description="Covariance of three turns (rad) and three shifts (mm) along the axes."
    )
    points: int = Field(description="Measured points that it was fitted to; 0 for one that was given.")
    residual_rms_mm: float = Field(description="Root mean square distance of these points.")
    held: list[str] = Field(
        description="Motions that a best fit took from its start because the shape leaves them open."
    )


class ModelReply(_Part):
    """The model's file."""

    file: str = Field(description="Its name.")
    sha256: str = Field(description="SHA-256 of its content.")
    unit: str = Field(description="Of positions in the file.")
    displacement_unit: str = Field(description="Of displacements in the file.")
    displacement: str = Field(description="Name of the array that was taken.")
    nodes: int = Field(description="Nodes in the file.")
    triangles: int = Field(description="Triangles of the surface that was compared.")
    time: float | None = Field(None, description="Time of the state that was taken; null if the file has none.")
    corners_only: int = Field(0, description="Cells of a higher order of which only the corners were taken.")


class ShapeReply(_Part):
    """Measured points above the model's surface."""

    rms_mm: float = Field(description="Root mean square of their height.")
    ratio: float = Field(description="The same in units of the points' own noise.")


class FactorReply(_Part):
    """Factor by which the model's displacement fits the measured one best."""

    value: float | None = Field(description="1 for a right model; null if the model does not move.")
    sigma: float | None = Field(description="Its standard uncertainty, without the load's.")


class ModelComparisonReply(_Part):
    """A step compared with a model."""

    step: int = Field(description="Number of the step.")
    accepted: bool = Field(description="True if neither displacement nor strain refutes the model.")
    model: ModelReply = Field(description="The model's file.")
    settings: dict[str, object] = Field(description="The request.")
    align: PlacementReply = Field(description="Placement of the model.")
    points: dict[str, int] = Field(description="`measured`, and `compared`: over the model.")
    shape: ShapeReply = Field(description="How well the shapes agree.")
    displacement: FieldVerdict = Field(description="U, V, W.")
    strain: FieldVerdict | None = Field(None, description="exx, eyy, exy by the measurement's windows; null without.")
    factor: FactorReply = Field(description="The model's factor that fits best.")
    rigid: dict[str, list[float]] | None = Field(
        None, description="Rigid motion that was taken out: rotation_rad about X, Y, Z, shift_mm of the points' middle."
    )
    regions: list[RegionReply] = Field(description="By region.")
    refuted: list[int] = Field(description="Numbers of the regions in which the model is refuted.")
    left_out: str | None = Field(
        None, description="Component that a plane model does not have: it is in no difference, chi-square or verdict."
    )
    not_included: str = Field(description="`calibration not included` if so.")
    inputs_sha256: dict[str, str] = Field(description="SHA-256 of the result file, by name.")
    software_version: str = Field(description="Version of the program.")
