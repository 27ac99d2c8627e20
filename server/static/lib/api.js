// The public HTTP API as the page uses it: the page sends no other request.
/** @import { Address, Body, Model, Query, Reply, Trouble } from "#routes" */
/** @typedef {{ [name: string]: string | number | boolean | readonly (string | number)[] | null | undefined }} Asked query parameters */

export const BASE = "/api/v1";

/** A refusal by the API: code, cause and remedy. */
export class Problem extends Error {
  /**
   * @param {number} status of HTTP; 0 without an answer
   * @param {Trouble} document_
   * @param {string | null} [requestId]
   */
  constructor(status, document_, requestId = null) {
    super(document_.detail || document_.title || `The service answered ${status}.`);
    this.name = "Problem";
    this.status = status;
    this.code = document_.code;
    this.remedy = document_.remedy;
    this.requestId = requestId;
    this.document = document_;
    this.fields = (document_.errors ?? []).map((/** @type {any} */ one) =>
      typeof one === "string"
        ? one
        : `${(one.loc ?? [one.field ?? ""]).filter((/** @type {unknown} */ p) => p !== "body").join(".")}: ${one.msg ?? one.detail ?? ""}`,
    );
  }
}

/**
 * A problem stated by a document or an event, or found in the operator's input, to be shown as any other.
 * @param {Trouble} trouble
 */
export const problemOf = (trouble) => new Problem(0, trouble);

/**
 * Return true if a request was aborted because its screen was left.
 * @param {unknown} error
 */
export const aborted = (error) => error instanceof Error && error.name === "AbortError";

/** @typedef {"up" | "down" | "login"} Connection */
/** @type {Set<(state: Connection) => void>} */
const listeners = new Set();
/**
 * Call a listener when the service answers ("up"), does not ("down") or requires a key ("login").
 * @param {(state: Connection) => void} listener
 */
export function onConnection(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}
/** @param {Connection} state */
function announce(state) {
  for (const listener of listeners) listener(state);
}

