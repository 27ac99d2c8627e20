// A test measured while it runs: a switch, the newest values of its gauges, their curves against time or a channel, and a field.
import * as api from "../../lib/api.js";
import { chart } from "../../widgets/plots.js";
import { coarse, liveField } from "./live_field.js";
import { amount, shown, uncertain } from "../../lib/units.js";
import { h, action, badge, field, notify, problemText, replace, select, table } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Body, Model, Reply } from "#routes" */
/** @typedef {Reply<"get", "/tests/{test_id}/live">} Live */
/** @typedef {Model<"LiveValues">} Values */

const DRAW_MS = 100; // ten pictures a second are enough for eyes
const KEPT = 3000;
const CHANNELS_MS = 1000;
const SHOWN = { extensometer: "strain", area: "eyy", point: "w_mm" };
const UNITS = { extensometer: "1", area: "1", point: "mm" };
const KINDS = /** @type {const} */ (["extensometer", "area", "point"]);
/** Strain is shown in µm/m. @param {string} unit */
const plain = (unit) => (unit === "1" ? { unit: "µm/m", factor: 1e6 } : { unit, factor: 1 });
/** @param {{ value: number, u: number | null, units: string }} number */
const inUnits = ({ value, u, units }) => {
  const { unit, factor } = plain(units);
  return u === null ? amount(factor * value, unit) : uncertain(factor * value, factor * u, unit);
};
const WORDS = { extensometer: "extensometers: strain", area: "areas: εyy", point: "points: W" };

/**
 * The gauges that are drawn for a test, as a live measurement takes them.
 * @param {Reply<"get", "/tests/{test_id}/workspace">} drawn
 * @returns {Body<"post", "/tests/{test_id}/live">}
 */
export function liveGauges(drawn) {
  // of a union of forms: a list left out is an empty one
  const gauges = /** @type {any} */ (drawn.gauges);
  /** @type {any} */
  const found = { points: [], extensometers: [], areas: [] };
  for (const one of gauges?.points ?? []) if (one.xy_px) found.points.push({ name: one.name, xy_px: one.xy_px });
  for (const one of gauges?.extensometers ?? []) if (one.a_px && one.b_px) found.extensometers.push({ name: one.name, a_px: one.a_px, b_px: one.b_px });
  for (const one of gauges?.areas ?? []) {
    if (one.rectangle_px) found.areas.push({ name: one.name, rectangle: one.rectangle_px });
    else if (one.polygon_px) found.areas.push({ name: one.name, polygon: one.polygon_px });
  }
  return found;
}

/**
 * A vertical extensometer over the middle third of camera 1's image, if none is drawn.
 * @param {number[]} size
 * @returns {Body<"post", "/tests/{test_id}/live">}
 */
const middle = ([width, height]) => ({
  extensometers: [{ name: "e1", a_px: [Math.round(width / 2), Math.round(height / 3)], b_px: [Math.round(width / 2), Math.round((2 * height) / 3)] }],
});

/**
 * Curves of the gauges against time or a channel.
 * @param {string} testId
 */
