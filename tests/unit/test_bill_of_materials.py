"""The wheel's bill of materials: what is in it, under which licences, and where it lies in the wheel."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

from tests.bench.documents.bill_of_materials import NAME, document, put_into
from tests.support.requirements import ROOT

# what may be linked with and shipped beside a program under BSD-3-Clause
PERMISSIVE = {
    *("MIT", "MIT-CMU", "BSD-2-Clause", "BSD-3-Clause", "0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "ISC"),
    *("PSF-2.0", "Zlib", "CC0-1.0", "HPND", "Unlicense", "Python-2.0"),
}
# files of their own, unchanged
BY_FILE = {"certifi": {"MPL-2.0"}}


def test_all_that_the_program_needs_is_named_with_its_version_and_a_permissive_licence() -> None:
    bill = document()
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert bill["metadata"]["component"]["licenses"] == [{"expression": "BSD-3-Clause"}]
    parts = {one["name"]: one for one in bill["components"]}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {re.split(r"[^A-Za-z0-9-]", one)[0].lower() for one in project["dependencies"]} <= set(parts)
    for name, one in parts.items():
        assert one["version"] == metadata.version(name)
        assert one["purl"] == one["bom-ref"] == f"pkg:pypi/{name}@{one['version']}"
        (stated,) = one["licenses"]
        words = stated["expression"] if "expression" in stated else stated["license"]["name"]
        terms = set(re.split(r" (?:AND|OR) ", words.replace("(", "").replace(")", "")))
        assert terms <= PERMISSIVE | BY_FILE.get(name, set()), name


def test_it_lies_in_the_wheel_and_in_its_record(tmp_path: Path) -> None:
    wheel = tmp_path / "stereorig-1-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("core/__init__.py", "")
        archive.writestr("stereorig-1.dist-info/RECORD", "core/__init__.py,,\nstereorig-1.dist-info/RECORD,,\n")
    for _ in range(2):  # a second time it takes the first one's place
        beside = put_into(wheel)
        with zipfile.ZipFile(wheel) as archive:
            assert archive.testzip() is None
            names = archive.namelist()
            text = archive.read(f"stereorig-1.dist-info/sboms/{NAME}")
            record = archive.read("stereorig-1.dist-info/RECORD").decode().splitlines()
        assert sorted(names) == sorted(line.split(",")[0] for line in record)
        assert len(names) == 3
        digest = base64.urlsafe_b64encode(hashlib.sha256(text).digest()).decode().rstrip("=")
        assert f"stereorig-1.dist-info/sboms/{NAME},sha256={digest},{len(text)}" in record
        assert json.loads(text) == document() == json.loads(beside.read_text(encoding="utf-8"))
