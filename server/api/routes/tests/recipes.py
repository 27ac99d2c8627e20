"""Recipes: kept for the next specimen."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Response

from stereorig.core.errors import StereorigError
from stereorig.server.api.models.recipes import Recipe, RecipeList, RecipePatch, RecipeReply, RecipeRequest
from stereorig.server.api.protocol.delivery import IfMatch, etag_of, require_match, tagged
from stereorig.server.api.protocol.dependencies import KeyHeader, ServiceDep, mark
from stereorig.server.api.protocol.paging import PageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Ids
from stereorig.server.formats.images import read_image
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/recipes", tags=["tests"])
RecipeId = Annotated[str, Path(max_length=40, description="Id of a recipe.")]


def reference_size_px(service: Service, test_id: str, n: int = 0) -> tuple[int, int] | None:
    """Return width and height of camera 1's image of a step; None if it cannot be read."""
    try:
        step = service.tests.steps.read(test_id, n)
        known = step.document.image_size_px.get("cam1")
        if known is None:
            rows, cols = read_image(step.cam1).shape
            return cols, rows
        return known
    except StereorigError:
        return None


def check_against_test(service: Service, test_id: str, recipe: Recipe) -> None:
    """Refuse a recipe that was drawn over other images than a test's; see :meth:`Recipe.check_fits`."""
    numbers = service.tests.steps.numbers(test_id)
    size = reference_size_px(service, test_id, numbers[0]) if numbers else None
    if size is not None:
        recipe.check_fits(*size)


def _reply(service: Service, recipe_id: str) -> dict[str, object]:
    return service.recipes.read(recipe_id).plain()


@router.post("", summary="Keep a recipe", status_code=201, responses=errors(409, 422, 507))
def create_recipe(service: ServiceDep, body: RecipeRequest, key: KeyHeader = None) -> RecipeReply:
    """Keep region, settings, gauges and display under a name, for tests to come."""
    request = mark("recipes", key, body)

    def make() -> Ids:
        service.require_room()
        return {"recipe_id": service.recipes.create(body.name, body.recipe.document()).id}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return RecipeReply.model_validate(_reply(service, str(made["recipe_id"])))


@router.get("", summary="Recipes, oldest first", responses=errors(422))
def list_recipes(service: ServiceDep, page: PageDep) -> RecipeList:
    """Return a page of the recipes."""
    found = [service.recipes.read(recipe_id).plain() for recipe_id in service.recipes.ids()]
    entries = page.of(found, lambda one: str(one["id"]))
    shown = [{k: v for k, v in one.items() if k != "recipe"} for one in entries]
    return RecipeList.model_validate({"recipes": shown, "next_cursor": page.next_cursor})


@router.get("/{recipe_id:plain_id}", summary="One recipe", response_model_exclude_unset=True, responses=errors(404))
def get_recipe(service: ServiceDep, recipe_id: RecipeId, response: Response) -> RecipeReply:
    """Return a recipe; the header ETag names this state of it."""
    return RecipeReply.model_validate(tagged(response, _reply(service, recipe_id)))


@router.patch(
    "/{recipe_id:plain_id}",
    summary="Rename a recipe, or replace its content",
    response_model_exclude_unset=True,
    responses=errors(404, 412, 422, 428, 507),
)
def patch_recipe(
    service: ServiceDep, recipe_id: RecipeId, body: RecipePatch, response: Response, if_match: IfMatch = None
) -> RecipeReply:
    """Change the given parts; If-Match names the state that was meant. Tests that took the recipe stay as they are."""
    changes: dict[str, object] = {} if body.name is None else {"name": body.name}
    if body.recipe is not None:
        changes["recipe"] = body.recipe.document()
    with service.changes:
        require_match(if_match, etag_of(_reply(service, recipe_id)), f"recipe {recipe_id}")
        service.recipes.update(recipe_id, changes)
        return RecipeReply.model_validate(tagged(response, _reply(service, recipe_id)))


@router.delete("/{recipe_id:plain_id}", summary="Delete a recipe", status_code=204, responses=errors(404, 507))
def delete_recipe(service: ServiceDep, recipe_id: RecipeId) -> None:
    """Delete a recipe; tests and analyses that took it stay as they are."""
    service.recipes.remove(recipe_id)
