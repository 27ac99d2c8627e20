"""``stereorig measure --recipe FILE``: region and settings of a recipe, where the command line gives none."""

from __future__ import annotations

import argparse
import base64
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stereorig.core.errors import InputError
from stereorig.core.field.region.lay_points import outlines_of
from stereorig.core.settings import Outline
from stereorig.server.formats.files import make_folder, write_bytes

if TYPE_CHECKING:
    from stereorig.server.api.models.recipes import Recipe

#: options whose value is text or a number, by the setting's name
_PLAIN = {
    "subset": "subset_px",
    "step": "spacing_px",
    "patch": "patch",
    "interpolation": "interpolation",
    "prefilter": "prefilter_px",
    "max_sigma": "max_sigma_px",
    "reference_update": "reference_update",
    "smooth": "smoothing_window",
    "dense": "dense_step_px",
}
MASK_FILE = "recipe_mask.png"
"""The recipe's mask, in the output folder."""


def load_recipe(path: Path) -> Recipe:
    """Read a recipe's file.

    Raises
    ------
    InputError
        ``recipe_invalid``; ``file_missing`` if there is none.
    """
    from stereorig.server.api.models.recipes import (
        recipe_in,  # with all that travels: a third of a start, and seldom needed
    )

    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.", code="file_missing", remedy="Check the path.") from error
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} cannot be read as JSON: {error}.",
            code="recipe_invalid",
            remedy="Give a recipe's file: the page's Test screen writes one.",
        ) from error
    if isinstance(document, dict) and "recipe" in document and "region" not in document:
        document = document["recipe"]  # as GET /recipes/{id} answers
    return recipe_in(document, name=str(path))


def with_recipe(args: argparse.Namespace) -> tuple[argparse.Namespace, Recipe | None]:
    """Return the arguments, with the recipe's values where the command line has none; and the recipe."""
    if args.recipe is None:
        return args, None
    recipe = load_recipe(Path(args.recipe))
    filled = argparse.Namespace(**vars(args))
    stated = recipe.settings.model_dump(mode="json", exclude_unset=True)
    for option, name in _PLAIN.items():
        if getattr(args, option) is None and stated.get(name) is not None:
            setattr(filled, option, str(stated[name]) if option != "max_sigma" else float(stated[name]))
    filled.keep_rejected = args.keep_rejected or bool(stated.get("keep_rejected"))
    filled.projected = args.projected or stated.get("pattern") == "projected"
    if args.strain is None and "strain" in stated:
        strain = stated["strain"]
        filled.strain = "off" if strain is None else None if "window" not in strain else str(strain["window"])
        for option, name in (("strain_order", "order"), ("strain_tensor", "tensor")):
            if getattr(args, option) is None and strain is not None and name in strain:
                setattr(filled, option, str(strain[name]))
    if not args.seed:
        two = recipe.settings.seeds_cam2 or [None] * len(recipe.settings.seeds or ())
        pairs = zip(recipe.settings.seeds or (), two, strict=True)
        filled.seed = [_text((*one, *(other or ()))) for one, other in pairs]
    region = recipe.region
    if region is not None:
        filled.crack = args.crack or [_text(v for point in line for v in point) for line in region.cracks]
        filled.hole = args.hole or [_text(v for point in line for v in point) for line in region.holes]
        if args.roi is None and args.mask is None:
            filled.roi = [_outline_text(one) for one in outlines_of(region)] or None
    return filled, recipe


def mask_of(recipe: Recipe | None, args: argparse.Namespace, out: Path) -> Path | None:
    """Write the recipe's mask into the output folder, where the command line gives no region; return its path."""
    if recipe is None or recipe.region is None or recipe.region.mask_png_base64 is None:
        return None
    if args.mask is not None or args.roi == ["auto"]:
        return None
    make_folder(out)
    write_bytes(out / MASK_FILE, base64.b64decode(recipe.region.mask_png_base64))
    return out / MASK_FILE


def notes_on(recipe: Recipe | None) -> Sequence[str]:
    """Return notes on a recipe's requests that the command line does not have."""
    notes = []
    if recipe is not None and recipe.settings.kind == "profile" and recipe.settings.pattern == "surface":
        notes.append("the recipe asks for shapes alone; displacement is measured too")
    if recipe is not None and recipe.settings.noise_id is not None:
        notes.append(f"the recipe's noise measurement {recipe.settings.noise_id} is a service's; give --noise FILE")
    return notes


def _outline_text(one: Outline) -> str:
    """Return an outline as ``--roi`` takes it."""
    if one.rectangle is not None:
        return _text(one.rectangle)
    if one.polygon is not None:
        return "polygon:" + _text(v for corner in one.polygon for v in corner)
    return "circle:" + _text(one.circle or ())


def _text(values: Iterable[float]) -> str:
    return ",".join(f"{float(v):.12g}" for v in values)
