"""Coverage-guided fuzzing of one reader of foreign files, in a process of its own.

::

    python -m tests.fuzz.readers --reader NAME --executions N [--seed S]
    make fuzzreaders ARGS="--executions 1000000"                # each reader in turn

A reader may raise the project's errors and no other, open no file, and take no memory beyond its bound. What it must
not do ends the process with the input in ``crash-...`` beside a traceback. The corpus is made by the writers, and from
`tests/fuzz/corpus/NAME`, where inputs lie that once did harm.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

CORPUS = Path(__file__).parent / "corpus"
MEMORY_BYTES = 3 << 30  # of the whole process, its libraries among it
LONGEST = 6000
Reader = Callable[[bytes], object]


def readers() -> dict[str, Reader]:
    """Return each reader by its name, as a function of a file's bytes."""
    from stereorig.server.base.models import Document
    from stereorig.server.formats.calibrations.recognise import imported_content
    from stereorig.server.formats.channel_table import read_channel_table
    from stereorig.server.formats.hdf5_parts import require_own_parts
    from stereorig.server.formats.images import decode, decode_mask
    from stereorig.server.formats.models.read import read_model
    from stereorig.server.formats.results.netcdf import opened
    from stereorig.server.store.bundle.content import MANIFEST, Contents, check_names
    from stereorig.server.store.durable import record_of

    def calibration(data: bytes) -> object:
        return json.dumps(imported_content(data, name="a"), ensure_ascii=False).encode()

    def manifest(data: bytes) -> None:
        try:
            document = json.loads(data)
        except (ValueError, RecursionError):
            return
        if isinstance(document, dict):
            read: Document = record_of(Contents, document, Path(MANIFEST))
            check_names(read, [MANIFEST, *read.files])  # type: ignore[attr-defined]

    def result(data: bytes) -> None:
        require_own_parts(Path("a.nc"), data)
        with opened(Path("a.nc"), data) as held:
            for variable in held.variables.values():
                if variable.size < 1_000_000:
                    variable[...]

    def model(ending: str) -> Reader:
        return lambda data: read_model(Path(f"a{ending}"), unit="mm", contents={f"a{ending}": data, "a.h5": HDF5})

    def heavy(data: bytes) -> object:
        return read_model(
            Path("a.xdmf"), unit="mm", contents={"a.xdmf": _xdmf("HDF", "a.h5:/x", "a.h5:/t"), "a.h5": data}
        )

    return {
        "image": lambda data: decode(data),
        "mask": lambda data: decode_mask(data),
        **dict.fromkeys(("opencv", "dice_xml", "vic3d", "caldat", "pyvale", "dice_txt", "native"), calibration),
        "channels": read_channel_table,
        "vtu": model(".vtu"),
        "xdmf": model(".xdmf"),
        "heavy": heavy,
        "table": model(".csv"),
        "manifest": manifest,
        "result": result,
    }


HDF5 = b""


def _xdmf(form: str, points: str, corners: str) -> bytes:
    item = f'<DataItem Dimensions="{{}}" Format="{form}">{{}}</DataItem>'
    return (
        f'<Xdmf><Domain><Grid><Topology TopologyType="Triangle">{item.format("2 3", corners)}</Topology><Geometry>'
        f'{item.format("4 3", points)}</Geometry><Attribute Name="U" AttributeType="Vector">'
        f"{item.format('4 3', points)}</Attribute></Grid></Domain></Xdmf>"
    ).encode()


