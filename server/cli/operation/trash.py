"""``stereorig trash``: list deleted data, restore them, remove them for good."""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.documents.made import TrashEntry
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.indexing.build import reindex
from stereorig.server.store.trash import Trash
from stereorig.server.store.verify import require_data_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Deleting moves things into the trash of the data folder. 'list' shows them, 'restore ID ...' moves them back "
        "(with no service running; a running one does it by POST /trash/ID:restore), 'empty' removes them for good: "
        "all, or those that were deleted more than --older-than days ago, or those that are named."
    )
    parser.add_argument("action", choices=["list", "restore", "empty"])
    parser.add_argument("ids", nargs="*", metavar="ID", help="as 'list' shows them")
    parser.add_argument("--older-than", type=float, metavar="DAYS", help="empty: only entries deleted before that")
    parser.add_argument("--data", type=Path, default=Path("data"), help="data folder (default: ./data)")
    parser.add_argument("--json", action="store_true", help="list: print JSON")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    require_data_folder(args.data)
    if args.older_than is not None and (args.action != "empty" or args.ids or not args.older_than >= 0.0):
        raise InputError(
            "--older-than goes with 'empty' alone, and is 0 or more.", remedy="See stereorig trash --help."
        )
    if args.action == "list" and args.ids:
        raise InputError("'trash list' takes no ID.", remedy="See stereorig trash --help.")
    if args.action == "restore":
        return _restore(args.data, args.ids)
    trash = Trash(args.data.absolute())
    if args.action == "empty":
        return _empty(trash, args.ids, args.older_than)
    entries = trash.entries()
    if args.json:
        print(json.dumps([entry.plain() for entry in entries], indent=1, ensure_ascii=False))
    else:
        print("\n".join([_line(entry) for entry in entries] or ["the trash is empty"]))
    return 0


def _restore(data: Path, ids: list[str]) -> int:
    if not ids:
        raise InputError("'trash restore' needs an ID.", remedy="See stereorig trash list.")
    folder = DataFolder(data).open()
    try:
        trash = Trash(folder.root)
        for trash_id in ids:
            print(f"restored {_description(trash.restore(trash_id))}")
        reindex(folder, believe=True)
    finally:
        folder.close()
    return 0


def _empty(trash: Trash, ids: list[str], older_than: float | None) -> int:
    for trash_id in ids:
        trash.entry(trash_id)  # nothing is removed if one of them is not there
    entries = [entry for entry in trash.entries() if not ids or entry.id in ids]
    if older_than is not None:
        before = datetime.now(UTC) - timedelta(days=older_than)
        entries = [entry for entry in entries if _deleted_before(entry, before)]
    for entry in entries:
        trash.remove(entry.id)
        print(f"removed {_line(entry)}")
    print(f"{sum(entry.size_bytes or 0 for entry in entries) / 2**20:.1f} MiB freed")
    return 0


def _deleted_before(entry: TrashEntry, moment: datetime) -> bool:
    try:
        return datetime.fromisoformat(entry.deleted_utc or "") < moment
    except ValueError:
        return False  # when is not known


def _description(entry: TrashEntry) -> str:
    ids = filter(None, (entry.test_id, entry.analysis_id, entry.calibration_id, entry.noise_id))
    number = f" step {entry.n}" if entry.n is not None else ""
    return f"{entry.kind} {' '.join(ids)}{number}"


def _line(entry: TrashEntry) -> str:
    size_mib = (entry.size_bytes or 0) / 2**20
    when = f"deleted {entry.deleted_utc} by {entry.deleted_by} ({entry.why})"
    return f"{entry.id}  {_description(entry)}  {size_mib:.1f} MiB  {when}  {entry.name}".rstrip()
