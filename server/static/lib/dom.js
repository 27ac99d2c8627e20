// Elements, numbers with units, and what the screens share of looks.

/**
 * Make an element: h("button.primary", {onclick, title}, "Text", child, ...).
 * Attributes named on... become listeners; true/false/null set or leave out an attribute.
 */
export function h(spec, ...rest) {
  const [tag, ...classes] = spec.split(".");
  const node = document.createElement(tag || "div");
  if (classes.length) node.className = classes.join(" ");
  fill(node, rest);
  return node;
}

const SVG = "http://www.w3.org/2000/svg";
export function svg(tag, ...rest) {
  const node = document.createElementNS(SVG, tag);
  fill(node, rest);
  return node;
}

function fill(node, rest) {
  for (const part of rest.flat(Infinity)) {
    if (part === null || part === undefined || part === false) continue;
    if (part instanceof Node) node.append(part);
    else if (typeof part === "object") attributes(node, part);
    else node.append(String(part));
  }
}

function attributes(node, values) {
  for (const [name, value] of Object.entries(values)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "value" || name === "checked" || name === "disabled" || name === "selected") node[name] = value;
    else if (name === "style" && typeof value === "object") Object.assign(node.style, value);
    else node.setAttribute(name, value === true ? "" : value);
  }
}

/** Put other children into a node. Where the focus was in it, it stays at what stands in the same place now. */
export function replace(node, ...children) {
  const active = document.activeElement;
  const held = active !== node && node.contains(active) ? place(node, active) : null;
  node.replaceChildren();
  fill(node, children);
  if (held && !(active.isConnected && document.activeElement === active)) refocus(node, active, held);
  return node;
}

/** What tells a control from the others of its kind, as far as it survives being drawn again. */
function sign(control) {
  const own = control.dataset.handle ?? control.getAttribute("aria-label") ?? control.getAttribute("href") ?? control.labels?.[0]?.textContent;
  return `${control.tagName} ${own ?? control.textContent}`;
}

/** A control's sign, and which of those with the same one it is. */
function place(node, control) {
  const mine = sign(control);
  return { mine, index: [...node.querySelectorAll(control.tagName)].filter((one) => sign(one) === mine).indexOf(control) };
}

function refocus(node, before, { mine, index }) {
  if (before.isConnected) return before.focus({ preventScroll: true }); // it was only moved
  const same = [...node.querySelectorAll(before.tagName)].filter((one) => sign(one) === mine && !one.disabled);
  const next = same[index] ?? same.at(-1);
  if (next) return next.focus({ preventScroll: true });
  // it is gone: the next Tab goes on from where it was
  if (!(node instanceof HTMLElement)) return node.closest("[tabindex]")?.focus({ preventScroll: true });
  if (!node.hasAttribute("tabindex")) node.tabIndex = -1;
  return node.focus({ preventScroll: true });
}

/** A number with `digits` significant digits; an unknown one is said to be unknown, never zero. */
export function num(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-4) return value.toExponential(Math.max(digits - 1, 0)).replace("e", "\u00a0e").replaceAll("-", "−");
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return value.toFixed(Math.min(decimals, 6)).replace("-", "−");
}

/** A whole number with narrow spaces, that no line breaks at, between thousands. */
export function count(value) {
  return value === null || value === undefined ? "–" : Math.round(value).toString().replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

/** A number for an axis: as short as it can be. */
export function tick(value) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  const text = size >= 1e5 || size < 1e-3 ? value.toExponential(2).replace(/\.?0+e/, "e") : String(Number(value.toPrecision(6)));
  return text.replaceAll("-", "−");
}

const UNITS = { px: "px", mm: "mm", m: "m", deg: "°", rad: "rad", ms: "ms", s: "s", hz: "Hz", n: "N", 1: "" };
export function unit(name) {
  return name === undefined || name === null ? "" : (UNITS[name] ?? name);
}

/** A number and its unit, kept on one line. */
export function quantity(value, name, digits = 4) {
  const text = num(value, digits);
  return text === "–" || !unit(name) ? text : `${text}\u00a0${unit(name)}`;
}

export function when(utc) {
  if (!utc) return "–";
  const date = new Date(utc);
  return Number.isNaN(date.valueOf()) ? utc : date.toLocaleString();
}

let fields = 0;
/** A labelled control: field("Exposure", input, "ms", "what it means"). */
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

export function number(value, attributes_ = {}) {
  return h("input", { type: "number", step: "any", value: value ?? "", ...attributes_ });
}

export function select(options, chosen, attributes_ = {}) {
  const node = h(
    "select",
    attributes_,
    options.map(([value, text]) => h("option", { value, selected: String(value) === String(chosen) }, text)),
  );
  return node;
}

/** A button that cannot be pressed again while what it began is under way. */
export function action(text, run, attributes_ = {}) {
  const { kind = "", ...others } = attributes_;
  const node = h(kind ? `button.${kind}` : "button", { type: "button", ...others }, text);
  node.addEventListener("click", async () => {
    if (node.getAttribute("aria-disabled") === "true") return;
    // `disabled` would take the focus away from who pressed it by keyboard
    node.setAttribute("aria-disabled", "true");
    node.setAttribute("aria-busy", "true");
    try {
      await run();
    } catch (error) {
      if (error.name !== "AbortError") notify(error);
    } finally {
      node.removeAttribute("aria-disabled");
      node.removeAttribute("aria-busy");
    }
  });
  return node;
}

