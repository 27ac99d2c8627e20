// Elements, numbers with units, and the style that all screens share.
/** @import { Attributes, Column, Control, Drawn, Made, Part } from "#dom" */

/**
 * Make an element: h("button.primary", {onclick, title}, "Text", child, ...).
 * Attributes named on... become listeners; true/false/null set or leave out an attribute.
 * @template {string} Spec
 * @param {Spec} spec tag and classes
 * @param {Part[]} rest
 * @returns {Made<Spec>}
 */
export function h(spec, ...rest) {
  const [tag, ...classes] = spec.split(".");
  const node = document.createElement(tag);
  if (classes.length) node.className = classes.join(" ");
  fill(node, rest);
  return /** @type {Made<Spec>} */ (node);
}

/**
 * The same for drawings.
 * @template {keyof SVGElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Part[]} rest
 */
export function svg(tag, ...rest) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  fill(node, rest);
  return node;
}

/**
 * @param {Drawn} node
 * @param {readonly Part[]} parts
 */
function fill(node, parts) {
  for (const part of parts) {
    if (part === null || part === undefined || part === false) continue;
    if (Array.isArray(part)) fill(node, part);
    else if (part instanceof Node) node.append(part);
    else if (typeof part === "object") attributes(node, /** @type {Attributes} */ (part));
    else node.append(String(part));
  }
}

/**
 * @param {Drawn} node
 * @param {Attributes} values
 */
function attributes(node, values) {
  for (const [name, value] of Object.entries(values)) {
    if (value === null || value === undefined || value === false) continue;
    if (typeof value === "function") node.addEventListener(name.slice(2), /** @type {EventListener} */ (value));
    else if (name === "value" || name === "checked" || name === "disabled" || name === "selected") Object.assign(node, { [name]: value });
    else if (typeof value === "object") Object.assign(node.style, value);
    else node.setAttribute(name, value === true ? "" : String(value));
  }
}

/**
 * The drawing context of a canvas.
 * @param {HTMLCanvasElement} canvas
 */
export function pen(canvas) {
  const context = canvas.getContext("2d");
  if (!context) throw new Error("This browser cannot draw in a canvas.");
  return context;
}

/**
 * Put other children into a node. A focus inside it moves to the corresponding new control.
 * @param {Drawn} node
 * @param {Part[]} children
 */
export function replace(node, ...children) {
  const active = /** @type {Control | null} */ (document.activeElement);
  const held = active && active !== node && node.contains(active) ? slotOf(node, active) : null;
  node.replaceChildren();
  fill(node, children);
  if (held && !(held.control.isConnected && document.activeElement === held.control)) refocus(node, held);
  return node;
}

/**
 * Text that distinguishes a control from others of its kind, and that is the same when it is drawn again.
 * @param {Control} control
 */
function sign(control) {
  const own = control.dataset.handle ?? control.getAttribute("aria-label") ?? control.getAttribute("href") ?? control.labels?.[0]?.textContent;
  return `${control.tagName} ${own ?? control.textContent}`;
}

/**
 * @param {Drawn} node
 * @param {Control} control
 * @returns {Control[]} the controls of its kind with the same sign
 */
function alike(node, control, mine = sign(control)) {
  return [.../** @type {NodeListOf<Control>} */ (node.querySelectorAll(control.tagName))].filter((one) => sign(one) === mine);
}

/**
 * A control's sign, and which of those with the same one it is.
 * @param {Drawn} node
 * @param {Control} control
 */
const slotOf = (node, control) => ({ control, mine: sign(control), index: alike(node, control).indexOf(control) });

/**
 * @param {Drawn} node
 * @param {ReturnType<typeof slotOf>} held
 */