function liveCurves(testId) {
  const root = h("div", { "data-role": "live-curves" });
  const kind = select(
    KINDS.map((name) => [name, WORDS[name]]),
    "extensometer",
  );
  const against = select([["time", "time (s)"]], "time");
  /** @type {{ number: number, time_s: number, values: Record<string, Record<string, number>> }[]} */
  let moments = [];
  /** @type {Map<number, Record<string, number>>} channels at the exposure, by frame */
  const channels = new Map();
  /** @type {Values["gauges"]} */
  let gauges = {};
  /** @type {Awaited<ReturnType<typeof chart>> | null} */
  let plot = null;
  let plotted = "";
  let drawing = false;
  let asking = 0;

  async function askChannels() {
    const known = Object.keys((await api.get(`/tests/${testId}/live`)).channels);
    if (known.length + 1 !== against.options.length) {
      const chosen = against.value;
      replace(
        against,
        ["time", ...known].map((name) => h("option", { value: name, selected: name === chosen }, name === "time" ? "time (s)" : name)),
      );
    }
    if (against.value === "time") return;
    // the last ones again: readings come after the frames that they belong to
    const { frames } = await api.get(`/tests/${testId}/live/history`, { after: Math.max(0, (moments.at(-1)?.number ?? 0) - 500), limit: 1000 });
    for (const frame of frames) channels.set(frame.number, frame.channels);
  }

  async function drawCurves() {
    drawing = true;
    try {
      const wanted = /** @type {keyof typeof SHOWN} */ (kind.value);
      const names = Object.entries(gauges)
        .filter(([, gauge]) => gauge.kind === wanted)
        .map(([name]) => name);
      if (!names.length || !moments.length) return;
      const zero = moments[0].time_s;
      const at = against.value;
      const points = moments
        .flatMap((moment) => {
          const x = at === "time" ? moment.time_s - zero : channels.get(moment.number)?.[at];
          return x === undefined ? [] : [{ x, moment }];
        })
        .toSorted((a, b) => a.x - b.x);
      const base = plain(UNITS[wanted]);
      const to = shown(base.unit);
      const scaled = (/** @type {number | undefined} */ value) => (value === undefined ? null : value * base.factor * to.factor);
      const data = /** @type {any} */ ([
        points.map((one) => one.x),
        ...names.map((name) => points.map(({ moment }) => scaled(moment.values[name]?.[SHOWN[wanted]]))),
      ]);
      const key = JSON.stringify([wanted, names, at, to.unit]);
      if (key === plotted && plot) {
        plot.set(data);
        return;
      }
      plot?.close();
      plot = await chart(root, {
        x: at === "time" ? "time (s)" : at,
        y: `${WORDS[wanted].split(": ")[1]} (${to.unit})`,
        height: 260,
        data,
        series: names.map((name) => ({ label: name })),
        label: "Live curves of the gauges",
      });
      plotted = key;
    } finally {
      drawing = false;
    }
  }
  kind.addEventListener("change", () => drawCurves().catch(notify));
  against.addEventListener("change", () => askChannels().then(drawCurves).catch(notify));
  return {
    root,
    controls: [field("Show", kind), field("Against", against)],
    begin() {
      moments = [];
      channels.clear();
      asking = window.setInterval(() => askChannels().catch(() => {}), CHANNELS_MS);
    },
    stop: () => clearInterval(asking),
    /** @param {Values} now */
    add(now) {
      if (now.valid && typeof now.time_s === "number" && now.number > (moments.at(-1)?.number ?? 0)) {
        moments.push({
          number: now.number,
          time_s: now.time_s,
          values: Object.fromEntries(
            Object.entries(now.gauges).map(([name, gauge]) => [
              name,
              Object.fromEntries(Object.entries(gauge.values).map(([quantity, number]) => [quantity, number.value])),
            ]),
          ),
        });
        if (moments.length > KEPT) channels.delete(/** @type {{ number: number }} */ (moments.shift()).number);
      }
    },
    /** @param {Values["gauges"]} now */
    draw(now) {
      gauges = now;
      if (!drawing) drawCurves().catch(notify);
    },
    close: () => plot?.close(),
  };
}

/**
 * @param {string} testId
 * @param {Ends} ends
 */
