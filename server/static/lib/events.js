// One stream of events for the whole page; the browser resumes it with Last-Event-ID by itself.
import { BASE } from "./api.js";

const NAMES = ["job", "step", "result", "stage", "camera", "scene", "test", "calibration", "noise"];
const listeners = new Map();
let source = null;

/** Hear events of one name, or of all ("*"); returns the function that ends it. */
export function on(name, listener) {
  if (!listeners.has(name)) listeners.set(name, new Set());
  listeners.get(name).add(listener);
  return () => listeners.get(name).delete(listener);
}

function pass(name, data) {
  for (const key of [name, "*"]) for (const listener of listeners.get(key) ?? []) listener(data, name);
}

export function start() {
  source?.close();
  source = new EventSource(`${BASE}/events`);
  for (const name of NAMES) source.addEventListener(name, (event) => pass(name, JSON.parse(event.data)));
  source.addEventListener("open", () => pass("open", {}));
  source.addEventListener("error", () => {
    pass("lost", {});
    // a refused stream (no key yet, service restarting) is not tried again by the browser
    if (source.readyState === EventSource.CLOSED) setTimeout(start, 2000);
  });
}