function refocus(node, { control: before, mine, index }) {
  if (before.isConnected) return before.focus({ preventScroll: true }); // it was only moved
  const same = alike(node, before, mine).filter((one) => !one.disabled);
  const next = same[index] ?? same.at(-1);
  if (next) return next.focus({ preventScroll: true });
  // it is gone: the next Tab continues from its place
  if (!(node instanceof HTMLElement)) return /** @type {HTMLElement | null} */ (node.closest("[tabindex]"))?.focus({ preventScroll: true });
  if (!node.hasAttribute("tabindex")) node.tabIndex = -1;
  return node.focus({ preventScroll: true });
}

/**
 * A number with `digits` significant digits; an unknown one is a dash, never zero.
 * @param {number | null | undefined} value
 */
export function num(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-4)
    return value
      .toExponential(Math.max(digits - 1, 0))
      .replace("e", "\u00a0e")
      .replaceAll("-", "−");
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return apart(value.toFixed(Math.min(decimals, 6)).replace("-", "−"));
}

/** A number with narrow spaces between thousands, from five digits before the point on. @param {string} text */
export const apart = (text) => text.replace(/^\D?\d{5,}/, (whole) => whole.replace(/\B(?=(\d{3})+$)/g, "\u202f"));

/**
 * A whole number with narrow spaces, that no line breaks at, between thousands.
 * @param {number | null | undefined} value
 */
export function count(value) {
  return value === null || value === undefined
    ? "–"
    : Math.round(value)
        .toString()
        .replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

/**
 * A number for an axis: as short as it can be.
 * @param {number} value
 */
export function tick(value) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  const text = size >= 1e6 || size < 1e-3 ? value.toExponential(2).replace(/\.?0+e/, "e") : String(Number(value.toPrecision(6)));
  return text.replaceAll("-", "−");
}

/**
 * A number and its unit, kept on one line.
 * @param {number | null | undefined} value
 * @param {string} unit
 */
export function quantity(value, unit, digits = 4) {
  const text = num(value, digits);
  return text === "–" || !unit ? text : `${text}\u00a0${unit}`;
}

/** @param {string | null | undefined} utc */
export function when(utc, options = /** @type {Intl.DateTimeFormatOptions | undefined} */ (undefined)) {
  if (!utc) return "–";
  const date = new Date(utc);
  return Number.isNaN(date.valueOf()) ? utc : date.toLocaleString(undefined, options);
}

let fields = 0;
/**
 * A labelled control: field("Exposure", input, "ms", "a hint").
 * @param {string} label
 * @param {HTMLElement} control
 */
export function field(label, control, unitName = "", hint = "") {
  fields += 1;
  control.id ||= `field${fields}`;
  const parts = [h("label", { for: control.id }, label), h("span.control", control, unitName ? h("span.unit", unitName) : null)];
  if (hint) {
    const text = h("small.hint", { id: `${control.id}-hint` }, hint);
    control.setAttribute("aria-describedby", text.id);
    parts.push(text);
  }
  return h("div.field", parts);
}

/**
 * @param {number | null | undefined} value
 * @param {Attributes} [attributes_]
 */
export function number(value, attributes_ = {}) {
  return h("input", { type: "number", step: "any", value: value ?? "", ...attributes_ });
}

/**
 * @param {readonly (readonly (string | number)[])[]} options value and text of each
 * @param {unknown} chosen
 * @param {Attributes} [attributes_]
 */
export function select(options, chosen, attributes_ = {}) {
  return h(
    "select",
    attributes_,
    options.map(([value, text]) => h("option", { value, selected: String(value) === String(chosen) }, text)),
  );
}

/**
 * A button that cannot be pressed again while its action is running.
 * @param {string} text
 * @param {() => unknown} run
 * @param {Attributes & { kind?: string }} [attributes_]
 */
export function action(text, run, attributes_ = {}) {
  const { kind = "", ...others } = attributes_;
  const node = h(kind ? `button.${kind}` : "button", { type: "button", ...others }, text);
  node.addEventListener("click", async () => {
    if (node.getAttribute("aria-disabled") === "true") return;
    // `disabled` would take the focus away from an operator at the keyboard
    node.setAttribute("aria-disabled", "true");
    node.setAttribute("aria-busy", "true");
    try {
      await run();
    } catch (error) {
      if (!(error instanceof Error && error.name === "AbortError")) notify(error);
    } finally {
      node.removeAttribute("aria-disabled");
      node.removeAttribute("aria-busy");
    }
  });
  return node;
}

