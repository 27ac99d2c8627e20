"""Writes the bill of materials (CycloneDX 1.6) of the program and what it needs, into its wheel and beside it.

::

    python -m tests.bench.documents.bill_of_materials dist/stereorig-0.3.0-py3-none-any.whl

Versions and licences are those of the environment that runs it; extras and tests are not counted. In the wheel it lies where
PEP 770 wants it, in ``.dist-info/sboms``.
"""

from __future__ import annotations

import base64
import hashlib
import json
import sys
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

from tests.bench.documents.install_size import key, needed

NAME = "stereorig.cdx.json"
#: old classifiers of packages that state no licence expression, as SPDX knows them
_CLASSIFIED = {
    "License :: OSI Approved :: MIT License": "MIT",
    "License :: OSI Approved :: Apache Software License": "Apache-2.0",
    "License :: OSI Approved :: BSD License": "BSD-3-Clause",
    "License :: OSI Approved :: ISC License (ISCL)": "ISC",
    "License :: OSI Approved :: Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "License :: OSI Approved :: Python Software Foundation License": "PSF-2.0",
    "License :: OSI Approved :: Historical Permission Notice and Disclaimer (HPND)": "HPND",
}


def licence(name: str) -> dict[str, Any] | None:
    """Return a distribution's licence as CycloneDX has it: an SPDX expression, or a name; None where none is stated."""
    stated = metadata.metadata(name)
    expression = stated.get("License-Expression")
    classified = {_CLASSIFIED[one] for one in stated.get_all("Classifier") or [] if one in _CLASSIFIED}
    if expression or classified:
        return {"expression": str(expression or " AND ".join(sorted(classified)))}
    words = (stated.get("License") or "").strip().splitlines()
    return {"license": {"name": words[0][:100]}} if words else None


def _component(name: str, kind: str = "library") -> dict[str, Any]:
    version, stated = metadata.version(name), licence(name)
    reference = f"pkg:pypi/{key(name)}@{version}"
    entry = {"type": kind, "bom-ref": reference, "name": key(name), "version": version, "purl": reference}
    return entry if stated is None else {**entry, "licenses": [stated]}


def document() -> dict[str, Any]:
    """Return the bill of materials."""
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": _component("stereorig", "application")},
        "components": [_component(name) for name in needed()],
    }


def put_into(wheel: Path) -> Path:
    """Put the bill into a wheel, and write it beside; return that file."""
    text = json.dumps(document(), indent=1) + "\n"
    beside, whole = wheel.with_name(NAME), wheel.with_suffix(".part")
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as new:
        record = next(name for name in old.namelist() if name.endswith(".dist-info/RECORD"))
        inside = f"{record.rpartition('/')[0]}/sboms/{NAME}"
        lines = [line for line in old.read(record).decode().splitlines() if not line.startswith(f"{inside},")]
        digest = base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).rstrip(b"=").decode()
        for entry in old.infolist():
            if entry.filename not in {record, inside}:
                new.writestr(entry, old.read(entry))
        new.writestr(inside, text)
        new.writestr(
            record, "\n".join([*lines[:-1], f"{inside},sha256={digest},{len(text.encode())}", lines[-1]]) + "\n"
        )
    whole.replace(wheel)
    beside.write_text(text, encoding="utf-8")
    return beside


if __name__ == "__main__":
    for given in sys.argv[1:]:
        print(f"{put_into(Path(given))} is written, and lies in the wheel")