def seeds() -> dict[str, list[bytes]]:
    """Return right files of each reader, as small as they come."""
    import io

    import h5py
    import netCDF4
    import numpy as np
    import tifffile
    from PIL import Image

    from tests.support.damaged_images import KINDS

    grey = (np.arange(16 * 24) % 251).astype(np.uint8).reshape(16, 24)

    def saved(form: str, image: Image.Image | None = None, **options: object) -> bytes:
        out = io.BytesIO()
        (image or Image.fromarray(grey)).save(out, form, **options)
        return out.getvalue()

    def tiff(**options: object) -> bytes:
        out = io.BytesIO()
        tifffile.imwrite(out, grey, photometric="minisblack", **options)
        return out.getvalue()

    rgb = Image.fromarray(np.dstack([grey, grey[::-1], grey]))
    images = [saved("PNG"), saved("BMP"), saved("JPEG"), saved("PNG", rgb), saved("JPEG", rgb, progressive=True)]
    images += [
        saved("PNG", rgb.quantize(8)),
        saved("BMP", rgb.quantize(8)),
        tiff(),
        tiff(compression="zlib", tile=(16, 16)),
    ]
    images += [saved("TIFF", compression=c) for c in ("tiff_lzw", "packbits", "lzma", "jpeg")]
    images += [saved("PNG", Image.fromarray(grey > 9)), saved("TIFF", Image.fromarray(grey > 9)), KINDS["jpeg"][:3000]]
    matrix = "[[1000.0, 0, 12.5], [0, 1000.0, 8], [0, 0, 1]]"
    opencv = f"cameraMatrix1: {matrix}\ncameraMatrix2: {matrix}\ndistCoeffs1: [0, 0, 0, 0]\ndistCoeffs2: [0, 0, 0, 0]\n"
    opencv += "R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nT: [100, 0, 0]\nimageSize: [24, 16]\n"
    xml = '<opencv_storage><cameraMatrix1 type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>'
    xml += "<data>1000. 0. 12. 0. 1000. 8. 0. 0. 1.</data></cameraMatrix1></opencv_storage>"
    camera = '<Parameter name="{}" value="1000" />'
    dice = '<ParameterList><Parameter name="xml_file_format" value="DICe_xml_camera_system_file" />'
    dice += '<Parameter name="system_type_3D" value="OPENCV" />'
    for k in range(2):
        numbers = "".join(camera.format(key) for key in ("CX", "CY", "FX", "FY"))
        dice += f'<ParameterList name="CAMERA {k}">{numbers}<Parameter name="TX" value="{k}"/></ParameterList>'
    vic = "<calibration>" + "".join(
        f'<camera id="{k}">12 8 1000 1000 0 0 0 0<orientation>0 0 0 {100 * k} 0 0</orientation></camera>'
        for k in (0, 1)
    )
    caldat = [
        f"Cam{k}_{key};1000" for k in (0, 1) for key in ("Fx [pixels]", "Fy [pixels]", "Cx [pixels]", "Cy [pixels]")
    ]
    caldat += ["Tx [mm];100", "Ty [mm];0", "Tz [mm];0", "Theta [deg];0", "Phi [deg];0", "Psi [deg];0"]
    pyvale = [f"cam{k}_{key}_px,1000" for k in (0, 1) for key in ("fx", "fy", "fs", "cx", "cy")]
    pyvale += [f"cam{k}_{key},0" for k in (0, 1) for key in ("k1", "k2", "p1", "p2", "k3")]
    pyvale += ["tx_mm,100", "ty_mm,0", "tz_mm,0", "theta_deg,0", "phi_deg,0", "psi_deg,0"]
    text = "12 8 1000 1000 0 0 0 0 12 8 1000 1000 0 0 0 0 0 0 0 100 0 0".replace(" ", "\n")
    own = {"fx_px": 1e3, "fy_px": 1e3, "cx_px": 12.0, "cy_px": 8.0, "alpha_rad": 0.0, "beta_rad": 0.0, "gamma_rad": 0.0}
    pair = {f"cam{k + 1}": {**own, "x0_mm": 100.0 * k, "y0_mm": 0.0, "z0_mm": 400.0} for k in (0, 1)}
    array = '<DataArray type="Float64" Name="{}" NumberOfComponents="3" format="ascii">0 0 0 1 0 0 0 1 0</DataArray>'
    cells = '<DataArray type="Int64" Name="connectivity" format="ascii">0 1 2</DataArray><DataArray type="Int64" '
    cells += (
        'Name="offsets" format="ascii">3</DataArray><DataArray type="UInt8" Name="types" format="ascii">5</DataArray>'
    )
    piece = f"<Points>{array.format('P')}</Points><Cells>{cells}</Cells><PointData>{array.format('U')}</PointData>"
    head = '<VTKFile type="UnstructuredGrid"><UnstructuredGrid><Piece NumberOfPoints="3" NumberOfCells="1">'
    vtu = f"{head}{piece}</Piece></UnstructuredGrid></VTKFile>".encode()
    packed = vtu.replace(b'format="ascii">0 0 0 1 0 0 0 1 0<', b'format="binary">AQAAAAAAAAAAAAAACAAAAHicAwAAAAAB<')
    numbers = "0 0 0 1 0 0 0 1 0 1 1 0"
    with tempfile.TemporaryDirectory() as folder:
        with h5py.File(f"{folder}/a.h5", "w") as file:
            file["x"], file["t"] = np.array(numbers.split(), float).reshape(4, 3), [[0, 1, 2], [1, 3, 2]]
        with netCDF4.Dataset(f"{folder}/a.nc", "w") as data:
            data.createDimension("n", 4)
            data.createVariable("w", "f4", ("n",), zlib=True)[:] = 1.0
        hdf5, netcdf = (Path(folder, name).read_bytes() for name in ("a.h5", "a.nc"))
    test = "tests/t000001-abcdef/test.json"
    manifest = {"format": 1, "test_id": "t000001-abcdef", "files": {test: {"bytes": 1, "sha256": "0" * 64}}}
    return {
        "image": images,
        "mask": images,
        "opencv": [opencv.encode(), xml.encode()],
        "dice_xml": [(dice + "</ParameterList>").encode()],
        "vic3d": [(vic + "</calibration>").encode()],
        "caldat": ["\n".join(caldat).encode()],
        "pyvale": ["\n".join(pyvale).encode()],
        "dice_txt": [text.encode()],
        "native": [json.dumps(pair).encode()],
        "channels": [
            b"time_s;force [kN]\n0;1,5\n1;2,5\n2;3\n",
            b"t,f\ns,kN\n2026-03-01T12:00:00Z,1\n2026-03-01T12:00:01Z,2\n",
        ],
        "vtu": [vtu, packed.replace(b"<VTKFile", b'<VTKFile compressor="vtkZLibDataCompressor"')],
        "xdmf": [
            _xdmf("XML", numbers, "0 1 2 1 3 2"),
            _xdmf("XML", numbers, "0 1 2 1 3 2").replace(b"Triangle", b"Mixed"),
        ],
        "heavy": [hdf5],
        "table": [b"x_mm,y_mm,z_mm,u_mm,v_mm,w_mm\n0,0,0,1,0,0\n1,0,0,1,0,0\n0,1,0,1,0,0\n"],
        "manifest": [json.dumps(manifest).encode()],
        "result": [netcdf],
    }


