"""Writes server/static/problems.json: every code that the program can raise, with status, causes and remedies.

It is read out of the source: each line where an error of the project's tree, or a problem of the API, is made. The
service shows it at ``/problems``.

::

    python -m tests.bench.documents.problem_list
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import stereorig.core.errors
import stereorig.server.base.errors
from stereorig.server.api.protocol.problems import status_of_class
from tests.support.requirements import ROOT

LIST = ROOT / "server" / "static" / "problems.json"
PACKAGES = ("core", "drivers", "server", "sim")
_WORD = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
#: answers that are made without an error of the tree: name, then the argument indices of status, code, cause, remedy
_MAKERS = {"problem_response": (0, 1, 2, 3), "problem_answer": (0, 1, 2, 3), "_unknown": (None, 0, 1, None)}
#: found in no sentence of the source: made of the web framework's own errors, or of several sentences
_MORE = {
    "http_error": (400, "The request is not one that this service answers."),
    "internal_error": (500, "An unexpected error inside the service."),
    "malformed_request": (422, "The body cannot be parsed at all."),
    "method_not_allowed": (405, "The path does not serve this method; the header Allow has those that it does."),
    "not_ready": (503, "The rig, the worker or the disk is not ready; `reasons` has code and cause of each."),
    "image_too_large": (413, "The image has more pixels than the service takes."),
    "target_invalid": (422, "The target's description names a value that no grid can have."),
    "target_line_count": (422, "Other numbers of lines were found than the target's description says."),
}
_UNKNOWN_KEY = (401, "Send 'Authorization: Bearer KEY' with a key made by 'stereorig keys add'.")


#: functions that raise for their caller, with the arguments ``code`` and ``remedy``: class and cause
_RAISERS = {"asked_in": ("InputError", "{{...}} names no {named}: {{...}}.")}


class Kind:
    """A class of the exception tree, by its source."""

    def __init__(self, name: str, base: Kind | None, node: ast.ClassDef) -> None:
        self.name, self.base = name, base
        #: what the status goes by: the class itself, or the nearest one above it that is public
        self.known: type[stereorig.core.errors.StereorigError] = (
            getattr(stereorig.core.errors, name, None)
            or getattr(stereorig.server.base.errors, name, None)
            or base.known  # type: ignore[union-attr]
        )
        own = {
            statement.targets[0].id: statement.value.value
            for statement in node.body
            if isinstance(statement, ast.Assign)
            and isinstance(statement.targets[0], ast.Name)
            and isinstance(statement.value, ast.Constant)
        }
        self.code: str = own.get("code", base.code if base else "error")
        self.remedy: str = own.get("remedy", base.remedy if base else "")
        self.about = (ast.get_docstring(node) or "").splitlines()[0]

    def status(self, code: str) -> int:
        """Return the status of its errors with a code."""
        return status_of_class(self.known, code)


def modules() -> dict[Path, ast.Module]:
    """Return every module of the program, parsed."""
    paths = sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def tree(parsed: dict[Path, ast.Module] | None = None) -> dict[str, Kind]:
    """Return every class of the exception tree by its name."""
    nodes = [n for m in (parsed or modules()).values() for n in ast.walk(m) if isinstance(n, ast.ClassDef)]
    root = next(n for n in nodes if n.name == "StereorigError")
    found = {root.name: Kind(root.name, None, root)}
    before = 0
    while len(found) > before:
        before = len(found)
        for node in nodes:
            above = next((b.id for b in node.bases if isinstance(b, ast.Name) and b.id in found), None)
            if above is not None and node.name not in found:
                found[node.name] = Kind(node.name, found[above], node)
    return found


def _text(node: ast.expr | None, names: dict[str, list[ast.expr]] | None = None) -> str | None:
    """Return a sentence of the source, its values as words in braces; None if it is none."""
    if isinstance(node, ast.Name) and names:
        texts = [_text(value) for value in names.get(node.id, ())]
        return next((text for text in texts if text), None)
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        parts = []
        for part in node.values:
            if isinstance(part, ast.Constant):
                parts.append(str(part.value))
            elif isinstance(part, ast.FormattedValue):
                inner = part.value
                named = inner.attr if isinstance(inner, ast.Attribute) else getattr(inner, "id", None)
                parts.append("{" + (named or "...").lstrip("_") + "}")
        return "".join(parts)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        sides = [_text(node.left), _text(node.right)]
        return None if None in sides else "".join(s for s in sides if s)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "strip":
        return _text(node.func.value)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "get":
        return _text(node.args[-1])
    return None


def _words(node: ast.expr, names: dict[str, list[ast.expr]], depth: int = 3) -> set[str]:
    """Return the codes that an expression can be."""
    if isinstance(node, ast.Constant):
        return {node.value} if isinstance(node.value, str) and _WORD.fullmatch(node.value) else set()
    if isinstance(node, ast.IfExp):
        return _words(node.body, names, depth) | _words(node.orelse, names, depth)
    if isinstance(node, ast.Name) and depth:
        return {w for value in names.get(node.id, ()) for w in _words(value, names, depth - 1)}
    if isinstance(node, ast.Dict):
        return {w for value in node.values for w in _words(value, names, depth)}
    if isinstance(node, ast.Tuple):
        return {w for value in node.elts for w in _words(value, names, depth)}
    if isinstance(node, ast.Call):  # {...}.get(key, "otherwise"), next(..., "otherwise")
        inside = [*node.args[1:]]
        if isinstance(node.func, ast.Attribute):
            inside.append(node.func.value)
        return {w for value in inside for w in _words(value, names, depth)}
    return set()


def _assigned(function: ast.AST) -> dict[str, list[ast.expr]]:
    """Return what each name of a function is set to."""
    names: dict[str, list[ast.expr]] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Name):
                    names.setdefault(target.id, []).append(node.value)
        elif isinstance(node, ast.For) and isinstance(node.target, ast.Tuple) and isinstance(node.iter, ast.Tuple):
            for row in node.iter.elts:
                if isinstance(row, ast.Tuple):
                    for name, value in zip(node.target.elts, row.elts, strict=False):
                        if isinstance(name, ast.Name):
                            names.setdefault(name.id, []).append(value)
    return names


class Found:
    """What is known of one code."""

    def __init__(self) -> None:
        self.statuses: set[int] = set()
        self.kinds: set[type[stereorig.core.errors.StereorigError]] = set()
        self.causes: list[str] = []
        self.remedies: list[str] = []

    @property
    def kind(self) -> str:
        """The class of the tree that its errors have in common: what a client raises."""
        lines = [kind.__mro__ for kind in sorted(self.kinds, key=lambda kind: kind.__name__)]
        common = (
            [c for c in lines[0] if all(c in line for line in lines)]
            if lines
            else [stereorig.core.errors.StereorigError]
        )
        return next(c.__name__ for c in common if c.__module__ == stereorig.core.errors.__name__)

    def add(self, status: int | None, cause: str | None, remedy: str | None, *, kind: Kind | None = None) -> None:
        """Note one call that raises it."""
        if kind is not None:
            self.kinds.add(kind.known)
        if status is not None:
            self.statuses.add(status)
        for text, texts in ((cause, self.causes), (remedy, self.remedies)):
            if text and text not in texts:
                texts.append(text)


def _makers_called(module: ast.Module) -> Iterator[tuple[ast.Call, dict[str, list[ast.expr]]]]:
    """Yield every call of a module with what the names around it are set to."""
    outside = _assigned(ast.Module([n for n in module.body if isinstance(n, ast.Assign)], []))

    def visit(node: ast.AST, names: dict[str, list[ast.expr]]) -> Iterator[tuple[ast.Call, dict[str, list[ast.expr]]]]:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            names = names | _assigned(node)
        if isinstance(node, ast.Call):
            yield node, names
        for child in ast.iter_child_nodes(node):
            yield from visit(child, names)

    yield from visit(module, outside)


def scan() -> dict[str, dict[str, Any]]:
    """Read the list out of the source."""
    parsed = modules()
    classes = tree(parsed)
    found: dict[str, Found] = {}
    for cls in classes.values():
        found.setdefault(cls.code, Found()).add(cls.status(cls.code), cls.about, cls.remedy, kind=cls)
    for path, module in parsed.items():
        for call, names in _makers_called(module):
            name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
            if name in classes:
                _error(found, classes[name], call, names)
            elif name in _RAISERS:
                _raised_for(found, classes, name, call, names)
            elif name in _MAKERS and path.relative_to(ROOT).parts[:2] in (("server", "api"), ("server", "front")):
                _answer(found, name, call, names)
        for node in module.body:  # what controllers' own errors are called
            target = node.targets[0] if isinstance(node, ast.Assign) else None
            if isinstance(target, ast.Name) and target.id.endswith("_CODES") and isinstance(node.value, ast.Dict):  # type: ignore[union-attr]
                for code in _words(node.value, {}):  # type: ignore[union-attr]
                    found.setdefault(code, Found()).add(
                        classes["StageError"].status(code), None, None, kind=classes["StageError"]
                    )
    for code, (status, cause) in _MORE.items():
        found[code].causes = [c for c in found[code].causes if c != "{...}."]
        found[code].add(status, cause, None)
    for code in found:
        # what only hands on another error's sentence
        found[code].causes = [c for c in found[code].causes if c.strip("{.}")] or found[code].causes
    found.pop("error", None)  # the tree's root is never raised
    return {
        code: {"status": sorted(f.statuses), "kind": f.kind, "causes": f.causes, "remedies": f.remedies}
        for code, f in sorted(found.items())
    }


def _error(found: dict[str, Found], cls: Kind, call: ast.Call, names: dict[str, list[ast.expr]]) -> None:
    given = {k.arg: k.value for k in call.keywords if k.arg}
    cause = _text(call.args[0], names) if call.args else None
    codes = _words(given["code"], names) if "code" in given else {cls.code}
    if "code" in given and isinstance(given["code"], ast.IfExp) and isinstance(given["code"].orelse, ast.Constant):
        codes |= {cls.code} if given["code"].orelse.value is None else set()
    if cause is None or not cause.strip("{.}"):
        cause = cls.about
    for code in codes:
        # a remedy that is put together of several is named by its class
        remedy = (_text(given["remedy"], names) if "remedy" in given else None) or cls.remedy
        found.setdefault(code, Found()).add(cls.status(code), cause, remedy, kind=cls)


def _raised_for(
    found: dict[str, Found], classes: dict[str, Kind], name: str, call: ast.Call, names: dict[str, list[ast.expr]]
) -> None:
    kind, cause = _RAISERS[name]
    texts = {keyword.arg: _text(keyword.value, names) for keyword in call.keywords if keyword.arg}
    for code in {w for k in call.keywords if k.arg == "code" for w in _words(k.value, names)}:
        found.setdefault(code, Found()).add(
            classes[kind].status(code), cause.format(**texts), texts.get("remedy"), kind=classes[kind]
        )


def _answer(found: dict[str, Found], name: str, call: ast.Call, names: dict[str, list[ast.expr]]) -> None:
    def at(index: int | None) -> ast.expr | None:
        return None if index is None or index >= len(call.args) else call.args[index]

    status, code, cause, remedy = (at(index) for index in _MAKERS[name])
    number = status.value if isinstance(status, ast.Constant) and isinstance(status.value, int) else None
    advice = _text(remedy, names)
    if name == "_unknown":
        number, advice = _UNKNOWN_KEY
    for word in _words(code, names) if code is not None else ():
        found.setdefault(word, Found()).add(number, _text(cause, names), advice)


def text_of(problems: dict[str, dict[str, Any]]) -> str:
    """Return the file's text."""
    return json.dumps(problems, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    LIST.write_text(text_of(scan()), encoding="utf-8")
    print(f"{LIST} has {len(scan())} codes")
