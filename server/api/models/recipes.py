"""Recipes: drawing and settings of a test, as one document that any other test can take.

The same document is a test's workspace, a kept template, and the file of ``stereorig measure --recipe``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, StringConstraints, ValidationError, model_validator
from pydantic.json_schema import SkipJsonSchema

from stereorig.core import settings
from stereorig.core.errors import InputError, RegionError
from stereorig.core.settings import Whole
from stereorig.server.api.models.analyses import Region, StrainRequest
from stereorig.server.base.models import ON_ONE_LINE, Label, Listing, Number, Reply, Request, Switch
from stereorig.server.results.gauges.request import GaugeRequest
from stereorig.server.wording import problems_in

#: version of the document; a step means that earlier programs cannot read it
RECIPE_VERSION = 1
RECIPE_FORMAT: Literal["stereorig recipe"] = "stereorig recipe"
#: in place of a recipe's name: the test's own drawing and settings
WORKSPACE = "workspace"
Side = Annotated[Whole, Field(ge=1, le=65_536)]
Percent = Annotated[Number, Field(ge=0.0, le=100.0)]
RecipeName = Annotated[str, StringConstraints(min_length=1, max_length=120), ON_ONE_LINE]


class RecipeSettings(settings.AnalysisSettings):
    """Settings of an analysis, those that were chosen; the others are the defaults."""

    region: SkipJsonSchema[None] = Field(None, exclude=True)  # type: ignore[assignment]
    kind: Literal["profile", "displacement"] = Field(
        "displacement", description="Shape only, or shape and displacement."
    )
    noise_id: Annotated[str, StringConstraints(max_length=40)] | None = Field(
        None, description="Noise measurement that weighs the pixels."
    )
    strain: StrainRequest | None = Field(
        default_factory=lambda: StrainRequest.model_validate({}), description="Strain of a displacement; null: none."
    )


class Display(Request):
    """Settings of the display of fields."""

    field: Annotated[str, StringConstraints(max_length=80)] | None = Field(None, description="The field.")
    colours: Annotated[str, StringConstraints(max_length=40, pattern=r"^[a-z_]+$")] = Field(
        "auto", description="Colour map; auto: by the values' signs."
    )
    levels: Annotated[Whole, Field(ge=0, le=64)] = Field(0, description="Number of colours; 0: smooth.")
    reversed: Switch = Field(False, description="Colours the other way round.")
    over: Literal["step", "all"] = Field("step", description="Limits from each step by itself, or from all.")
    percentiles: tuple[Percent, Percent] = Field((1.0, 99.0), description="Percentiles of the values as limits.")
    limits: dict[Annotated[str, StringConstraints(max_length=80)], tuple[Number, Number]] = Field(
        default_factory=dict,
        description="Limits that were given, by field, in the unit it is shown in.",
        max_length=200,
    )


class Recipe(Request):
    """Drawing and settings: region, settings, gauges, display; each part may be left out."""

    format: Literal["stereorig recipe"] = Field(RECIPE_FORMAT, description="Kind of the document.")
    version: Annotated[Whole, Field(ge=1)] = Field(
        RECIPE_VERSION,
        description="Version of the document; a later one is refused.",
        # checked by a validator instead, whose error has a remedy
        json_schema_extra={"maximum": RECIPE_VERSION},
    )
    image_size_px: tuple[Side, Side] | None = Field(
        None,
        description="Width and height of camera 1's image that it was drawn over; applied to images of another size it "
        "is refused.",
        examples=[[2448, 2048]],
    )
    region: Region | None = Field(None, description="Region of interest, px of camera 1's reference image.")
    settings: RecipeSettings = Field(
        default_factory=lambda: RecipeSettings.model_validate({}), description="Settings of the analysis."
    )
    gauges: GaugeRequest | None = Field(None, description="Gauges; a report shows their histories.")
    display: Display | None = Field(None, description="Field, limits and colours.")
    drawing: dict[str, JsonValue] | None = Field(
        None, description="The page's own record of the drawing, unfinished shapes too; it may be left out."
    )
    note: Label = Field("", description="Free text.")

    @model_validator(mode="before")
    @classmethod
    def _known(cls, given: Any) -> Any:
        version = given.get("version") if isinstance(given, dict) else None
        if isinstance(version, int) and not isinstance(version, bool) and version > RECIPE_VERSION:
            raise ValueError(
                f"it is a recipe of version {version}, this program reads up to {RECIPE_VERSION}; use a newer one"
            )
        return given

    def document(self) -> dict[str, object]:
        """Return the stated values as plain ones; with the format and its version."""
        return {
            "format": RECIPE_FORMAT,
            "version": RECIPE_VERSION,
            **self.model_dump(mode="json", exclude_unset=True, exclude={"format", "version"}),
        }

    def analysis(self) -> dict[str, object]:
        """Return the part of an analysis request that it states."""
        stated = self.settings.model_dump(mode="json", exclude_unset=True)
        if self.region is not None:
            stated["region"] = self.region.model_dump(mode="json", exclude_none=True)
        return stated

    def check_fits(self, width: int, height: int) -> None:
        """Refuse an image that the recipe was not drawn over.

        Parameters
        ----------
        width, height
            Of camera 1's image, px.

        Raises
        ------
        RegionError
            ``recipe_other_size``, ``recipe_outside``.
        """
        drawn = self.image_size_px
        if drawn is not None and drawn != (width, height):
            raise RegionError(
                f"The recipe was drawn over an image of {drawn[0]} x {drawn[1]} px, camera 1's is {width} x {height} "
                "px.",
                code="recipe_other_size",
                remedy="Draw the region again; to take the numbers as they are, leave out image_size_px.",
            )
        for name, (x, y) in self._positions():
            if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
                raise RegionError(
                    f"The recipe's {name} has the position {x:g}, {y:g} px, outside camera 1's image of {width} x "
                    f"{height} px.",
                    code="recipe_outside",
                    remedy="Move it into the image, or take a recipe that was drawn over such images.",
                )

    def _positions(self) -> Iterator[tuple[str, tuple[float, float]]]:
        region = self.region
        if region is not None:
            if region.rectangle is not None:
                x0, y0, x1, y1 = region.rectangle
                yield from (("region", (x0, y0)), ("region", (x1, y1)))
            yield from (("region", (x, y)) for x, y in region.polygon or ())
            yield from (("crack", (x, y)) for line in region.cracks for x, y in line)
            yield from (("hole", (x, y)) for line in region.holes for x, y in line)
        yield from (("seed", (x, y)) for x, y in self.settings.seeds or ())


def recipe_in(document: object, *, name: str) -> Recipe:
    """Read a recipe.

    Raises
    ------
    InputError
        ``recipe_invalid``: one line that names the first wrong entry.
    """
    try:
        return Recipe.model_validate(document)
    except ValidationError as error:
        first = problems_in(error)[0]
        where = f"{first.field}: " if first.field else ""
        raise InputError(
            f"{name}: {where}{first.problem}.",
            code="recipe_invalid",
            remedy="Correct it; docs/reference/recipe_file.md describes the file.",
        ) from error


class Workspace(Recipe):
    """Drawing and settings of a test, stored as they are drawn."""


class RecipeRequest(Request):
    """A recipe to keep."""

    name: RecipeName = Field(description="Its name, no other recipe's.")
    recipe: Recipe = Field(description="The document.")


class RecipePatch(Request):
    """Changes of a kept recipe."""

    name: RecipeName | None = Field(None, description="Name.")
    recipe: Recipe | None = Field(None, description="The document, as a whole.")


class RecipeEntry(Reply):
    """Entry of a recipe in a list."""

    id: str = Field(description="Id.", examples=["r000001-5d0a3f"])
    name: str = Field(description="Name.")
    created_utc: str = Field(description="Time at which it was made.")
    changed_utc: str = Field(description="Time of its last change.")


class RecipeReply(RecipeEntry):
    """A kept recipe."""

    recipe: Recipe = Field(description="The document.")


class RecipeList(Listing):
    """Recipes, oldest first."""

    recipes: list[RecipeEntry] = Field(description="Short entry of each.")