def fuzz(name: str, executions: int, seed: int) -> None:
    """Run one reader in this process; it does not return."""
    import atheris

    with atheris.instrument_imports(include=["stereorig.server.formats", "stereorig.server.store.bundle"]):
        from stereorig.core.errors import StereorigError

        read = readers()[name]
    started = seeds()
    globals()["HDF5"] = started["heavy"][0]
    for data in started[name]:
        with contextlib.suppress(StereorigError):
            read(data)  # what is loaded or opened with the first file only
    reading = False

    def watch(event: str, arguments: tuple[object, ...]) -> None:
        if "encodings" in str(arguments[:1]):  # Python loads a text's encoding, by its name, from its own folder
            return
        if reading and event in ("open", "socket.connect", "subprocess.Popen", "os.system", "ctypes.dlopen"):
            raise RuntimeError(f"the reader asked for {event} {str(arguments[:1])[:80]}")

    sys.addaudithook(watch)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def one(data: bytes) -> None:
        nonlocal reading
        reading = True
        try:
            read(data)
        except StereorigError as error:
            if len(str(error)) > 2000:
                raise RuntimeError("an error of more than 2,000 characters") from error
        finally:
            reading = False

    with tempfile.TemporaryDirectory() as folder:
        for k, data in enumerate(started[name]):
            Path(folder, f"seed{k}").write_bytes(data)
        kept = CORPUS / name
        folders = [folder, *([str(kept)] if kept.is_dir() else [])]
        options = [f"-runs={executions}", f"-seed={seed}", f"-max_len={LONGEST}", "-timeout=20", "-rss_limit_mb=0"]
        atheris.Setup([sys.argv[0], *options, "-print_final_stats=1", *folders], one)
        atheris.Fuzz()


def main(arguments: list[str] | None = None) -> int:
    """Fuzz one reader, or each in turn; return 1 if one did what it must not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reader", help="its name; left out, each in turn")
    parser.add_argument("--executions", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args(arguments)
    if asked.reader is not None:
        fuzz(asked.reader, asked.executions, asked.seed)
        return 0
    failed = []
    for name in readers():
        code, seconds, said = run(name, asked.executions, asked.seed)
        print(
            f"{name:10s} {asked.executions} executions {seconds:7.1f} s {'whole' if code == 0 else 'FAILED'}",
            flush=True,
        )
        if code:
            failed.append(name)
            print(said[-3000:])
    return int(bool(failed))


def run(name: str, executions: int, seed: int) -> tuple[int, float, str]:
    """Fuzz a reader in a process of its own; return its exit status, seconds and output."""
    begin = time.monotonic()
    command = [sys.executable, "-m", "tests.fuzz.readers", "--reader", name, "--executions", str(executions)]
    with tempfile.TemporaryDirectory() as folder:
        path = {"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin"}
        done = subprocess.run(
            [*command, "--seed", str(seed)],
            capture_output=True,
            text=True,
            errors="replace",
            cwd=folder,
            env=path,
            check=False,
        )
        made = [
            file.read_bytes() for file in Path(folder).iterdir() if file.name.startswith(("crash-", "timeout-", "oom-"))
        ]
    said = done.stdout + done.stderr + "".join(f"\ninput: {data!r}" for data in made)
    return done.returncode, time.monotonic() - begin, said


if __name__ == "__main__":
    sys.exit(main())
