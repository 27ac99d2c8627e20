"""The table of variables: every quantity of a result's points, declared once.

Result files, exports, the API, the page, gauges and frames read a quantity's unit, meaning, label, group and behaviour
here. A further quantity of the strain is one row of :data:`STRAIN`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField

Group = Literal["Displacement", "Strain", "Shape", "Quality", "Standard uncertainty", "Internals"]
Kind = Literal["number", "strain", "angle"]
Part = Literal["none", "field", "strain"]
SIGMA, EXPANDED, PATCH = "sigma_", "expanded_", "_patch"


@dataclass(frozen=True)
class Of:
    """Reads an attribute of a field or of its strain: as it is, or one component of its last axis."""

    attribute: str
    component: int | None = None

    def __call__(self, result: Any) -> Float | None:
        """Return the (r, c) values; None if the result has none."""
        held: Float | None = getattr(result, self.attribute)
        return held if held is None or self.component is None else held[..., self.component]


@dataclass(frozen=True)
class Variable:
    """One quantity of the points.

    Attributes
    ----------
    name
        Name in result files, exports and requests.
    units
        Unit of the stored numbers.
    long_name
        Meaning; ``{tensor}`` is replaced by the name of the strain tensor.
    values, sigma
        Return the (r, c) values and standard deviations: of a `Field`, in :data:`STRAIN` of a `StrainField`. None if a
        module of its own writes them.
    label
        Name that people read; empty: the name.
    group
        Heading that the quantity is listed under.
    kind
        ``strain`` is shown in um/m, ``angle`` in degrees, ``number`` in its unit.
    part
        Part of a result that must be computed again for other axes: none, the field, or the strain.
    relative
        True if the quantity is zero at the reference step by definition.
    sigma_note
        Restriction of the standard deviation, appended to its meaning.
    dtype
        Type of the stored numbers.
    """

    name: str
    units: str
    long_name: str
    values: Callable[[Any], Float | None] | None = None
    sigma: Callable[[Any], Float | None] | None = None
    label: str = ""
    group: Group = "Internals"
    kind: Kind = "number"
    part: Part = "field"
    relative: bool = False
    sigma_note: str = ""
    dtype: str = "f8"

    @property
    def shown(self) -> str:
        """Name that people read."""
        return self.label or self.name.replace("_", " ")


SHAPE = (
    Variable("x_px", "pixel", "column of the point in camera 1's reference image", Of("x_px"), part="none"),
    Variable("y_px", "pixel", "row of the point in camera 1's reference image", Of("y_px"), part="none"),
    *(
        Variable(
            f"{axis}_mm",
            "mm",
            f"reference position of the material point, {axis.upper()}_sys",
            Of("xyz_mm", k),
            label=axis.upper(),
            group="Shape",
        )
        for k, axis in enumerate("xyz")
    ),
    *(
        Variable(f"normal_{axis}", "1", f"surface normal, {axis.upper()}_sys component", Of("normal_sys", k))
        for k, axis in enumerate("xyz")
    ),
    Variable(
        "theta_rad",
        "rad",
        "angle of the patch's normal to X_cam1, Eq. (12)",
        Of("theta_rad"),
        label="theta",
        part="none",
    ),
    Variable(
        "phi_rad", "rad", "angle of the patch's normal to Y_cam1, Eq. (12)", Of("phi_rad"), label="phi", part="none"
    ),
    Variable(
        "zp_mm", "mm", "where camera 1's axis meets the patch's plane, Eq. (12)", Of("zp_mm"), label="zp", part="none"
    ),
    Variable(
        "epipolar_px",
        "pixel",
        "full offset across the epipolar line in camera 2; half of it is left in each image when both share it",
        Of("epipolar_px"),
        label="epipolar offset",
        group="Quality",
        part="none",
        dtype="f4",
    ),
    Variable(
        "noise_grey",
        "count",
        "noise of the reference image, from the residuals",
        Of("noise_grey"),
        label="image noise",
        group="Quality",
        part="none",
        dtype="f4",
    ),
)
MOTION = (
    *(
        Variable(
            f"{name}_mm",
            "mm",
            f"displacement from the reference, {axis}_sys component",
            Of("uvw_mm", k),
            label=name.upper(),
            group="Displacement",
            relative=True,
        )
        for k, (name, axis) in enumerate(zip("uvw", "XYZ", strict=True))
    ),
    *(
        Variable(
            f"rotation_{axis}_rad",
            "rad",
            f"rotation vector of the patch, {axis.upper()}_sys component",
            Of("rotation_rad", k),
        )
        for k, axis in enumerate("xyz")
    ),
    *(
        Variable(
            f"stretch_{entry}", "1", f"in-plane stretch of the patch, e{entry} in its tangent frame", Of("stretch", k)
        )
        for k, entry in enumerate(("11", "22", "12"))
    ),
)
CURVATURE = tuple(
    Variable(
        f"curvature_{k + 1}",
        "mm-1",
        f"{which} principal curvature of the reference's surface, positive where it bulges towards the cameras",
        Of("curvature_per_mm", k),
    )
    for k, which in enumerate(("larger", "smaller"))
)
#: size of the displacement, derived on reading
SIZE = Variable(
    "d_mm",
    "mm",
    "size of the displacement from the reference, sqrt(u^2 + v^2 + w^2)",
    label="|d|, size of the displacement",
    group="Displacement",
    relative=True,
    sigma_note=", linearised; none where the point did not move",
)
#: names of the three components that the covariances of strain hold, in their order
STRAIN_NAMES = ("exx", "eyy", "exy")
STRAIN = (
    *(
        Variable(
            name,
            "1",
            f"{{tensor}}, {component}",
            Of("strain", k),
            Of("sigma", k),
            group="Strain",
            kind="strain",
            part="strain",
            relative=True,
        )
        for k, (name, component) in enumerate(
            zip(STRAIN_NAMES, ("along axis 1", "along axis 2", "shear of the tensor"), strict=True)
        )
    ),
    *(
        Variable(
            f"e{k + 1}",
            "1",
            f"{{tensor}}, {which} principal value",
            Of("principal", k),
            Of("sigma_principal", k),
            label=f"e{k + 1}, {which} principal",
            group="Strain",
            kind="strain",
            part="none",
            relative=True,
            sigma_note=", linearised",
        )
        for k, which in enumerate(("larger", "smaller"))
    ),
    Variable(
        "strain_angle_rad",
        "rad",
        "direction of e1 from axis 1 towards axis 2; none where its standard deviation is above 0.25 rad",
        Of("direction_rad"),
        Of("sigma_direction_rad"),
        label="direction of e1",
        group="Strain",
        kind="angle",
        part="strain",
        sigma_note=", linearised",
    ),
    Variable(
        "max_shear",
        "1",
        "largest in-plane shear of the tensor, (e1 - e2) / 2",
        Of("max_shear"),
        Of("sigma_max_shear"),
        label="max. shear",
        group="Strain",
        kind="strain",
        part="none",
        relative=True,
        sigma_note=", linearised",
    ),
    Variable(
        "von_mises",
        "1",
        "equivalent strain, sqrt(e1^2 - e1 e2 + e2^2)",
        Of("von_mises"),
        Of("sigma_von_mises"),
        label="von Mises strain",
        group="Strain",
        kind="strain",
        part="none",
        relative=True,
        sigma_note=", linearised; none where it is zero",
    ),
)
#: written by modules of their own
_OTHERS = (
    Variable("status", "1", "what can be said about the point", group="Quality", part="none"),
    Variable("zncc", "1", "zero-mean normalised correlation of each comparison", group="Quality", part="none"),
    Variable("iterations", "1", "iterations of the fit", part="none"),
    Variable(
        "reference_step",
        "1",
        "step that the point was matched against; without numbers, the newest such step that shows it",
        part="none",
    ),
    Variable(
        "strain_status",
        "1",
        "what can be said about the strain at the point",
        label="status of the strain",
        group="Quality",
        part="none",
    ),
)
VARIABLES = {one.name: one for one in (*SHAPE, *MOTION, *CURVATURE, SIZE, *STRAIN, *_OTHERS)}


def described(name: str) -> Variable:
    """Return the row of a variable; of an uncertainty or a patch's strain that of its quantity, adapted.

    A name without a row is one of the internals.
    """
    known = VARIABLES.get(name)
    if known is not None:
        return known
    for prefix, symbol in ((SIGMA, "σ"), (EXPANDED, "U")):
        if name.startswith(prefix):
            of = described(name.removeprefix(prefix))
            long_name, label = f"standard deviation of {of.name}{of.sigma_note}", f"{symbol} of {of.shown}"
            return replace(
                of, name=name, long_name=long_name, label=label, group="Standard uncertainty", relative=False
            )
    if name.endswith(PATCH) and (of_gauge := name.removesuffix(PATCH)) in STRAIN_NAMES:
        return replace(VARIABLES[of_gauge], name=name, label="", group="Internals", relative=False)
    return Variable(name, "1", "", part="strain" if "strain" in name else "field")


def field_variable(result: Field, name: str) -> tuple[Float, str, str] | None:
    """Return values (r, c), unit and meaning of a variable as a result file would hold it; None for others."""
    for one in SHAPE + MOTION + CURVATURE:
        values = one.values(result) if one.name == name and one.values is not None else None
        if values is not None:
            return values, one.units, one.long_name
    return None


def values_of(field: Field, strain: StrainField | None, name: str) -> Float | None:
    """Return the (r, c) values of a variable of the table, or its standard deviation; None if the result has none.

    Parameters
    ----------
    field, strain
        The result; None for a shape or without strain.
    name
        Name as in result files: ``w_mm``, ``sigma_w_mm``, ``exx``, ``sigma_exx``.
    """
    found = field_variable(field, name)
    if found is not None:
        return found[0]
    of = name.removeprefix(SIGMA)
    axes = "xyzuvw"[: field.covariance.shape[-1]]
    if of != name and of.endswith("_mm") and of[:-3] in axes:
        return np.asarray(field.sigma_mm[..., axes.index(of[:-3])])
    row = next((one for one in STRAIN if one.name == of), None)
    read = None if row is None else row.values if of == name else row.sigma
    return None if read is None or strain is None else read(strain)


def along_axes(strain: StrainField) -> dict[str, Float]:
    """Return the (r, c) variables of strain, by name, that depend on the axes."""
    turning = [one for one in STRAIN if one.part == "strain"]
    found = {one.name: one.values(strain) for one in turning if one.values is not None}
    found |= {SIGMA + one.name: one.sigma(strain) for one in turning if one.sigma is not None}
    if strain.patch is not None:
        found |= {name + PATCH: strain.patch[..., k] for k, name in enumerate(STRAIN_NAMES)}
    return {name: np.asarray(values) for name, values in found.items() if values is not None}