function newKey() {
  // crypto.randomUUID is missing where the page came over plain http from another machine
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

/**
 * @param {string} path below BASE, or a whole address
 * @param {Asked} [query]
 */
function located(path, query = {}) {
  const url = new URL(path.startsWith("/") ? BASE + path : path, location.origin);
  for (const [name, value] of Object.entries(query)) {
    if (value !== undefined && value !== null) url.searchParams.append(name, String(value));
  }
  return url;
}

/**
 * @param {"GET" | "POST" | "PUT" | "PATCH" | "DELETE"} method
 * @param {string} path
 * @param {{ body?: unknown, query?: Asked, headers?: Record<string, string>, signal?: AbortSignal, making?: boolean, keepalive?: boolean }} [options] `making`: it creates something
 */
async function send(method, path, { body, query, headers = {}, signal, making = false, keepalive = false } = {}) {
  const url = located(path, query);
  const sent = { ...headers };
  if (making) sent["Idempotency-Key"] = newKey();
  let content;
  if (body instanceof FormData) content = body;
  else if (body !== undefined) {
    sent["Content-Type"] = "application/json";
    content = JSON.stringify(body);
  }
  // a creating request carries its key, so it may be sent again after a broken connection
  for (let attempt = 0; ; attempt += 1) {
    try {
      const response = await fetch(url, { method, headers: sent, body: content, signal, keepalive, credentials: "same-origin" });
      announce("up");
      return response;
    } catch (error) {
      if (aborted(error)) throw error;
      if (attempt >= 1 || !(method === "GET" || making)) {
        announce("down");
        throw new Problem(0, {
          detail: "The service does not answer.",
          remedy: "Is it running? The page continues by itself once the service answers.",
          code: "no_answer",
        });
      }
      await new Promise((resolve) => setTimeout(resolve, 300));
    }
  }
}

/**
 * @param {Response} response
 * @returns {Promise<never>}
 */
async function refuse(response) {
  let document_ = {};
  try {
    document_ = await response.json();
  } catch {
    // not a problem document: the status must do
  }
  if (response.status === 401) announce("login");
  throw new Problem(response.status, document_, response.headers.get("X-Request-Id"));
}

/** @param {Response} response */
async function ok(response) {
  if (!response.ok) await refuse(response);
  return response;
}

/** @param {Response} response */
const json = async (response) => (response.status === 204 ? null : (await ok(response)).json());

/**
 * @template {string} const P
 * @param {P & Address<"get", P>} path
 * @param {Query<"get", P>} [query]
 * @param {AbortSignal} [signal]
 * @returns {Promise<Reply<"get", P>>}
 */
export const get = async (path, query, signal) => json(await send("GET", path, { query: /** @type {Asked | undefined} */ (query), signal }));

/**
 * @template {string} const P
 * @param {P & Address<"post", P>} path
 * @param {Body<"post", P>} [body]
 * @param {Query<"post", P>} [query]
 * @param {AbortSignal} [signal]
 * @returns {Promise<Reply<"post", P>>}
 */
export const post = async (path, body, query, signal) =>
  json(await send("POST", path, { body, query: /** @type {Asked | undefined} */ (query), making: true, signal }));

/**
 * @template {string} const P
 * @param {P & Address<"put", P>} path
 * @param {Body<"put", P>} body
 * @param {Record<string, string>} [headers]
 * @returns {Promise<Reply<"put", P>>}
 */
export const put = async (path, body, headers) => json(await send("PUT", path, { body, headers }));

/**
 * @template {string} const P
 * @param {P & Address<"patch", P>} path
 * @param {Body<"patch", P>} body
 * @param {Record<string, string>} [headers]
 * @returns {Promise<Reply<"patch", P>>}
 */
export const patch = async (path, body, headers) => json(await send("PATCH", path, { body, headers }));

/**
 * @template {string} const P
 * @param {P & Address<"delete", P>} path
 * @returns {Promise<Reply<"delete", P>>}
 */
export const remove = async (path) => json(await send("DELETE", path));

/**
 * @template {string} const P
 * @param {P & Address<"post", P>} path
 * @param {FormData} form
 * @returns {Promise<Reply<"post", P>>}
 */
export const upload = async (path, form) => json(await send("POST", path, { body: form, making: true }));

/**
 * An answer that is not JSON.
 * @param {string} path
 * @param {Asked} [query]
 */
export const raw = async (path, query) => ok(await send("GET", path, { query }));

/**
 * A file that the service makes of a body.
 * @template {string} const P
 * @param {P & Address<"post", P>} path
 * @param {Body<"post", P>} body
 */
export const fileOf = async (path, body) => (await ok(await send("POST", path, { body }))).blob();

/**
 * Read something together with its ETag, for a change that must not overwrite another client's.
 * @template {string} const P
 * @param {P & Address<"get", P>} path
 * @returns {Promise<{ value: Reply<"get", P>, etag: string | null }>}
 */
export async function getTagged(path) {
  const response = await ok(await send("GET", path));
  return { value: await response.json(), etag: response.headers.get("ETag") };
}

/**
 * Replace something; with the ETag of its present state.
 * @template {string} const P
 * @param {P & Address<"put", P>} path
 * @param {Body<"put", P>} body
 * @param {Record<string, string>} headers
 * @param {boolean} [keepalive] the page may be closed before the answer is there
 * @returns {Promise<{ value: Reply<"put", P>, etag: string | null }>}
 */
export async function putTagged(path, body, headers, keepalive) {
  const response = await ok(await send("PUT", path, { body, headers, keepalive }));
  return { value: await response.json(), etag: response.headers.get("ETag") };
}

/**
 * Log in with a key; the service answers with a cookie that pictures and event streams can use.
 * @param {string} key
 */
export async function login(key) {
  return json(await send("POST", "/session", { headers: { Authorization: `Bearer ${key}` } }));
}

/**
 * An address for <img> and links.
 * @param {string} path
 * @param {Asked} [query]
 */
export function address(path, query) {
  const url = located(path, query);
  return url.pathname + url.search;
}

/**
 * Read a .npy answer. Little-endian floats, ints and bytes, C order, as numpy writes them.
 * @param {string} path
 * @param {Asked} [query]
 */
export async function npy(path, query) {
  const buffer = await (await raw(path, query)).arrayBuffer();
  const view = new DataView(buffer);
  const wide = view.getUint8(6) >= 2;
  const length = wide ? view.getUint32(8, true) : view.getUint16(8, true);
  const start = (wide ? 12 : 10) + length;
  const header = new TextDecoder("latin1").decode(new Uint8Array(buffer, wide ? 12 : 10, length));
  const descr = /'descr':\s*'([^']+)'/.exec(header)?.[1] ?? "";
  const shape = (/'shape':\s*\(([^)]*)\)/.exec(header)?.[1] ?? "")
    .split(",")
    .map((s) => s.trim())
    .filter(Boolean)
    .map(Number);
  const kinds = {
    f8: Float64Array,
    f4: Float32Array,
    i4: Int32Array,
    u4: Uint32Array,
    i2: Int16Array,
    u2: Uint16Array,
    i1: Int8Array,
    u1: Uint8Array,
    b1: Uint8Array,
  };
  const Kind = kinds[/** @type {keyof typeof kinds} */ (descr.slice(1))];
  if (!Kind || descr[0] === ">") throw new Error(`An array of ${descr} cannot be shown.`);
  return { data: new Kind(buffer.slice(start)), shape };
}

/**
 * Follow a job to its end by polling; events make the page quick, this makes it certain.
 * @param {string} jobId
 * @param {{ onprogress?: (job: Model<"JobReply">) => void, signal?: AbortSignal }} [options]
 */
export async function finished(jobId, { onprogress, signal } = {}) {
  for (;;) {
    const job = await get(`/jobs/${jobId}`, undefined, signal);
    onprogress?.(job);
    if (["succeeded", "failed", "cancelled", "interrupted"].includes(job.state)) return job;
    await new Promise((resolve) => setTimeout(resolve, 400));
  }
}

/**
 * The error of a job that did not succeed, to be shown as any other.
 * @param {Model<"JobReply">} job
 */
export const jobProblem = (job) => problemOf(job.problem ?? { detail: `The job ended ${job.state}.`, code: job.state });
