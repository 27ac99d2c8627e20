"""The real start on each state, and what must be there then."""

from __future__ import annotations

import contextlib
import copy
import os
import random
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from stereorig.server.config.rig_file import RigConfig, parse_config
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.power_loss.journal import Names
from tests.support.power_loss.recording import Answer, Recording, ThreadWorker
from tests.support.power_loss.states import PowerLoss, Tree
from tests.support.tiny_rig import TINY

DATA = "data"
#: files that a running service keeps for itself; their loss costs nothing. A start goes on with manifests and the
#: format's number; that what was acknowledged is in them is what `verify` says of the state after it
_OURS = ("service.lock", ".probe", ".exports", "manifest.json", "manifest", "format.json")
_READ_S = 60.0
CATALOGS = ("as it was", "a request older", "torn", "gone")


@dataclass(frozen=True)
class State:
    """One state of the disk.

    Parameters
    ----------
    at
        Number of changes that were made before power was lost.
    tree
        Blobs by path, None for folders.
    catalog
        One of `CATALOGS`.
    answer
        The last request that was acknowledged before.
    allowed
        For each acknowledged file, the contents it may have: the acknowledged one, and what the request under way makes
        of it to its end, which the start may bring about; None: it may be gone.
    kept
        Contents that must be somewhere.
    """

    at: int
    tree: Tree
    catalog: str
    answer: Answer
    older: Answer
    allowed: dict[str, set[str | None]]
    kept: frozenset[str]


@dataclass
class Verdict:
    """What was looked at, and what was wrong."""

    states: int = 0
    wrong: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)


def _is_data(path: str, blob: str | None) -> bool:
    names = path.split("/")
    ours = any(name in _OURS or name.endswith(".part") for name in names) or names[-1].startswith(
        ("catalog.", "audit.log")
    )
    return blob is not None and not ours


def _files(names: Names, folders: set[int]) -> dict[str, str]:
    tree = names.tree(folders)
    return {path: blob for path, blob in tree.items() if blob is not None and _is_data(path, blob)}


def crash_states(
    recording: Recording, rng: random.Random, most: int, every: int = 1, offset: int | None = None
) -> Iterator[State]:
    """Yield states in which power may be lost during a recorded day.

    Parameters
    ----------
    rng
        Draws samples and catalogues.
    most
        States of one instant, at most.
    every, offset
        Only every so many-th instant, from this one; None: from a drawn one.
    """
    journal = recording.journal
    loss, live = PowerLoss(journal.is_folder, journal.blobs), Names()
    offset = rng.randrange(every) if offset is None else offset
    ends = [answer.at for answer in recording.answers[1:]] + [len(journal.changes)]
    at = 0
    for answer, older, end in zip(recording.answers, recording.answers[:1] + recording.answers, ends, strict=False):
        while at < answer.at:  # before the first answer nothing is acknowledged
            loss.take(journal.changes[at])
            live.apply(journal.changes[at])
            at += 1
        files = _files(live, journal.is_folder)
        allowed: dict[str, set[str | None]] = {path: {blob} for path, blob in files.items()}
        kept, ahead = set(files.values()), copy.deepcopy(live)
        for change in journal.changes[at:end]:
            ahead.apply(change)
            files = _files(ahead, journal.is_folder)
            for path, contents in allowed.items():
                contents.add(files.get(path))
            kept &= set(files.values())
        while at < end or end == len(journal.changes):
            if at % every == offset:
                for tree in loss.states(rng, most):
                    catalog = rng.choices(CATALOGS, (5, 2, 1, 2))[0]
                    yield State(at, tree, catalog, answer, older, allowed, frozenset(kept))
            if at == end:
                return
            loss.take(journal.changes[at])
            live.apply(journal.changes[at])
            at += 1


