// Runs the built site's own search in Node: node site_search.js SITE, queries as JSON on stdin, results as JSON on stdout.
const fs = require("fs");
const path = require("path");
const vm = require("vm");

const site = process.argv[2];
const nothing = () => undefined;
const context = vm.createContext({
  console,
  localStorage: { setItem: nothing, getItem: nothing, removeItem: nothing },
  document: { documentElement: { dataset: {} }, getElementById: nothing, addEventListener: nothing, readyState: "loading" },
  addEventListener: nothing,
  location: { search: "" },
  DOMParser: class {},
  URLSearchParams,
});
context.window = context;
const statics = ["documentation_options", "language_data", "doctools", "sphinx_highlight", "searchtools"];
const files = statics.map((name) => path.join(site, "_static", `${name}.js`)).filter((file) => fs.existsSync(file));
// one script: what the files declare by const is shared, as between a page's scripts
const text = [...files, path.join(site, "searchindex.js")].map((file) => fs.readFileSync(file, "utf8")).join("\n;\n");
const ask = `
;((queries) => queries.map((query) => {
  Search._queued_query = null;
  const [, ...parsed] = Search._parseQuery(query);
  return Search._performSearch(query, ...parsed).reverse().map((one) => one[0]);
}))`;
const answer = vm.runInContext(text + ask, context);
process.stdout.write(JSON.stringify(answer(JSON.parse(fs.readFileSync(0, "utf8")))));
