"""What an installation brings: bounded, and known by checksum in the list of a release."""

from __future__ import annotations

import re

from tests.bench.documents.constraints import LIST, pinned, project, unbounded
from tests.bench.documents.install_size import key


def test_every_package_that_the_program_needs_has_an_upper_bound() -> None:
    table = project()
    extras = table["optional-dependencies"]
    asked = [
        *table["dependencies"],
        *(one for name in ("xarray", "s3", "progress", "dask", "aravis", "pylon", "standa") for one in extras[name]),
    ]  # type: ignore[misc, index]
    assert [one for one in asked if "<" not in one] == []
    assert not [one for one in unbounded() if "<" in one]
    assert [one for one in unbounded() if one.startswith("numpy>=")]


def test_the_list_of_a_release_has_a_version_and_checksums_of_each_and_names_no_index() -> None:
    text = LIST.read_text(encoding="utf-8")
    assert "://" not in text
    entries = re.split(r"(?m)^(?=[a-z0-9])", text)[1:]
    assert all(re.fullmatch(r"[a-z0-9-]+==\S+( \\\n    --hash=sha256:[0-9a-f]{64})+\n", entry) for entry in entries)
    names = {key(re.split(r"[<>=\[]", one)[0]) for one in project()["dependencies"]}  # type: ignore[attr-defined]
    assert names <= set(pinned())
    assert len(entries) == len(pinned())
