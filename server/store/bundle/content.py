"""Content of a bundle: the files of one test by name, its manifest, and the checks of both."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from pydantic import Field

from stereorig.core.errors import FileFormatError
from stereorig.server.base.models import Document

FORMAT = 1
MANIFEST = "stereorig-bundle.json"
CRATE = "ro-crate-metadata.json"
#: files that only an unfinished analysis needs, and that go when it is finished
UNFINISHED = re.compile(r"analyses/[^/]+/(starts_[0-9]+\.npz|head_[0-9]+\.nc(\.sha256)?|head_starts_[0-9]+\.npz)")

_ID = r"[0-9]{6}-[0-9a-f]{6}"
#: names below the test's folder; nothing else ever becomes a path
_NAMES = re.compile(
    r"test\.json|workspace\.json|certificate_plan\.json|calibration\.json|calibrations/[0-9a-f]{64}\.json|"
    r"channels/[0-9]{4}\.csv|"
    r"steps/[0-9]{4}/(step\.json|cam[12]\.tif)|steps/[0-9]{4}\.deleted|"
    rf"analyses/a{_ID}/((analysis|jobs|noise|summary)\.json|mask\.png|(dense/)?step_[0-9]{{4}}\.(nc|nc\.sha256|json)|"
    r"starts_[0-9]{4}\.npz)|manifest\.json|manifest/[0-9]{8}\.json|"
    rf"models/m{_ID}/(model\.json|[A-Za-z0-9_][A-Za-z0-9._-]{{0,99}})"
)
_TEST = re.compile(rf"tests/(t{_ID})/(.+)", re.DOTALL)


class BundleFile(Document):
    """One file of a bundle."""

    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class Contents(Document):
    """``stereorig-bundle.json``: every file with its checksum, and the program that wrote the bundle."""

    format: int
    test_id: str = Field(pattern=rf"^t{_ID}$")
    created_utc: str | None = None
    written_by: str | None = None
    environment: dict[str, object] = Field(default_factory=dict)
    files: dict[str, BundleFile]


def files_of(test: Path) -> list[Path]:
    """Return the files of a test's folder that belong into a bundle, sorted; half-written ones are left out.

    The state of a watched channel is left out too: it belongs to the service that watches.
    """
    found = []
    for path in sorted(test.rglob("*")):
        name = path.relative_to(test).as_posix()
        if path.is_symlink() or not path.is_file() or _NAMES.fullmatch(name) is None:
            continue
        parts = name.split("/")
        mark = {"steps": "step.json", "analyses": "analysis.json", "models": "model.json"}.get(parts[0])
        if mark is None or len(parts) < 3 or (test / parts[0] / parts[1] / mark).is_file():
            found.append(path)
    return found


def check_names(manifest: Contents, members: list[str]) -> None:
    """Refuse a bundle whose members differ from its manifest's, or are no files of one test.

    Raises
    ------
    FileFormatError
        ``bundle_altered`` or ``bundle_refused``.
    """
    for name in (*members, *manifest.files):
        found = _TEST.fullmatch(name)
        if name in (MANIFEST, CRATE):
            continue
        if found is None or found[1] != manifest.test_id or _NAMES.fullmatch(found[2]) is None:
            raise refused(f"{name[:120]!r} is no file of a test", file=name[:120])
    twice = [name for name, times in Counter(members).items() if times > 1]
    if twice:
        raise refused(f"{twice[0]} is in it twice", file=twice[0])
    lacking = sorted(set(manifest.files) - set(members))
    if lacking:
        raise altered(f"{lacking[0]} is not in it", file=lacking[0])
    more = sorted(set(members) - set(manifest.files) - {MANIFEST, CRATE})
    if more:
        raise altered(f"its manifest does not list {more[0]}", file=more[0])
    if f"tests/{manifest.test_id}/test.json" not in manifest.files:
        raise altered("it has no test.json", file="test.json")


def altered(cause: str, **context: object) -> FileFormatError:
    """Return the error for a bundle that is not as it was written."""
    return FileFormatError(
        f"The bundle is not as it was written: {cause}.",
        code="bundle_altered",
        remedy="Copy it again from its origin, or make it again there; nothing was opened.",
        **context,
    )


def refused(cause: str, **context: object) -> FileFormatError:
    """Return the error for a bundle that no version of this program writes."""
    return FileFormatError(
        f"The bundle is refused: {cause}.",
        code="bundle_refused",
        remedy="'stereorig bundle' writes no such file: ask who sent it. Nothing was opened.",
        **context,
    )
