// One stream of events for the whole page; the browser resumes it with Last-Event-ID by itself.
import { BASE } from "./api.js";
/** @import { Events } from "#routes" */

const NAMES = ["job", "step", "result", "step_failed", "stage", "camera", "scene", "test", "calibration", "noise"];
/** @type {Map<string, Set<(data: any) => void>>} data by the name of their event; not checked at run time */
const listeners = new Map();
/** @type {EventSource | null} */
let source = null;

/**
 * Call a listener for events of one name; returns the function that ends it.
 * @template {keyof Events} Name
 * @param {Name} name
 * @param {(data: Events[Name]) => void} listener
 */
export function on(name, listener) {
  const registered = listeners.get(name) ?? new Set();
  listeners.set(name, registered.add(listener));
  return () => registered.delete(listener);
}

/**
 * @param {string} name
 * @param {unknown} data
 */
function pass(name, data) {
  for (const listener of listeners.get(name) ?? []) listener(data);
}

export function start() {
  source?.close();
  const stream = new EventSource(`${BASE}/events`);
  source = stream;
  for (const name of NAMES) stream.addEventListener(name, (event) => pass(name, JSON.parse(event.data)));
  stream.addEventListener("open", () => pass("open", {}));
  stream.addEventListener("error", () => {
    pass("lost", {});
    // a refused stream (no key yet, service restarting) is not tried again by the browser
    if (stream.readyState === EventSource.CLOSED) setTimeout(start, 2000);
  });
}
