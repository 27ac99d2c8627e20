// Region and settings taken from another test, an analysis or a recipe, and kept as a recipe for the next specimen.
import * as api from "../../lib/api.js";
import { h, replace, action, confirmed, field, table, when, notify, problemText } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"Recipe">} Recipe */
/** @typedef {{ id: string, name: string }} Named */

const problem = (/** @type {string} */ detail, /** @type {string} */ remedy) => api.problemOf({ detail, remedy });

/**
 * @param {string} id of the test
 * @param {{ take: (recipe: Recipe) => unknown, now: () => Recipe }} panel
 */
export async function recipesBar(id, { take, now }) {
  const origin = h("select", { "aria-label": "Take region and settings from" });
  const which = h("select", { "aria-label": "Choice of its region", hidden: true });
  const said = h("p.quiet", { role: "status", "data-role": "taken" });
  const kept = h("div");
  const name = h("input", { type: "text", maxlength: 120 });
  /** @type {Named[]} */
  let recipes = [];

  async function list() {
    const [found, { tests }] = await Promise.all([api.get("/recipes"), api.get("/tests")]);
    recipes = found.recipes;
    replace(
      origin,
      h("option", { value: "" }, "choose …"),
      recipes.length
        ? h(
            "optgroup",
            { label: "Recipes" },
            recipes.map((one) => h("option", { value: `recipe ${one.id}` }, one.name)),
          )
        : null,
      h(
        "optgroup",
        { label: "Tests" },
        h("option", { value: `test ${id}` }, "this test"),
        tests
          .filter((one) => one.id !== id)
          .toReversed()
          .map((one) => h("option", { value: `test ${one.id}` }, one.name)),
      ),
    );
    which.hidden = true;
    replace(kept, keptTable(found.recipes.toReversed(), { take: (one) => takeFrom(`recipe ${one.id}`), now, list }));
  }

  /** @param {string} choice */
  async function takeFrom(choice) {
    said.className = "quiet";
    try {
      const [kind, of, analysis] = choice.split(" ");
      if (kind === "recipe") take((await api.get(`/recipes/${of}`)).recipe);
      else if (analysis) take(await api.get(`/tests/${of}/analyses/${analysis}/recipe`));
      else take(/** @type {Recipe} */ (await api.get(`/tests/${of}/workspace`)));
      said.textContent = "Taken: region, settings, gauges and display.";
    } catch (error) {
      replace(said, problemText(error));
    }
  }

  origin.addEventListener("change", async () => {
    const [kind, of] = origin.value.split(" ");
    which.hidden = true;
    if (kind !== "test") return;
    try {
      const { analyses = [] } = await api.get(`/tests/${of}`);
      if (!origin.value.endsWith(of)) return;
      replace(
        which,
        of === id ? null : h("option", { value: "" }, "as it is drawn"),
        analyses.toReversed().map((one) => h("option", { value: one.id }, `analysis ${one.label || one.id}, ${when(one.created_utc)}`)),
      );
      which.hidden = !which.options.length;
    } catch (error) {
      notify(error);
    }
  });
  const taking = action("Take", async () => {
    if (!origin.value) throw problem("Nothing is chosen to take from.", "Choose a recipe, or a test with a region.");
    if (origin.value === `test ${id}` && !which.value) throw problem("This test has no analysis yet.", "Choose a recipe or another test.");
    await takeFrom([origin.value, ...(which.hidden || !which.value ? [] : [which.value])].join(" "));
  });
  const keep = action("Keep as a recipe", async () => {
    const wanted = name.value.trim();
    name.setCustomValidity(
      !wanted
        ? "Give the recipe a name."
        : recipes.some((one) => one.name === wanted)
          ? "There is a recipe of this name: give another name, or replace the recipe in the list."
          : "",
    );
    if (!name.reportValidity()) return;
    await api.post("/recipes", { name: wanted, recipe: now() });
    name.value = "";
    notify(`The recipe “${wanted}” is kept.`, "good");
    await list();
  });
  name.addEventListener("input", () => name.setCustomValidity(""));
  await list();
  return h(
    "details",
    { "data-role": "recipes" },
    h("summary", "Recipes: kept for the next specimen"),
    h("div.row", h("span", "Take region and settings from"), origin, which, taking),
    said,
    h("div.row", field("Name", name), keep),
    kept,
    field("Add a recipe's file", fileInput(list)),
  );
}

/**
 * The kept recipes with their actions.
 * @param {Model<"RecipeEntry">[]} recipes
 * @param {{ take: (one: Named) => unknown, now: () => Recipe, list: () => Promise<void> }} to
 */
function keptTable(recipes, { take, now, list }) {
  const actions = (/** @type {Named} */ one) =>
    h(
      "div.row",
      action("Take", () => take(one)),
      action("Replace", async () => {
        await change(one, { recipe: now() });
        await list();
        notify(`The recipe “${one.name}” is the present drawing.`, "good");
      }),
      action("Rename", async () => (await rename(one)) && list()),
      action("Download", () => download(one)),
      action("Delete", async () => (await remove(one)) && list(), { kind: "danger" }),
    );
  return table(
    [
      ["Recipe", (one) => one.name],
      ["Changed", (one) => when(one.changed_utc)],
      ["Actions", actions],
    ],
    recipes,
    {
      caption: "Kept recipes",
      empty: "No recipe is kept yet.",
    },
  );
}

/** Adds a recipe of a file. @param {() => Promise<void>} list */
function fileInput(list) {
  const file = h("input", { type: "file", accept: ".json,application/json" });
  file.addEventListener("change", async () => {
    const [chosen] = file.files ?? [];
    if (!chosen) return;
    try {
      const read = await chosen
        .text()
        .then(JSON.parse)
        .catch(() => {
          throw problem(`${chosen.name} is no JSON.`, "Choose a recipe's file.");
        });
      await api.post("/recipes", { name: chosen.name.replace(/\.json$/i, ""), recipe: read });
      await list();
    } catch (error) {
      notify(error);
    }
    file.value = "";
  });
  return file;
}

/**
 * @param {Named} one
 * @param {Model<"RecipePatch">} changes
 */
async function change({ id }, changes) {
  const { etag } = await api.getTagged(`/recipes/${id}`);
  await api.patch(`/recipes/${id}`, changes, etag === null ? {} : { "If-Match": etag });
}
/** Ask for another name; true if it was given one. @param {Named} one */
async function rename(one) {
  const input = h("input", { type: "text", maxlength: 120, value: one.name });
  const answer = await confirmed("Rename the recipe", field("Name", input), "Rename");
  const name = input.value.trim();
  if (!answer || !name) return false;
  await change(one, { name });
  return true;
}

/** Ask, and remove it; true if it was removed. @param {Named} one */
async function remove(one) {
  if (!(await confirmed(`Delete the recipe “${one.name}”?`, h("p", "Tests and analyses that took it stay as they are."), "Delete"))) return false;
  await api.remove(`/recipes/${one.id}`);
  return true;
}

/** @param {Named} one */
async function download(one) {
  const { recipe } = await api.get(`/recipes/${one.id}`);
  const url = URL.createObjectURL(new Blob([`${JSON.stringify(recipe, null, 1)}\n`], { type: "application/json" }));
  h("a", { href: url, download: `${one.name.replace(/[^\w.-]+/g, "_")}.json` }).click();
  URL.revokeObjectURL(url);
}
