"""One step's result: arrays, data set, gauges."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import StateError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.triangles import triangles_of
from stereorig.core.gauge.area import AreaStatistics, area_statistics, points_within
from stereorig.core.gauge.extensometer import Extensometer, extensometer
from stereorig.core.gauge.rigid import RigidMotion, rigid_motion, without_rigid_motion
from stereorig.core.settings import AnalysisSettings, StrainSettings
from stereorig.core.strain import StrainField, StrainOptions, surface_strain
from stereorig.core.strain.mean import mean_strain_variance
from stereorig.parameters import StrainParameters
from stereorig.server.base.errors import no_variable
from stereorig.server.formats.results.dataset import as_dataset
from stereorig.server.formats.results.layout import COVARIANCE_NAMES, stored_settings
from stereorig.server.formats.results.reading import read_field, read_head
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.uncertainty import Included
from stereorig.server.formats.results.variables import STRAIN_NAMES, VARIABLES, described, values_of
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.formats.version import software_version

if TYPE_CHECKING:
    import pyvista
    import xarray
    from matplotlib.figure import Figure

    from stereorig.server.formats.figures.figure import FigureData

_POSITION = ("x_mm", "y_mm", "z_mm")
_THUMBNAIL_PX = 420


@dataclass(frozen=True, eq=False)
class Result:
    """Shape, and after the reference displacement and strain, at (r, c) points.

    Attributes
    ----------
    field
        Every array: ``xyz_mm`` (r, c, 3), ``uvw_mm`` (r, c, 3) or None, ``covariance``, ``zncc``, ``status`` ...
    strain
        ``strain`` (r, c, 3) of exx, eyy, exy with ``covariance``; None for a shape, or if it was switched off.
    settings
        Settings of the measurement.
    step
        Number of the load step, 0 = the reference.
    frame
        Meaning of the system frame: ``target`` or ``camera1``.
    """

    field: Field
    strain: StrainField | None
    settings: AnalysisSettings
    step: int = 0
    frame: str = "target"
    calibration_sha256: str = ""

    @property
    def valid(self) -> Bool:
        """(r, c) True where the point has values."""
        return self.field.valid

    def __repr__(self) -> str:
        kind = "shape" if self.strain is None and not self.field.has_motion else "displacement"
        strain = "" if self.strain is None else f" with strain over {self.strain.options.window} points"
        count = f"{self.valid.sum()} of {self.valid.size} points"
        return f"<Result of step {self.step}: {kind}{strain}, {count} valid, frame: {self.frame}>"

    def _repr_html_(self) -> str:
        from stereorig.server.formats.figures.figure import draw  # slow to load
        from stereorig.server.formats.figures.options import FigureStyle

        name = self._shown
        picture = base64.b64encode(draw(self._figure(name), FigureStyle(width_px=_THUMBNAIL_PX), "png")).decode("ascii")
        sigma_um = 1e3 * float(np.median(self[f"sigma_{name}"][self.valid])) if self.valid.any() else np.nan
        text = f"{str(self)[1:-1]}; median standard uncertainty of {name} {sigma_um:.2g} um"
        return f'<p>{text}</p><img alt="Map of {name}" src="data:image/png;base64,{picture}">'

    def __getitem__(self, name: str) -> Float:
        """Return a variable (r, c) by its name in result files: ``w_mm``, ``sigma_w_mm``, ``exx``, ``sigma_exx`` ...

        Raises
        ------
        InputError
            ``field_missing`` for a name that the result does not have.
        """
        values = values_of(self.field, self.strain, name)
        if values is None:
            raise no_variable("The result", name, self._names)
        return values

    @property
    def _names(self) -> list[str]:
        names = [one for row in VARIABLES for one in (row, f"sigma_{row}")]
        return [one for one in names if values_of(self.field, self.strain, one) is not None]

    def plot(self, name: str | None = None, *, width_px: int = 900) -> Figure:
        """Draw a variable over camera 1's reference image's axes, as the exports do; a notebook shows it.

        Parameters
        ----------
        name
            Variable; None: ``w_mm`` or, for a shape, ``z_mm``.
        width_px
            Width of the picture.

        Returns
        -------
        matplotlib.figure.Figure
            With one axes for the map and one for its scale.

        Raises
        ------
        InputError
            ``field_missing``.
        """
        from stereorig.server.formats.figures.figure import Drawing  # slow to load
        from stereorig.server.formats.figures.options import FigureStyle

        return Drawing(self._figure(name or self._shown), FigureStyle(width_px=width_px)).figure

    def pyvista(self) -> pyvista.PolyData:
        """Return the surface for PyVista: triangles between valid points, none over a crack, with every variable.

        ``result.pyvista().warp_by_vector("displacement", factor=100)`` is the deformed surface. Points are at their
        reference position, mm.

        Raises
        ------
        StateError
            ``pyvista_missing`` if PyVista is not installed.
        """
        try:
            import pyvista
        except ImportError as error:
            raise StateError(
                "A surface for PyVista is asked for, and PyVista is not installed.",
                code="pyvista_missing",
                remedy="pip install pyvista.",
            ) from error
        field, valid = self.field, self.valid
        triangles = triangles_of(field.x_px, field.y_px, valid, field.cuts)
        place: Any = np.cumsum(valid.ravel()) - 1  # of each valid point among them
        surface: pyvista.PolyData = pyvista.PolyData.from_regular_faces(field.xyz_mm[valid], place[triangles])
        for name in self._names:
            surface.point_data[name] = self[name][valid]
        if field.uvw_mm is not None:
            surface.point_data["displacement"] = field.uvw_mm[valid]
        surface.set_active_scalars(self._shown)
        return surface

    @cached_property
    def dataset(self) -> xarray.Dataset:
        """The step as its result file holds it, with units and long names; needs xarray."""
        return as_dataset(self.field, self._provenance, self.strain)

    def save(self, path: str | Path) -> None:
        """Write the result file (NetCDF-4), as ``stereorig measure`` does.

        Raises
        ------
        StorageError
            ``storage_full`` or ``storage_failed``.
        """
        write_field(path, self.field, self._provenance, self.strain)

    def with_strain(self, **settings: Unpack[StrainParameters]) -> Result:
        """Return the result with strain over another window, order or tensor: see :class:`stereorig.StrainSettings`.

        Raises
        ------
        StereorigError
            ``strain_needs_motion`` for a shape.
        """
        chosen = StrainSettings.model_validate(settings)
        strain = surface_strain(self.field, StrainOptions.of(chosen), subset_px=self.settings.subset_px)
        return self._with(self.field, strain, strain_settings=chosen)

    def without_rigid_motion(self, *, robust: bool = False) -> Result:
        """Return the result with the specimen's rigid motion taken out of the displacements.

        Parameters
        ----------
        robust
            Give points that move otherwise than most little weight.
        """
        motion = self.rigid_motion(robust=robust)
        return self._with(without_rigid_motion(self.field, motion, shared=self._shared), self.strain)

    def rigid_motion(self, *, robust: bool = False) -> RigidMotion:
        """Fit the rigid motion of the displacements, with its covariance."""
        return rigid_motion(self.field, shared=self._shared, robust=robust)

    def extensometer(self, a_px: ArrayLike, b_px: ArrayLike) -> Extensometer:
        """Read a virtual extensometer between two positions (x, y) of camera 1's reference image.

        Returns
        -------
        Extensometer
            ``length0_mm``, ``elongation_mm``, ``strain`` ..., each with ``value`` and ``sigma``.
        """
        return extensometer(self.field, a_px, b_px, shared=self._shared)

    @property
    def uncertainty_includes(self) -> str:
        """Sentence that names the parts of every standard uncertainty (``sigma``, k = 1), or a missing one."""
        return Included.of_field(self.field).text

    def area(self, name: str, polygon_px: ArrayLike | None = None) -> AreaStatistics:
        """Return the statistics of a variable over a polygon (n, 2), px; None: over the whole field.

        Means of positions, displacements and strains have a standard uncertainty, others have none.

        Raises
        ------
        StereorigError
            ``field_missing``, ``gauge_outside`` or ``region_unusable``.
        """
        values, inside, shared = self[name], points_within(self.field, polygon_px), self._shared
        field, frozen = self.field, self.field.frozen_covariance
        if name in COVARIANCE_NAMES[: field.covariance.shape[-1]]:
            k = COVARIANCE_NAMES.index(name)
            return area_statistics(
                field,
                values,
                np.sqrt(np.maximum(field.covariance[..., k, k], 0.0)),
                inside,
                shared=shared.positions if k < len(_POSITION) else shared,
                # the points' common error does not shrink in a mean
                common=None if field.common is None else field.common[..., k, :],
                sigma_reference=None if frozen is None else np.sqrt(np.maximum(frozen[..., k, k], 0.0)),
            )
        found = area_statistics(field, values, None, inside, shared=shared)
        if name not in STRAIN_NAMES or self.strain is None or not found.count:
            return found
        of = mean_strain_variance(self.field, self.strain.options, inside, subset_px=self.strain.subset_px)
        return found.with_mean_variance(*of.of(STRAIN_NAMES.index(name)))

    @cached_property
    def _shared(self) -> SharedPixels:
        return SharedPixels.of(self.field, float(self.settings.subset_px))

    @property
    def _shown(self) -> str:
        return "w_mm" if self.field.has_motion else "z_mm"

    def _figure(self, name: str) -> FigureData:
        from stereorig.server.formats.figures.figure import FigureData  # slow to load

        about, field = described(name), self.field
        title = f"{about.shown}, step {self.step}"
        strain = about.kind == "strain"
        return FigureData(
            self[name], field.x_px, field.y_px, about.shown, about.units, title, cuts=field.cuts, strain=strain
        )

    @property
    def _provenance(self) -> Provenance:
        return Provenance(
            settings=self.settings.model_dump(),
            inputs={"calibration": self.calibration_sha256} if self.calibration_sha256 else {},
            software_version=software_version(),
            frame=self.frame,
            step=self.step,
        )

    def _with(
        self, field: Field, strain: StrainField | None, *, strain_settings: StrainSettings | None = None
    ) -> Result:
        settings = self.settings
        if strain_settings is not None:
            settings = settings.model_copy(update={"strain": strain_settings})
        return Result(field, strain, settings, self.step, self.frame, self.calibration_sha256)


def read_result(path: str | Path) -> Result:
    """Read a result file, ``step_*.nc``.

    Raises
    ------
    StereorigError
        ``file_missing``, ``file_unreadable`` or ``format_too_new``.
    """
    head = read_head(path)
    return Result(
        read_field(path),
        read_strain(path),
        stored_settings(head.settings),
        head.step,
        head.frame,
        head.inputs_sha256.get("calibration", ""),
    )