class Disk:
    """States as real folders; contents are links to one copy each."""

    def __init__(self, folder: Path, blobs: dict[str, bytes]) -> None:
        self._folder, self._contents = folder, blobs
        self._blobs = folder / "blobs"
        self._blobs.mkdir(parents=True)

    def _blob(self, key: str) -> Path:
        path = self._blobs / key.replace(" ", "-")
        if not path.exists():
            path.write_bytes(self._contents[key])
        return path

    @contextlib.contextmanager
    def made(self, state: State) -> Iterator[Path]:
        """Yield the data folder of a state."""
        top = self._folder / "state"
        top.mkdir()
        try:
            for path, blob in sorted(state.tree.items()):
                if blob is None:
                    (top / path).mkdir()
                else:
                    os.link(self._blob(blob), top / path)
            self._put_catalog(top / DATA / "catalog.sqlite", state)
            yield top / DATA
        finally:
            shutil.rmtree(top)

    def _put_catalog(self, path: Path, state: State) -> None:
        if state.catalog == "gone" or not path.parent.is_dir():
            return
        content = self._contents[(state.older if state.catalog == "a request older" else state.answer).catalog]
        path.write_bytes(content[: len(content) // 2] if state.catalog == "torn" else content)


def problems_of(state: State, data: Path, config: RigConfig) -> list[str]:
    """Open a state as the service does; return what is lost, half there, or not agreed upon."""
    service = Service(config, data, worker=ThreadWorker())  # type: ignore[arg-type] - as the service uses it
    try:
        with contextlib.ExitStack() as parts:
            service.open_data(parts)
            service.index.wait(_READ_S)
            rows = service.catalog.transact(lambda c: c.execute("SELECT key FROM requests").fetchall())
            listed = {key for (key,) in rows}
    except Exception as error:  # noqa: BLE001 - any is what is looked for
        return [f"the start failed: {error!r}"]
    finally:
        service.stop_thread.shutdown(wait=False)
        service.abort_thread.shutdown(wait=False)
    found = _blobs_of(state, data)
    wrong = [
        f"{path} is {'gone' if found.get(path) is None else 'another'}"
        for path, may in state.allowed.items()
        if found.get(path) not in may
    ]
    wrong += [
        f"a content of {path} is nowhere" for path, may in state.allowed.items() if not _somewhere(may, state, found)
    ]
    known = state.answer.keys if state.catalog == "as it was" else _written_keys(state.answer.keys, data)
    wrong += [f"the request with the key {key} is forgotten" for key in sorted(known - listed)]
    wrong += [f"verify: {f.level}: {f.path}: {f.text}" for f in verify(data).findings if f.level != "incomplete"]
    return wrong


def _somewhere(may: set[str | None], state: State, found: dict[str, str]) -> bool:
    acknowledged = {blob for blob in may if blob in state.kept}
    return not acknowledged or bool(acknowledged & set(found.values()))


def _written_keys(keys: frozenset[str], data: Path) -> set[str]:
    """Return the keys that stand in documents: those of things that were deleted are lost with the catalogue."""
    names = ("*/*/plan.json", "*/*/test.json", "*/*/steps/*/step.json", "*/*/analyses/*/jobs.json")
    there = "".join(path.read_text() for name in names for path in data.glob(name) if "trash" not in path.parts)
    return {key for key in keys if key in there}


def _blobs_of(state: State, data: Path) -> dict[str, str]:
    """Return the contents by path as they are after the start, by the same keys."""
    inodes = {
        (data.parent.parent / "blobs" / blob).stat().st_ino: blob
        for blob in set(state.tree.values())
        if blob is not None
    }
    found: dict[str, str] = {}
    for folder, _, names in os.walk(data):
        for name in names:
            path = f"{folder}/{name}"
            blob = inodes.get(os.stat(path).st_ino)  # noqa: PTH116
            found[path[len(str(data.parent)) + 1 :]] = blob if blob is not None else "new"
    return found


def look_at_all(recording: Recording, folder: Path, states: Iterator[State], tell: Callable[[str], None]) -> Verdict:
    """Open every state; return what was found."""
    verdict, config = Verdict(), parse_config(TINY)
    disk = Disk(folder, recording.journal.blobs)
    for state in states:
        with disk.made(state) as data:
            wrong = problems_of(state, data, config)
        verdict.states += 1
        verdict.counts[state.catalog] += 1
        if wrong:
            after = f"after {state.at} changes, {state.catalog} catalogue, following {state.answer.what}"
            verdict.wrong += [f"{after}: {line}" for line in wrong]
            tell(verdict.wrong[-1])
    return verdict
