"""Recipes on disk: region, settings, gauges and display that are kept for the next specimen, one file each."""

from __future__ import annotations

import threading
from collections.abc import Mapping

from stereorig.core.errors import InputError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.made import RecipeRecord
from stereorig.server.formats.files import fsync_path
from stereorig.server.formats.manifest import is_there
from stereorig.server.store.durable import make_folder, read_record, record_of
from stereorig.server.store.folder import DataFolder, is_id, now_utc


class RecipeStore:
    """The recipes of one data folder."""

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder
        self._root = folder.root / "recipes"
        self._lock = threading.Lock()

    def reserve_ids(self) -> None:
        """Reserve the ids that exist."""
        for recipe_id in self.ids():
            self._folder.ids.reserve(recipe_id)

    def ids(self) -> list[str]:
        """Ids of all recipes, in the order of their making."""
        return sorted(p.stem for p in self._root.glob("r*.json") if is_id(p.stem, "r"))

    def read(self, recipe_id: str) -> RecipeRecord:
        """Return a recipe with its name.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        """
        path = self._root / f"{recipe_id}.json"
        if not is_id(recipe_id, "r") or not is_there(path):
            raise NotFoundError(f"There is no recipe {recipe_id[:40]!r}.", kind="recipe")
        return read_record(RecipeRecord, path)

    def find(self, wanted: str) -> RecipeRecord:
        """Return a recipe by its id or its name; of several with one name, the newest.

        Raises
        ------
        NotFoundError
            If there is none.
        """
        if is_id(wanted, "r"):
            return self.read(wanted)
        named = [found for recipe_id in self.ids() if (found := self.read(recipe_id)).name == wanted]
        if not named:
            raise NotFoundError(f"There is no recipe of the name {wanted[:80]!r}.", kind="recipe")
        return named[-1]

    def create(self, name: str, recipe: Mapping[str, object]) -> RecipeRecord:
        """Keep a recipe; durable when this returns."""
        with self._lock:
            self._check_name(name)
            if not self._root.is_dir():
                make_folder(self._root)
            made = now_utc()
            document = {
                "id": self._folder.ids.new("r"),
                "name": name,
                "created_utc": made,
                "changed_utc": made,
                "recipe": recipe,
            }
            path = self._root / f"{document['id']}.json"
            self._folder.manifests.write_json(path, document)
        return record_of(RecipeRecord, document, path)

    def update(self, recipe_id: str, changes: Mapping[str, object]) -> RecipeRecord:
        """Change name or content of a recipe."""
        with self._lock:
            before = self.read(recipe_id)
            if changes.get("name", before.name) != before.name:
                self._check_name(str(changes["name"]))
            document = {**before.plain(), **changes, "changed_utc": now_utc()}
            path = self._root / f"{recipe_id}.json"
            self._folder.manifests.write_json(path, document)
        return record_of(RecipeRecord, document, path)

    def remove(self, recipe_id: str) -> None:
        """Remove a recipe; tests and analyses that took it stay."""
        with self._lock:
            self.read(recipe_id)
            self._folder.manifests.strike(self._root, [f"{recipe_id}.json"])
            (self._root / f"{recipe_id}.json").unlink()
            fsync_path(self._root)

    def _check_name(self, name: str) -> None:
        if any(self.read(recipe_id).name == name for recipe_id in self.ids()):
            raise InputError(
                f"There is a recipe of the name {name[:80]!r}.",
                code="recipe_name_taken",
                remedy="Give another name, or change or delete that recipe.",
            )