export async function liveValuesPanel(testId, ends) {
  const state = h("span", { role: "status", "data-role": "live-state" });
  const said = h("div");
  const values = h("div", { "data-role": "live-values" });
  const start = action("Measure live", begin, { kind: "primary" });
  const stop = action("Stop", end);
  const withField = h("input", { type: "checkbox" });
  const withFieldLabel = h("label.check", withField, "with a coarse field");
  const picture = liveField(testId);
  const curves = liveCurves(testId);
  /** @type {EventSource | null} */
  let source = null;
  /** @type {Values | null} */
  let newest = null;
  let later = 0;

  async function begin() {
    const drawn = await api.get(`/tests/${testId}/workspace`);
    const body = /** @type {any} */ (liveGauges(drawn));
    const none = !(body.points?.length || body.extensometers?.length || body.areas?.length);
    const size = (await api.get("/rig")).cameras.cam1.nominal.image_size_px;
    const points = withField.checked ? coarse(drawn.region, size) : {};
    take(await api.post(`/tests/${testId}/live`, { ...(none ? middle(size) : body), ...points, silence_ms: 1000 }));
    if (none) notify("No gauge is drawn for this test (Results, Gauges): an extensometer over the middle of the image is read.");
  }
  async function end() {
    take(await api.post(`/tests/${testId}/live:stop`));
  }

  /** @param {Live} live */
  function take(live) {
    const on = live.state === "starting" || live.state === "running";
    start.hidden = on;
    stop.hidden = !on;
    withFieldLabel.hidden = on;
    const asked = /** @type {{ field?: boolean, reference?: number }} */ (live.settings);
    picture.follow(on && asked.field ? (asked.reference ?? 0) : null);
    replace(said, live.problem ? problemText(live.problem) : null);
    newest = live.values;
    if (on && !source) follow();
    if (!on) close();
    draw(live.state);
  }
  function close() {
    source?.close();
    source = null;
    curves.stop();
    clearTimeout(later); // a value that came before the end must not draw over it
    later = 0;
  }
  function follow() {
    curves.begin();
    source = new EventSource(api.address(`/tests/${testId}/live/events`));
    source.addEventListener("values", (event) => {
      /** @type {Values} */
      const now = JSON.parse(event.data);
      newest = now;
      curves.add(now);
      if (!later)
        later = window.setTimeout(() => {
          later = 0;
          draw(now.valid ? "running" : now.reason);
        }, DRAW_MS);
    });
    source.addEventListener("error", () => look().catch(() => {})); // it ended, or the service did
  }
  async function look() {
    try {
      take(await api.get(`/tests/${testId}/live`));
    } catch (error) {
      if (!(error instanceof api.Problem) || error.status !== 404) throw error;
      start.hidden = false;
      withFieldLabel.hidden = false;
      stop.hidden = true;
      picture.follow(null);
      close();
    }
  }

  /** @param {string} word */
  function draw(word) {
    const good = word === "running";
    replace(state, badge(good ? "live" : word, good ? "good" : word === "ended" ? "" : "warning"), newest?.number ? ` frame ${newest.number}` : "");
    const rows = Object.entries(newest?.gauges ?? {}).map(([name, gauge]) => ({ name, gauge, number: gauge.values[SHOWN[gauge.kind]] }));
    replace(
      values,
      rows.length
        ? table(
            [
              ["Gauge", (row) => row.name],
              ["Quantity", (row) => WORDS[row.gauge.kind].split(": ")[1]],
              ["Value", (row) => (row.number ? inUnits(row.number) : `not valid: ${row.gauge.reason}`)],
            ],
            rows,
            { caption: "Newest values, ± standard uncertainty" },
          )
        : null,
    );
    curves.draw(newest?.gauges ?? {});
  }
  // a test that is not measured live has nothing to be asked for
  if ((await api.get("/healthz")).live_test_id === testId) await look();
  else stop.hidden = true;
  ends.push(() => {
    close();
    curves.close();
    picture.close();
  });
  return h(
    "section.panel",
    { "aria-label": "Live values" },
    h("div.spread", h("h2", "Live values"), state),
    h("p.quiet", "Each frame is measured as it comes, and not stored; captures and analyses continue."),
    h("div.row", start, withFieldLabel, stop, curves.controls),
    said,
    values,
    curves.root,
    picture.root,
  );
}
