// Folded panels as tabs: one is open at a time.

/**
 * Open one of the panels, and fold the others.
 * @param {HTMLDetailsElement} panel
 * @returns {HTMLElement} its name
 */
export function choose(panel) {
  for (const one of panel.closest(".tabs")?.querySelectorAll("details.panel") ?? []) /** @type {HTMLDetailsElement} */ (one).open = one === panel;
  return /** @type {HTMLElement} */ (panel.firstElementChild);
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
