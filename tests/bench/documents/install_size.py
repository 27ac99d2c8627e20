"""Writes docs/explanation/install_size.md: what `pip install` of the program puts on the disk, and its first use.

::

    python -m tests.bench.documents.install_size

Sizes are read from the environment that runs it: the packages that the program needs, and theirs; extras and tests are not
counted. The first use is measured in a fresh one, minutes on a machine with nothing else to do.
"""

from __future__ import annotations

import platform
import re
import tomllib
from importlib import metadata
from pathlib import Path

from tests.bench.documents.first_use import section
from tests.support.requirements import ROOT

PAGE = ROOT / "docs" / "explanation" / "install_size.md"
#: why what weighs most is there, and what was weighed against it
_WHY = {
    "opencv-python-headless": "features and their matching for seeds and moved cameras, boards and marks, image files; the build without windows",
    "llvmlite": "the compiler behind numba",
    "scipy": "least squares, sparse algebra, B-splines, statistics, MATLAB files",
    "numpy": "arrays",
    "numba": "the matching kernels: compiled for the processor at hand, without a compiler on the machine",
    "matplotlib": "figures, films, curves of the report",
    "fonttools": "matplotlib needs it",
    "netcdf4": "result files",
    "pillow": "GIF films, previews; matplotlib needs it",
    "pydantic-core": "checks of requests, rig files and documents",
    "cftime": "netCDF4 needs it",
    "stereorig": "the program: page with 3-D view and API browser, examples, templates",
}
_SHOWN = 12
_NAME = re.compile(r"^[A-Za-z0-9._-]+")


def key(name: str) -> str:
    """Return a distribution's name as package indexes normalise it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def needed() -> list[str]:
    """Return the distributions that the program's dependencies bring, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    waiting = [_NAME.match(one)[0] for one in project["dependencies"]]  # type: ignore[index]
    found: dict[str, str] = {}
    while waiting:
        name = waiting.pop()
        if key(name) in found:
            continue
        try:
            requires = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue  # for another platform or version of Python
        found[key(name)] = name
        waiting += [_NAME.match(one)[0] for one in requires if "extra ==" not in one]  # type: ignore[index]
    return sorted(found)


def size_mib(name: str) -> float:
    """Return what a distribution's files take, compiled Python files not counted."""
    files = metadata.files(name) or []
    there = [Path(str(file.locate())) for file in files if file.suffix != ".pyc"]
    return sum(path.stat().st_size for path in there if path.is_file()) / 2**20


def own_mib() -> float:
    """Return what the program's own packages take."""
    packages = ("core", "drivers", "server", "sim", "stereorig")
    files = [path for package in packages for path in (ROOT / package).rglob("*") if path.suffix != ".pyc"]
    return sum(path.stat().st_size for path in files if path.is_file()) / 2**20


def text(first_use: list[str]) -> str:
    """Return the page, with the section on the first use."""
    sizes = {name: size_mib(name) for name in needed()} | {"stereorig": own_mib()}
    order = sorted(sizes, key=lambda name: -sizes[name])
    total = sum(sizes.values())
    rows = [f"| {n} | {sizes[n]:.1f} | {100 * sizes[n] / total:.0f} | {_WHY.get(n, '')} |" for n in order[:_SHOWN]]
    rest = order[_SHOWN:]
    rows.append(
        f"| {len(rest)} others | {sum(sizes[n] for n in rest):.1f} | {100 * sum(sizes[n] for n in rest) / total:.0f} | |"
    )
    return "\n".join(
        [
            "# Installation: its size and the first use",
            "",
            f"`pip install` puts {total:.0f} MiB on the disk: {len(sizes)} packages, Python {platform.python_version()}, {platform.machine()};",
            "compiled Python files, extras, tests and documents not counted (`python -m tests.bench.documents.install_size`).",
            "",
            "| package | MiB | % | for what |",
            "| --- | --- | --- | --- |",
            *rows,
            "",
            "The client alone would need httpx and pydantic; it is part of the one package, since its models are the service's own. Extras: `xarray`",
            "(data sets; with pandas), `progress` (bars), `aravis`, `pylon`, `dask`.",
            "",
            "What weighs most, questioned. LLVM comes with the compiler: without it kernels would have to be built for each processor, Python and system",
            "beforehand, or run without the vector units of the processor at hand. OpenCV's wheel has video codecs and neural networks that nothing here",
            "calls; there is none without them, and its features and decoders would be three packages in its place. SciPy is used from least squares to",
            "sparse factors all over `core`. Matplotlib with its fonts and Pillow, a tenth of the whole, draws figures, films and the report's curves.",
            "",
            *first_use,
        ]
    )


if __name__ == "__main__":
    PAGE.write_text(text(section()), encoding="utf-8")
    print(f"{PAGE} is written")