/** A table: columns [[heading, row => cell, {numeric, unseen}]...]; an unseen heading is read out, not shown. */
export function table(columns, rows, { caption, onrow, empty = "Nothing here yet." } = {}) {
  if (!rows.length) return h("p.quiet", empty);
  return h(
    "div.scroll",
    { tabindex: 0, role: "region", "aria-label": caption ?? "Table" },
    h(
      "table",
      caption ? h("caption", caption) : null,
      h("thead", h("tr", columns.map(([name, , options]) => h("th", { scope: "col", class: options?.numeric ? "numeric" : null }, options?.unseen ? h("span.unseen", name) : name)))),
      h(
        "tbody",
        rows.map((row) =>
          h(
            onrow ? "tr.pick" : "tr",
            onrow ? { onclick: (event) => event.target.closest("button, a, input") || onrow(row) } : {},
            columns.map(([, cell, options]) => h("td", { class: options?.numeric ? "numeric" : null }, cell(row))),
          ),
        ),
      ),
    ),
  );
}

/** Facts as a definition list: [[name, value]...]; values that are not known are said to be so. */
export function facts(pairs) {
  return h("dl.facts", pairs.filter(Boolean).map(([name, value]) => [h("dt", name), h("dd", value ?? "–")]));
}

export function badge(text, kind = "") {
  return h(`span.badge${kind ? `.${kind}` : ""}`, text);
}

export const STATE_KIND = {
  succeeded: "good", complete: "good", accepted: "good", ok: "good", pass: "good", passed: "good", ready: "good",
  running: "busy", queued: "busy", cancelling: "busy", starting: "busy", unfinished: "busy",
  failed: "bad", fault: "bad", refused: "bad", interrupted: "warn", cancelled: "warn", warning: "warn",
};

/** Say something at the foot of the page; a problem shows cause and remedy as the API gave them. */
export function notify(what, kind = "") {
  const place = document.getElementById("notices");
  const problem = what instanceof Error;
  const box = h(
    `div.notice${problem ? ".bad" : kind ? `.${kind}` : ""}`,
    { role: problem ? "alert" : "status" },
    problem ? problemText(what) : h("p", what),
    h("button.plain", { type: "button", "aria-label": "Dismiss this message", onclick: () => {
      const next = box.nextElementSibling ?? box.previousElementSibling;
      box.remove();
      (next?.querySelector("button") ?? document.getElementById("main")).focus({ preventScroll: true });
    } }, "×"),
  );
  const same = [...place.children].find((node) => node.firstChild.textContent === box.firstChild.textContent);
  if (same) same.remove();
  place.append(box);
  while (place.children.length > 4) place.firstChild.remove();
  const fade = () => (box.contains(document.activeElement) ? setTimeout(fade, 2000) : box.remove());
  if (!problem) setTimeout(fade, 6000);
  return box;
}

/** Cause, remedy and code of a problem. */
export function problemText(error) {
  return h(
    "div.problem",
    h("p", h("strong", error.message || String(error))),
    error.remedy ? h("p", error.remedy) : null,
    error.code ? h("p.quiet", h("code", error.code), error.requestId ? ` · request ${error.requestId}` : "") : null,
    (error.fields ?? []).length ? h("ul", error.fields.map((text) => h("li", text))) : null,
  );
}

/** Open a dialog: Tab goes round in it, and the focus goes back to where it was once it is closed. */
export function modal(node, first) {
  const before = document.activeElement;
  node.addEventListener("keydown", (event) => {
    if (event.key !== "Tab") return;
    const stops = [...node.querySelectorAll("a[href], button, input, select, textarea, summary, [tabindex='0']")].filter((one) => !one.disabled && one.checkVisibility());
    const at = stops.indexOf(document.activeElement);
    const next = event.shiftKey ? (at <= 0 ? stops.at(-1) : null) : at === stops.length - 1 ? stops[0] : null;
    if (!next) return;
    event.preventDefault();
    next.focus();
  });
  node.addEventListener("close", () => {
    node.remove();
    if (before?.isConnected && before !== document.body) before.focus();
    else document.getElementById("main").focus();
  });
  document.body.append(node);
  node.showModal();
  first?.focus();
}

/** A dialog with a heading, a body and buttons; resolves to what was pressed. What moves can be stopped from it. */
export function ask(heading, body, buttons = [["Cancel", null], ["OK", "ok"]]) {
  return new Promise((resolve) => {
    const stop = h("button.stop", { type: "button", title: "Stop every axis at once (Esc, twice)", onclick: () => window.dispatchEvent(new Event("stopstage")) }, "STOP");
    const node = h("dialog", { "aria-label": heading }, h("div.spread", h("h2", heading), stop), body);
    const close = (value) => { node.close(); resolve(value); };
    const choices = buttons.map(([text, value], index) =>
      h(index === buttons.length - 1 ? "button.primary" : "button", { type: "button", onclick: () => close(value) }, text));
    node.append(h("div.row.end", choices));
    node.addEventListener("cancel", (event) => { event.preventDefault(); close(null); });
    modal(node, body.querySelector?.("input, select, textarea") ?? choices[0]);
  });
}
