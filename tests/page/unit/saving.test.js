import assert from "node:assert/strict";
import { test } from "node:test";
import { cell } from "../../../server/static/widgets/saving.js";

test("a cell that a spreadsheet would run is text", () => {
  for (const text of ["=1+1", "@A1", "-x", "+1+1", "\uff1d1"]) assert.equal(cell(text), `'${text}`);
  assert.equal(cell('=A1,"b"'), '"\'=A1,""b"""');
  assert.equal(cell("\r=1"), '"\'\r=1"');
  for (const text of ["-1.5", "+.5e-7", "u (mm)", ""]) assert.equal(cell(text), text);
});
