"""The rig file's keys, written down from the model itself: a page for users, a JSON schema for editors."""

from __future__ import annotations

import json

from pydantic.json_schema import JsonSchemaValue

from stereorig.server.config.rig_file import RigConfig

#: schemas of the models, by name
Definitions = dict[str, JsonSchemaValue]

_HEAD = """# The rig file

A rig file is TOML. It names two cameras, a stage, the calibration target and a calibration plan, and serves `stereorig
serve` and `stereorig doctor`; `stereorig calibrate` takes the nominal camera data from it. A key that is not listed
here is an error, and so is a value outside its range; the message names the key. `stereorig rigfile FILE` checks a file
without opening any device, and `stereorig rigfile --schema` prints a JSON schema, with which editors complete and check
keys while you write.

Complete examples with comments are in `config/`.
"""


def json_schema() -> JsonSchemaValue:
    """Return the JSON schema of a rig file."""
    schema = RigConfig.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "stereorig rig file"
    return schema


def markdown() -> str:
    """Return the page: a table of keys for each section of the file."""
    schema = json_schema()
    known = schema["$defs"]
    lines = [_HEAD]
    # cam1 and cam2 are alike: one table for both
    sections: dict[str, list[str]] = {}
    for name, field in schema["properties"].items():
        target = _table(field)
        sections.setdefault(target or name, []).append(name)
    for target, names in sections.items():
        listed = "items" in _core(schema["properties"][names[0]])
        title = ", ".join(f"`[[{name}]]`" if listed else f"`[{name}]`" for name in names)
        if target not in known:
            lines += [f"## {title}", "", schema["properties"][names[0]].get("description", ""), ""]
            continue
        lines += _section(title, known[target], known, prefix=names[0])
    return "\n".join(lines).rstrip() + "\n"


def _section(title: str, section: JsonSchemaValue, known: Definitions, *, prefix: str) -> list[str]:
    text = section.get("description", "").split(": ", 1)[-1].replace("\n", " ")
    lines = [f"## {title}", "", text[:1].upper() + text[1:], ""]
    lines += ["| key | value | default | meaning |", "| --- | --- | --- | --- |"]
    required = set(section.get("required", ()))
    tables = []
    for key, field in section["properties"].items():
        default = "**required**" if key in required else default_text(field.get("default"))
        meaning = field.get("description", "").replace("|", "\\|").replace("\n", " ")
        lines.append(f"| `{key}` | {kind_of_value(field, known)} | {default} | {meaning} |")
        table = _table(field)
        if table is not None:
            numbered = "additionalProperties" in _core(field) or "patternProperties" in _core(field)
            path = f"[{prefix}.{key}{'.N' if numbered else ''}]"
            tables.append((f"`[{path}]`" if "items" in _core(field) else f"`{path}`", known[table]))
    lines.append("")
    for name, table_schema in tables:
        lines += _section(name, table_schema, known, prefix=name.strip("`[]"))
    return lines


def _core(field: JsonSchemaValue) -> JsonSchemaValue:
    """Remove the alternative `null`: a key that may be left out."""
    options = [option for option in field.get("anyOf", [field]) if option.get("type") != "null"]
    return options[0] if len(options) == 1 else {"anyOf": options}


def _target(field: JsonSchemaValue) -> str | None:
    reference = _core(field).get("$ref") or (field.get("allOf") or [{}])[0].get("$ref")
    return None if reference is None else str(reference).rsplit("/", 1)[-1]


def _table(field: JsonSchemaValue) -> str | None:
    """Name of the model behind a key that holds a table of its own, tables by number, or a list of them."""
    target = _target(field)
    if target is not None:
        return target
    core = _core(field)
    for inner in (core.get("additionalProperties"), core.get("items"), *core.get("patternProperties", {}).values()):
        if isinstance(inner, dict) and "$ref" in inner:
            return str(inner["$ref"]).rsplit("/", 1)[-1]
    return None


def default_text(default: object) -> str:
    """Return a default as a table shows it."""
    if default is None or default == {}:
        return "left out"
    return f"`{json.dumps(default)}`"


def kind_of_value(field: JsonSchemaValue, known: Definitions) -> str:
    """Return the values that a field of a JSON schema takes, in words."""
    core = _core(field)
    if "anyOf" in core:
        return " or ".join(kind_of_value(option, known) for option in core["anyOf"])
    if _table(field) is not None and ("$ref" not in core or "properties" in known[_target(field) or ""]):
        return "table"
    if "$ref" in core:
        core = known[_target(field) or ""]
        if core.get("type") == "array":  # of arrays of itself, as the numbers of a field
            return "nested list"
    if "const" in core:
        return f"`{json.dumps(core['const'])}`"
    if "enum" in core:
        return ", ".join(f"`{json.dumps(value)}`" for value in core["enum"])
    kind = core.get("type")
    if kind == "array":
        return _array(core, known)
    if kind == "object":
        return "table"
    names = {"number": "number", "integer": "integer", "string": "text", "boolean": "`true`, `false`"}
    return f"{names.get(str(kind), str(kind))}{_range(core)}"


def _array(core: JsonSchemaValue, known: Definitions) -> str:
    if "prefixItems" in core:
        inner = [kind_of_value(item, known) for item in core["prefixItems"]]
        return f"[{inner[0]}] x {len(inner)}" if len(set(inner)) == 1 else f"[{', '.join(inner)}]"
    minimum, maximum = core.get("minItems", 0), core.get("maxItems")
    return f"list of {kind_of_value(core.get('items', {}), known)}" + (
        "" if maximum is None else f", {minimum} to {maximum}"
    )


def _range(core: JsonSchemaValue) -> str:
    low, high = core.get("minimum"), core.get("maximum")
    above, below = core.get("exclusiveMinimum"), core.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f", {_plain(low)} to {_plain(high)}"
    parts = [
        f"{word} {_plain(bound)}"
        for word, bound in (("from", low), ("above", above), ("up to", high), ("below", below))
        if bound is not None
    ]
    if "maxLength" in core:
        parts.append(f"up to {core['maxLength']} characters")
    return f", {', '.join(parts)}" if parts else ""


def _plain(bound: float) -> str:
    return str(int(bound)) if bound == int(bound) else str(bound)
