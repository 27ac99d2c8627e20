"""Bodies of JSON that cost a careless service dear: deep, wide, long, odd; plain, or inside a body that is right."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from typing import Any

MIB = 2**20
Text = Callable[[random.Random, int], str]


def _names(rng: random.Random, size: int) -> str:
    word = rng.choice(["x", "nam", "width_mm", "\\u00e9"])
    return "{" + ",".join(f'"{word}{n}":{n}' for n in range(size // (len(word) + 14))) + "}"


def _nested(rng: random.Random, size: int) -> str:
    opening, closing = rng.choice([("[", "]"), ('{"a":', "}"), ('[{"region":', "}]")])
    depth = min(size // (len(opening) + len(closing)), rng.choice([90, 240, 900, 40_000, MIB]))
    return opening * depth + rng.choice(["1", "null", '"x"']) + closing * depth


def _list_of(*items: str) -> Text:
    def made(rng: random.Random, size: int) -> str:
        item = rng.choice(items)
        return "[" + ",".join([item] * max(1, size // (len(item) + 1))) + "]"

    return made


def _string(rng: random.Random, size: int) -> str:
    unit = rng.choice(["a", " ", "1", "[", "\\ud800", "\\u0000", "\\udc00\\ud800", "é", "\\\\", "a b-", ":,{["])
    return '"' + unit * (size // len(unit.encode())) + '"'


def _long_name(rng: random.Random, size: int) -> str:
    return "{" + _string(rng, size - 8) + ":1}"


def _number(rng: random.Random, size: int) -> str:
    digits = rng.choice([4000, 4301, 100_000, size])
    one = rng.choice(["9" * digits, "0." + "1" * digits, "1e" + "9" * min(digits, 4000), "-" + "1" * digits + ".5e-7"])
    return "[" + ",".join([one] * max(1, size // (len(one) + 1))) + "]" if rng.random() < 0.7 else one[:size]


def _alike(rng: random.Random, size: int) -> str:
    name = rng.choice(["name", "region", "steps", "label"])
    return "{" + ",".join([f'"{name}":{rng.choice(["1", "[]", "{}"])}'] * (size // (len(name) + 6))) + "}"


def _objects(rng: random.Random, size: int) -> str:
    return _list_of('{"a":1,"b":2}', '{"name":"x","name":"y"}', '{"kind":"point","x_px":1e308}', "{}")(rng, size)


FORMS: dict[str, Text] = {
    "names": _names,
    "nested": _nested,
    "numbers": _list_of("0", "1.5", "-1e308", "NaN", "123456789012345678901234567890"),
    "pairs": _list_of("[1,2]", "[0.25,0.5]", "[[1,2],[3,4]]", "[null]"),
    "words": _list_of('"a"', "true", "null", '"\\ud800"'),
    "string": _string,
    "long name": _long_name,
    "long number": _number,
    "alike": _alike,
    "objects": _objects,
}


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, inner in items:
        yield from _places(inner, (*path, name))


def _put(value: Any, path: tuple[Any, ...], mark: str) -> Any:
    if not path:
        return mark
    copied = dict(value) if isinstance(value, dict) else list(value)
    copied[path[0]] = _put(copied[path[0]], path[1:], mark)
    return copied


def body(rng: random.Random, right: Any, size: int) -> tuple[str, bytes]:
    """Return a form's name and a body of some size, in half of the cases with the form in place of a right value."""
    form = rng.choice(list(FORMS))
    text = FORMS[form](rng, size)
    choice = rng.random()
    if choice < 0.5 or right is None:
        return form, text.encode()
    if choice < 0.7 and isinstance(right, dict) and text.startswith("{"):  # beside the right names
        return f"{form}, more", (json.dumps(right)[:-1] + "," + text[1:]).encode()
    path = rng.choice(list(_places(right)))
    return f"{form} at {'.'.join(map(str, path))}", json.dumps(_put(right, path, "@@")).replace('"@@"', text).encode()
