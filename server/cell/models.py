"""Finite element results that a client sent, read behind walls."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from stereorig.server.cell.cell import Cell, require
from stereorig.server.cell.sandbox import ReadingLimits, end_at_opening
from stereorig.server.formats.hdf5_parts import require_own_parts
from stereorig.server.formats.models.mesh_file import MeshFile
from stereorig.server.formats.models.read import ModelFile, ReadAs, read_model
from stereorig.server.formats.results.netcdf import dataset_bytes, opened

_MOST_BYTES, _LEAST_BYTES = 3 << 30, 1 << 30
_FACTOR = 16  # numbers are packed to a quarter, and the cells' nodes and data are held twice


def described(cell: Cell, files: Mapping[str, Path], main: str, how: Mapping[str, object]) -> dict[str, object]:
    """Read a model; return its units, the name of its displacement and the number of its nodes.

    Parameters
    ----------
    files
        The model's file and its heavy data, by name.
    main
        Name of the first.
    how
        It is read: unit, displacement, time; see :func:`stereorig.server.formats.models.read.read_model`.

    Raises
    ------
    FileFormatError, InputError
        As there.
    FileFormatError, TooLargeError, QueueFullError
        As `Cell.read`.
    """
    found: dict[str, object] = _through(cell, _describe, files, main, how)
    require(type(found.get("nodes")) is int and isinstance(found.get("unit"), str), "the model")
    return found


def model(cell: Cell, files: Mapping[str, Path], main: str, how: Mapping[str, object]) -> ModelFile:
    """Read a model; see :func:`described`. Of its data the displacement alone comes back."""
    found = _through(cell, _read, files, main, how)
    nodes, moved, cells = found["nodes_mm"], found["displacement_mm"], found["cells"]
    require(nodes.ndim == 2 and nodes.shape[1] == 3 and moved.shape == nodes.shape, "the model")
    require(nodes.dtype == np.float64 and moved.dtype == np.float64, "the model")
    for _, corners in cells:
        require(corners.ndim == 2 and corners.dtype == np.int64, "the model")
        require(not corners.size or bool(corners.min() >= 0 and corners.max() < len(nodes)), "the model")
    require(type(found["corners_only"]) is int, "the model")
    held = [(kind, corners) for kind, corners in cells]
    mesh = MeshFile(nodes, held, {}, {"": "mm"}, found["time"], found["corners_only"])
    require(type(found["plane"]) is bool, "the model")
    return ModelFile(
        mesh, nodes, moved, found["unit"], found["displacement_unit"], found["displacement"], found["plane"]
    )


def _through(
    cell: Cell, read: Callable[..., Any], files: Mapping[str, Path], main: str, how: Mapping[str, object]
) -> Any:
    size = sum(path.stat().st_size for path in files.values())
    limits = ReadingLimits(memory_bytes=min(_MOST_BYTES, _LEAST_BYTES + _FACTOR * size))
    return cell.read(read, list(files.values()), list(files), main, dict(how), of="the model", limits=limits)


def warm_up() -> None:
    """Load the parts of the libraries that they load with their first file only."""
    content = dataset_bytes(lambda data: data.createDimension("n", 1))
    with opened(Path("n.nc"), content):
        pass


def _describe(files: list[BinaryIO], names: list[str], main: str, how: ReadAs) -> dict[str, object]:
    read = _model(files, names, main, how)
    return {"unit": read.unit, "displacement": read.displacement_name, "nodes": len(read.nodes_mm)}


def _read(files: list[BinaryIO], names: list[str], main: str, how: ReadAs) -> dict[str, object]:
    read = _model(files, names, main, how)
    return {
        "nodes_mm": read.nodes_mm,
        "displacement_mm": read.displacement_mm,
        "cells": read.mesh.cells,
        "unit": read.unit,
        "displacement_unit": read.displacement_unit,
        "displacement": read.displacement_name,
        "plane": read.plane,
        "time": read.mesh.time,
        "corners_only": read.mesh.corners_only,
    }


def _model(files: list[BinaryIO], names: list[str], main: str, how: ReadAs) -> ModelFile:
    with contextlib.ExitStack() as held:
        contents: dict[str, Any] = {}
        for name, file in zip(names, files, strict=True):
            content = file.read()
            contents[name] = content
            if name != main:
                require_own_parts(Path(name), content)
                contents[name] = held.enter_context(opened(Path(name), content))
        end_at_opening()
        return read_model(Path(main), contents=contents, **how)