/**
 * A column of numbers.
 * @template Row
 * @param {string} heading
 * @param {(row: Row) => Part} cell
 * @returns {Column<Row>}
 */
export const numeric = (heading, cell) => [heading, cell, { numeric: true }];

/**
 * A table of columns [heading, row => cell, {numeric, unseen}]; an unseen heading is read out, not shown.
 * @template Row
 * @param {readonly Column<Row>[]} columns
 * @param {readonly Row[]} rows
 * @param {{ caption?: string, onrow?: (row: Row) => unknown, empty?: string }} [options]
 */
export function table(columns, rows, { caption, onrow, empty = "No entries yet." } = {}) {
  if (!rows.length) return h("p.quiet", empty);
  return h(
    "div.scroll",
    { tabindex: 0, role: "region", "aria-label": caption ?? "Table" },
    h(
      "table",
      caption ? h("caption", caption) : null,
      h(
        "thead",
        h(
          "tr",
          columns.map(([name, , options]) =>
            h("th", { scope: "col", class: options?.numeric ? "numeric" : null }, options?.unseen ? h("span.unseen", name) : name),
          ),
        ),
      ),
      h(
        "tbody",
        rows.map((row) =>
          h(
            onrow ? "tr.pick" : "tr",
            onrow ? { onclick: (/** @type {MouseEvent} */ event) => /** @type {Element} */ (event.target).closest("button, a, input") || onrow(row) } : {},
            columns.map(([, cell, options]) => h("td", { class: options?.numeric ? "numeric" : null }, cell(row))),
          ),
        ),
      ),
    ),
  );
}

/**
 * Names and values as a definition list; an unknown value is a dash.
 * @param {readonly (readonly [string, Part])[]} pairs name and value of each
 */
export function definitions(pairs) {
  return h(
    "dl.definitions",
    pairs.map(([name, value]) => [h("dt", name), h("dd", value ?? "–")]),
  );
}

/**
 * Put other names and values into a definition list.
 * @param {HTMLElement} list
 * @param {readonly (readonly [string, Part])[]} pairs
 */
export const describe = (list, pairs) => replace(list, [...definitions(pairs).children]);

/** @param {string | undefined} text */
export function badge(text, kind = "") {
  return h(`span.badge${kind ? `.${kind}` : ""}`, text);
}

/** @type {Record<string, string>} */
export const STATE_KIND = {
  succeeded: "good",
  complete: "good",
  accepted: "good",
  ok: "good",
  pass: "good",
  passed: "good",
  ready: "good",
  running: "busy",
  queued: "busy",
  cancelling: "busy",
  starting: "busy",
  unfinished: "busy",
  failed: "bad",
  fault: "bad",
  refused: "bad",
  interrupted: "warn",
  cancelled: "warn",
  warning: "warn",
};

/**
 * A part of the page that index.html has.
 * @param {string} id
 */
export function part(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`The page has no #${id}.`);
  return found;
}

/**
 * Show a message at the foot of the page; a problem shows cause and remedy as the API gave them.
 * @param {unknown} what an error, or a text
 */
