"""Environment that computed a result: program, libraries and processor, all that its last bits may depend on.

Stored with every result, so that a repetition on another machine can name the differences.
"""

from __future__ import annotations

import functools
import hashlib
import json
import platform
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path

from stereorig.server.formats.version import software_version

#: packages whose arithmetic reaches the numbers of a result
_LIBRARIES = ("numpy", "scipy", "numba", "llvmlite", "opencv-python-headless", "netCDF4")
#: packages whose code computes; a hash of it distinguishes versions of a checkout that have the same number
_CODE = ("core", "server/compute", "server/formats")


@dataclass(frozen=True)
class Environment:
    """Program, libraries and processor.

    Attributes
    ----------
    software_version, code_sha256
        Version of this program; SHA-256 of its modules that compute.
    python, libraries
        Versions.
    processor
        Name of the model.
    processor_kind
        Architecture and features that kernels are compiled for, as LLVM names them. Two models of one kind execute
        the same instructions.
    system
        Operating system and C library.
    """

    software_version: str = ""
    code_sha256: str = ""
    python: str = ""
    libraries: dict[str, str] = field(default_factory=dict)
    processor: str = ""
    processor_kind: str = ""
    system: str = ""

    def text(self) -> str:
        """Return it as JSON, one line."""
        return json.dumps(asdict(self), sort_keys=True)

    @staticmethod
    def of(text: str) -> Environment | None:
        """Read the JSON that :meth:`text` wrote; None if it is empty or something else."""
        try:
            found = json.loads(text)
        except ValueError:
            return None
        if not isinstance(found, dict):
            return None
        names = set(Environment.__dataclass_fields__) - {"libraries"}
        libraries = found.get("libraries")
        return Environment(
            **{name: str(found.get(name, "")) for name in names},
            libraries={str(k): str(v) for k, v in libraries.items()} if isinstance(libraries, dict) else {},
        )


@dataclass(frozen=True)
class Change:
    """One difference between two environments.

    Parameters
    ----------
    what
        ``version``, ``code``, ``python``, ``processor``, ``processor_kind``, ``system`` or a library's name.
    before, now
        Value in each; None if it is not known, or not installed.
    """

    what: str
    before: str | None
    now: str | None

    def text(self) -> str:
        """Return it as a phrase."""
        return f"{self.what}: {self.before or 'not known'} -> {self.now or 'not known'}"


@functools.cache
def current_environment() -> Environment:
    """Return the environment of this process."""
    return Environment(
        software_version=software_version(),
        code_sha256=_code_sha256(),
        python=platform.python_version(),
        libraries={name: version for name in _LIBRARIES if (version := _version_of(name)) is not None},
        processor=_processor(),
        processor_kind=_processor_kind(),
        system=f"{platform.system()} {' '.join(platform.libc_ver())}".strip(),
    )


def changes_between(before: Environment | None, now: Environment) -> list[Change]:
    """Return the differences; a result without a stored environment gives one change, ``environment``."""
    if before is None:
        return [Change("environment", None, f"stereorig {now.software_version} on {now.processor}")]
    names = {"software_version": "version", "code_sha256": "code", "python": "python", "system": "system"}
    names |= {"processor": "processor", "processor_kind": "processor_kind"}
    pairs = [(shown, getattr(before, name), getattr(now, name)) for name, shown in names.items()]
    libraries = sorted({*before.libraries, *now.libraries})
    pairs += [(name, before.libraries.get(name), now.libraries.get(name)) for name in libraries]
    return [Change(what, then or None, today or None) for what, then, today in pairs if (then or None) != today]


def _version_of(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _modules() -> Iterator[tuple[str, Path]]:
    root = Path(__file__).resolve().parents[2]
    for folder in _CODE:
        for path in sorted((root / folder).rglob("*.py")):
            yield path.relative_to(root).as_posix(), path


def _code_sha256() -> str:
    digest = hashlib.sha256()
    for name, path in _modules():
        content = path.read_bytes()
        digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def _processor_kind() -> str:
    from llvmlite import binding  # numba's own: loaded only where something is computed or compared

    features = binding.get_host_cpu_features().flatten()
    return f"{platform.machine()} {binding.get_host_cpu_name()} {hashlib.sha256(features.encode()).hexdigest()[:12]}"
