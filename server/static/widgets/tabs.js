// Folded panels as tabs: one is open at a time.

/**
 * Open one of the panels, and fold the others.
 * @param {HTMLDetailsElement} panel
 * @param {boolean} [seen] bring it into view
 */
export function choose(panel, seen = false) {
  for (const one of panel.closest(".tabs")?.querySelectorAll("details.panel") ?? []) /** @type {HTMLDetailsElement} */ (one).open = one === panel;
  if (seen) panel.closest(".tabs")?.scrollIntoView({ block: "nearest" });
}

/**
 * Make tabs of the panels in an element; the open one stays open.
 * @param {HTMLElement} root
 */
export function tabs(root) {
  root.classList.add("tabs");
  root.addEventListener("click", (event) => {
    const panel = /** @type {Element} */ (event.target).closest("summary")?.parentElement;
    if (!(panel instanceof HTMLDetailsElement) || !panel.matches(".panel")) return;
    event.preventDefault();
    choose(panel);
  });
  return root;
}
