// Writes types/openapi.d.ts, the API's models for the page's checker, from build/openapi.json, which `make check-page` writes.
import { readFileSync, writeFileSync } from "node:fs";
import openapiTS, { astToString } from "openapi-typescript";

const at = (path) => new URL(path, import.meta.url);

/** A model that lets further fields through is closed: the page asks for those that the description names. */
function closed(schema) {
  if (Array.isArray(schema)) return schema.map(closed);
  if (schema === null || typeof schema !== "object") return schema;
  const { additionalProperties, ...rest } = schema;
  const own = Object.fromEntries(Object.entries(rest).map(([name, value]) => [name, closed(value)]));
  return additionalProperties === undefined || (additionalProperties === true && schema.properties)
    ? own
    : { ...own, additionalProperties: closed(additionalProperties) };
}

const description = closed(JSON.parse(readFileSync(at("../../build/openapi.json"), "utf8")));
writeFileSync(at("types/openapi.d.ts"), astToString(await openapiTS(description, { defaultNonNullable: false })));
