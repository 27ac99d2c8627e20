// The public HTTP API as the page uses it: nothing else is ever asked.

export const BASE = "/api/v1";

/** What the API answers when it refuses: code, cause and remedy. */
export class Problem extends Error {
  constructor(status, document_, requestId) {
    super(document_.detail || document_.cause || document_.title || `The service answered ${status}.`);
    this.name = "Problem";
    this.status = status;
    this.code = document_.code;
    this.remedy = document_.remedy;
    this.requestId = requestId;
    this.document = document_;
    this.fields = (document_.errors ?? []).map((one) =>
      typeof one === "string" ? one : `${(one.loc ?? [one.field ?? ""]).filter((p) => p !== "body").join(".")}: ${one.msg ?? one.detail ?? one.cause ?? ""}`,
    );
  }
}

const listeners = new Set();
/** Hear whether the service can be reached ("up", "down") and when a key is needed ("login"). */
export function onConnection(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}
const tell = (state) => listeners.forEach((listener) => listener(state));

function newKey() {
  // crypto.randomUUID is missing where the page came over plain http from another machine
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

async function send(method, path, { body, query, headers = {}, signal, making = false } = {}) {
  const url = new URL(path.startsWith("/") ? BASE + path : path, location.origin);
  for (const [name, value] of Object.entries(query ?? {})) if (value !== undefined && value !== null) url.searchParams.append(name, value);
  const sent = { ...headers };
  if (making) sent["Idempotency-Key"] = newKey();
  if (body !== undefined && !(body instanceof FormData)) {
    sent["Content-Type"] = "application/json";
    body = JSON.stringify(body);
  }
  // what makes something carries its key, so it may be sent once more when the line broke
  for (let attempt = 0; ; attempt += 1) {
    try {
      const response = await fetch(url, { method, headers: sent, body, signal, credentials: "same-origin" });
      tell("up");
      return response;
    } catch (error) {
      if (error.name === "AbortError") throw error;
      if (attempt >= 1 || !(method === "GET" || making)) {
        tell("down");
        throw new Problem(0, { detail: "The service does not answer.", remedy: "Is it running? The page goes on by itself once it is back.", code: "no_answer" });
      }
      await new Promise((resolve) => setTimeout(resolve, 300));
    }
  }
}

async function refuse(response) {
  let document_ = {};
  try {
    document_ = await response.json();
  } catch {
    // not a problem document: the status must do
  }
  if (response.status === 401) tell("login");
  throw new Problem(response.status, document_, response.headers.get("X-Request-Id"));
}

async function ok(response) {
  if (!response.ok) await refuse(response);
  return response;
}

const json = async (response) => (response.status === 204 ? null : (await ok(response)).json());

export const get = async (path, query, signal) => json(await send("GET", path, { query, signal }));
export const post = async (path, body, query) => json(await ok(await send("POST", path, { body: body ?? undefined, query, making: true })));
export const put = async (path, body, headers) => json(await ok(await send("PUT", path, { body, headers })));
export const patch = async (path, body, headers) => json(await ok(await send("PATCH", path, { body, headers })));
export const remove = async (path, headers) => json(await ok(await send("DELETE", path, { headers })));
export const upload = async (path, form) => json(await ok(await send("POST", path, { body: form, making: true })));
export const raw = async (path, query, signal) => ok(await send("GET", path, { query, signal }));

/** Read something together with its ETag, for a change that must not overwrite somebody else's. */
export async function getTagged(path) {
  const response = await ok(await send("GET", path));
  return { value: await response.json(), etag: response.headers.get("ETag") };
}

/** Log in with a key; the service answers with a cookie that pictures and event streams can use. */
export async function login(key) {
  return json(await ok(await send("POST", "/session", { headers: { Authorization: `Bearer ${key}` } })));
}

/** An address for <img> and links. */
export function address(path, query = {}) {
  const url = new URL(BASE + path, location.origin);
  for (const [name, value] of Object.entries(query)) if (value !== undefined && value !== null) url.searchParams.append(name, value);
  return url.pathname + url.search;
}

/** Read a .npy answer: {data, shape}. Little-endian floats, ints and bytes, C order, as numpy writes them. */
export async function npy(path, query, signal) {
  const buffer = await (await raw(path, query, signal)).arrayBuffer();
  const view = new DataView(buffer);
  const wide = view.getUint8(6) >= 2;
  const length = wide ? view.getUint32(8, true) : view.getUint16(8, true);
  const start = (wide ? 12 : 10) + length;
  const header = new TextDecoder("latin1").decode(new Uint8Array(buffer, wide ? 12 : 10, length));
  const descr = /'descr':\s*'([^']+)'/.exec(header)[1];
  const shape = /'shape':\s*\(([^)]*)\)/.exec(header)[1].split(",").map((s) => s.trim()).filter(Boolean).map(Number);
  const kinds = { f8: Float64Array, f4: Float32Array, i4: Int32Array, u4: Uint32Array, i2: Int16Array, u2: Uint16Array, i1: Int8Array, u1: Uint8Array, b1: Uint8Array };
  const Kind = kinds[descr.slice(1)];
  if (!Kind || descr[0] === ">") throw new Error(`An array of ${descr} cannot be shown.`);
  return { data: new Kind(buffer.slice(start)), shape };
}

/** Follow a job to its end by polling; events make the page quick, this makes it certain. */
export async function finished(jobId, { onprogress, signal } = {}) {
  for (;;) {
    const job = await get(`/jobs/${jobId}`, undefined, signal);
    onprogress?.(job);
    if (["succeeded", "failed", "cancelled", "interrupted"].includes(job.state)) return job;
    await new Promise((resolve) => setTimeout(resolve, 400));
  }
}

/** The error of a job that did not succeed, to be shown as any other. */
export function jobProblem(job) {
  return new Problem(0, job.problem ?? { detail: `The job ended ${job.state}.`, code: job.state }, null);
}
