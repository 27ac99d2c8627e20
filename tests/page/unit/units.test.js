// Numbers as they are shown, against the rules of the GUM and figures worked out by hand.
import assert from "node:assert/strict";
import { test } from "node:test";
import { amount, duration, evenMarks, inUnits, shown, times, uncertain, useStrainUnit } from "../../../server/static/lib/units.js";

const plain = (text) => text.replaceAll("\u00a0", " ");

test("lengths below 0.1 mm are shown in micrometres", () => {
  assert.equal(plain(amount(-0.0000406, "mm")), "−0.04060 µm");
  assert.equal(plain(amount(0.0999, "mm")), "99.90 µm");
  assert.equal(plain(amount(0.1, "mm")), "0.1000 mm");
  assert.equal(plain(amount(0, "mm")), "0 µm");
  assert.equal(amount(null, "mm"), "–");
  assert.deepEqual(shown("px", 0.01), { unit: "px", factor: 1 });
});

test("a value has the digits that its uncertainty warrants: two of u", () => {
  assert.equal(plain(uncertain(-0.000040606, 0.00009, "mm")), "−0.041 ± 0.090 µm");
  assert.equal(plain(uncertain(12.345678, 0.00213, "mm")), "12.3457 ± 0.0021 mm");
  assert.equal(plain(uncertain(1234.4, 123, "µm/m")), "1230 ± 120 µm/m");
  assert.equal(plain(uncertain(1998.2, 9.96, "µm/m")), "1998 ± 10 µm/m");
  assert.equal(plain(uncertain(0.00001, 0.0123, "mm")), "0 ± 12 µm");
  assert.equal(plain(uncertain(-0.0000001, 0.0123, "mm")), "0 ± 12 µm");
  assert.equal(plain(uncertain(0.98, 0.0123, "")), "0.980 ± 0.012");
});

test("without an uncertainty a value stands alone, and an unknown one is a dash", () => {
  assert.equal(plain(uncertain(0.98765, null, "")), "0.9877");
  assert.equal(uncertain(Number.NaN, 1, "mm"), "–");
});

test("strain is in um/m or % by choice", () => {
  assert.equal(plain(uncertain(2012.3, 34, "µm/m")), "2012 ± 34 µm/m");
  useStrainUnit("%");
  assert.equal(plain(uncertain(2012.3, 34, "µm/m")), "0.2012 ± 0.0034 %");
  assert.equal(plain(amount(0.0123, "mm")), "12.30 µm");
  useStrainUnit("µm/m");
});

test("strain is in % from 1 % on, all of a column", () => {
  assert.equal(plain(amount(9999, "µm/m")), "9999 µm/m");
  assert.equal(plain(amount(-48122, "µm/m")), "−4.812 %");
  assert.equal(plain(uncertain(-48115, 121, "µm/m")), "−4.812 ± 0.012 %");
  assert.equal(plain(uncertain(300, 20, "µm/m", 52039)), "0.0300 ± 0.0020 %");
});

test("thousands stand apart from five digits on", () => {
  const narrow = "\u202f";
  assert.equal(plain(amount(-48115.2, "N", 5)), `−48${narrow}115 N`);
  assert.equal(plain(amount(123456.78, "N", 8)), `123${narrow}456.78 N`);
  assert.equal(plain(uncertain(-123456, 121, "grey")), `−123${narrow}460 ± 120 grey`);
  assert.equal(plain(amount(4811.25, "N", 6)), "4811.25 N");
  assert.deepEqual(evenMarks([-20000, 0, 20000]), [`−20${narrow}000`, "0", `20${narrow}000`]);
});

test("a scale's marks have the same decimals", () => {
  assert.deepEqual(evenMarks([-0.538, -0.269, 0, 0.269, 0.538]), ["−0.54", "−0.27", "0.00", "0.27", "0.54"]);
  assert.deepEqual(evenMarks([-116, -104, -92.1, -79.9, -67.8]), ["−116", "−104", "−92", "−80", "−68"]);
  assert.deepEqual(evenMarks([1000, 1250, 1500, 1750, 2000]), ["1000", "1250", "1500", "1750", "2000"]);
});

test("the service's words get the page's units", () => {
  assert.equal(inUnits("0.044 +- 0.18 um in shape, 13 +- 50 microstrain (27.0 sigma)"), "0.044 ± 0.18 µm in shape, 13 ± 50 µm/m (27.0 σ)");
  assert.equal(inUnits("a column of um"), "a column of um");
  assert.equal(inUnits(null), "");
});

test("a column has one unit: that of its largest number", () => {
  assert.equal(uncertain(-0.05815, 0.00011, "mm", 0.11643), "−0.05815 ± 0.00011\u00a0mm");
  assert.equal(amount(0.00138, "mm", 3, 0.1134), "0.00138\u00a0mm");
});

test("durations and how often are as people say them", () => {
  const said = [
    [0.04, "0 s"],
    [0.44, "0.4 s"],
    [9.96, "10 s"],
    [59.6, "1 min"],
    [1771.5, "29 min 32 s"],
    [3600, "1 h"],
    [11100, "3 h 5 min"],
    [187200, "2 d 4 h"],
  ];
  for (const [seconds, text] of said) assert.equal(plain(duration(seconds)), text);
  assert.equal(duration(null), "–");
  assert.deepEqual([1, 2, 3, null].map(times), ["once", "twice", "3 times", "–"]);
});
