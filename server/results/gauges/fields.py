"""Whole fields in the frame and without the motion that gauges were asked for, as result files."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.server.formats.files import make_folder
from stereorig.server.formats.gauges.readings import FrameReading, RigidMotionReading
from stereorig.server.formats.results.netcdf import rename_axes
from stereorig.server.formats.results.reading import ResultHead
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.formats.version import software_version
from stereorig.server.results.gauges.frames import text_of
from stereorig.server.results.gauges.request import GaugeRequest

#: ending of the axes' names in another frame, as X_sys is of the system
AXES = "_frame"
_CARRIED = ("label", "load_n", "test_step", "reference_step", "cam1_file", "cam2_file")


class FieldWriter:
    """Writes the field of each step that gauges are read in, as ``step_<nnnn>.nc``.

    Parameters
    ----------
    folder
        Where to; made if it is not there.
    source
        Where the results come from.
    request
        The request.
    strain
        False leaves the strain out, which takes most of the time.

    Raises
    ------
    InputError
        ``output_unusable`` if both folders are one; ``option_conflict`` where the request leaves fields as they are.
    """

    def __init__(self, folder: Path, source: Path, request: GaugeRequest, *, strain: bool = True) -> None:
        if request.align is None and request.remove_rigid is None:
            raise InputError(
                "The fields are asked for as they were measured: they are there already.",
                code="option_conflict",
                remedy="Give a frame, or take the rigid motion out.",
            )
        if folder.absolute().resolve() == source.absolute().resolve():
            raise InputError(
                f"{folder} holds the results that are read.", code="output_unusable", remedy="Give another folder."
            )
        make_folder(folder)
        self._folder, self._request, self._with_strain = folder, request, strain
        self.written: list[Path] = []

    def __call__(
        self,
        path: Path,
        sha256: str,
        head: ResultHead,
        field: Field,
        frame: FrameReading | None,
        motion: RigidMotionReading | None,
    ) -> None:
        """Write one step; strain, if the result has it, is computed again along the new axes."""
        from stereorig.core.strain import surface_strain  # slow to load, and not every start needs it

        strain = read_strain(path) if self._with_strain else None
        if strain is not None:
            strain = surface_strain(field, strain.options, subset_px=strain.subset_px)
        extra = {name: str(head.attributes[name]) for name in _CARRIED if name in head.attributes}
        extra["made_from"] = f"{path.name}, SHA-256 {sha256}"
        extra["transformation"] = json.dumps(
            {
                "align": None if self._request.align is None else self._request.align.model_dump(mode="json"),
                "alignment": None if frame is None else asdict(frame),
                "remove_rigid": None
                if self._request.remove_rigid is None
                else self._request.remove_rigid.model_dump(mode="json"),
                "rigid_motion": None if motion is None else asdict(motion),
            },
            sort_keys=True,
        )
        described = head.frame
        if self._request.align is not None:
            described = f"{text_of(self._request.align)}; before: {described}"
        provenance = Provenance(
            settings=head.settings,
            inputs=head.inputs_sha256,
            software_version=software_version(),
            frame=described,
            step=head.step,
            extra=extra,
        )
        to = self._folder / path.name
        write_field(to, field, provenance, strain)
        if self._request.align is not None:
            rename_axes(to, "_sys", AXES)
        self.written.append(to)