export function notify(what, kind = "") {
  const notices = part("notices");
  const problem = what instanceof Error;
  const dismiss = () => {
    const next = box.nextElementSibling ?? box.previousElementSibling;
    box.remove();
    (next?.querySelector("button") ?? part("main")).focus({ preventScroll: true });
  };
  const box = h(
    `div.notice${problem ? ".bad" : kind ? `.${kind}` : ""}`,
    { role: problem ? "alert" : "status" },
    problem ? problemText(what) : h("p", String(what)),
    h("button.plain", { type: "button", "aria-label": "Dismiss this message", onclick: dismiss }, "×"),
  );
  const same = [...notices.children].find((node) => node.firstChild?.textContent === box.firstChild?.textContent);
  if (same) same.remove();
  notices.append(box);
  while (notices.children.length > 4) notices.firstElementChild?.remove();
  /** @returns {unknown} */
  const fade = () => (box.contains(document.activeElement) ? setTimeout(fade, 2000) : box.remove());
  setTimeout(fade, problem ? 30_000 : 6000); // an error is read for longer, but does not cover the page for ever
  return box;
}

/**
 * Cause, remedy and code of a problem.
 * @param {unknown} problem
 */
export function problemText(problem) {
  const error = /** @type {Partial<import("./api.js").Problem>} */ (problem ?? {});
  return h(
    "div.problem",
    h("p", h("strong", error.message || String(problem))),
    error.remedy ? h("p", error.remedy) : null,
    error.code ? h("p.quiet", h("code", error.code), error.requestId ? ` · request ${error.requestId}` : "") : null,
    error.fields?.length
      ? h(
          "ul",
          error.fields.map((text) => h("li", text)),
        )
      : null,
  );
}

/**
 * Open a dialog: Tab goes round in it, and the focus returns to its place once it is closed.
 * @param {HTMLDialogElement} node
 * @param {HTMLElement} [first] control that has the focus first
 */
export function modal(node, first) {
  const before = /** @type {HTMLElement | null} */ (document.activeElement);
  node.addEventListener("keydown", (event) => {
    if (event.key !== "Tab") return;
    const stops = [.../** @type {NodeListOf<Control>} */ (node.querySelectorAll("a[href], button, input, select, textarea, summary, [tabindex='0']"))].filter(
      (one) => !one.disabled && one.checkVisibility(),
    );
    const at = stops.indexOf(/** @type {Control} */ (document.activeElement));
    const next = event.shiftKey ? (at <= 0 ? stops.at(-1) : null) : at === stops.length - 1 ? stops[0] : null;
    if (!next) return;
    event.preventDefault();
    next.focus();
  });
  node.addEventListener("close", () => {
    node.remove();
    if (before?.isConnected && before !== document.body) before.focus();
    else part("main").focus();
  });
  document.body.append(node);
  node.showModal();
  first?.focus();
}

/**
 * A dialog with a heading, a body and buttons; resolves to the meaning of the pressed one. It has a stop button of its own.
 * @param {string} heading
 * @param {HTMLElement} body
 * @param {(readonly [string, string | null])[]} buttons text and meaning of each; the last one is the first choice
 * @returns {Promise<string | null>}
 */
export function ask(heading, body, buttons) {
  return new Promise((resolve) => {
    const stop = h(
      "button.stop",
      { type: "button", title: "Stop every axis at once (Esc, twice)", onclick: () => window.dispatchEvent(new Event("stopstage")) },
      "STOP",
    );
    const node = h("dialog", { "aria-label": heading }, h("div.spread", h("h2", heading), stop), body);
    const close = (/** @type {string | null} */ value) => {
      node.close();
      resolve(value);
    };
    const choices = buttons.map(([text, value], index) =>
      h(index === buttons.length - 1 ? "button.primary" : "button", { type: "button", onclick: () => close(value) }, text),
    );
    node.append(h("div.row.end", choices));
    node.addEventListener("cancel", (event) => {
      event.preventDefault();
      close(null);
    });
    modal(node, /** @type {HTMLElement | null} */ (body.querySelector("input, select, textarea")) ?? choices[0]);
  });
}

/**
 * Ask before something is done; true if it was confirmed.
 * @param {string} heading
 * @param {HTMLElement} body
 * @param {string} verb on the button
 */
export async function confirmed(heading, body, verb) {
  const no = /** @type {const} */ (["Cancel", null]);
  return (await ask(heading, body, [no, [verb, "yes"]])) !== null;
}
