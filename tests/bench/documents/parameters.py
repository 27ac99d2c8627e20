"""The client's and the library's parameters as types that an editor completes and mypy checks, from the request models.

``python -m tests.bench.documents.parameters`` writes them; a test holds the files against the models.
"""

from __future__ import annotations

import subprocess
import sys
import types
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from stereorig.core.settings import AnalysisSettings, StrainSettings
from stereorig.server.api.models import AnalysisRequest, CalibrationRequest, MoveRequest, StepRequest
from stereorig.server.results.gauges.request import GaugeRequest
from tests.support.requirements import ROOT

_HEAD = '''"""Parameters by their names, as types: {of}.

Written by ``python -m tests.bench.documents.parameters`` from the request models, which have bounds and meanings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict
'''
#: file -> what its first line says, and its models
FILES: dict[Path, tuple[str, dict[str, type[BaseModel]]]] = {
    ROOT / "stereorig/parameters.py": (
        "a measurement in memory",
        {"MeasurementParameters": AnalysisSettings, "StrainParameters": StrainSettings},
    ),
    ROOT / "stereorig/client/parameters.py": (
        "the requests of the service",
        {
            "AnalysisParameters": AnalysisRequest,
            "CalibrationParameters": CalibrationRequest,
            "GaugeParameters": GaugeRequest,
            "MoveParameters": MoveRequest,
            "StepParameters": StepRequest,
        },
    ),
}


class _Types:
    """Types of one file's parameters; models inside models become further classes."""

    def __init__(self, named: dict[str, type[BaseModel]]) -> None:
        self.names = {model: name for name, model in named.items()}
        self.classes: dict[str, list[str]] = {}
        for name, model in named.items():
            self._add(name, model)

    def text(self, annotation: Any) -> str:
        """Return a type as it is written: what a script may give where the model has this annotation."""
        origin, parts = get_origin(annotation), get_args(annotation)
        if origin is Annotated:
            return self.text(parts[0])
        if origin in (Union, types.UnionType):
            return " | ".join(dict.fromkeys(self.text(part) for part in parts))
        if origin is Literal:
            return f"Literal[{', '.join(f'{chr(34)}{p}{chr(34)}' if isinstance(p, str) else repr(p) for p in parts)}]"
        if origin is tuple:
            (one,) = {self.text(part) for part in parts}
            return f"Sequence[{one}]"
        if origin is list:
            return f"Sequence[{self.text(parts[0])}]"
        if origin is dict:
            keys, value = self.text(parts[0]), self.text(parts[1])
            # JSON has no other keys than text
            more = f" | Mapping[str, {value}]" if keys == "int" else ""
            return f"Mapping[{keys}, {value}]{more}"
        if annotation in (type(None), None):
            return "None"
        if annotation in (int, float, str, bool):
            return str(annotation.__name__)
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            return f"{self._class_of(annotation)} | {annotation.__name__}"
        return "Any"

    def _class_of(self, model: type[BaseModel]) -> str:
        if model not in self.names:
            self.names[model] = model.__name__.removesuffix("Request") + "Parameters"
            self._add(self.names[model], model)
        return self.names[model]

    def _add(self, name: str, model: type[BaseModel]) -> None:
        lines = [f'    """{_first(model)}"""\n']
        for field, about in model.model_fields.items():
            lines.append(f"    {field}: {self.text(about.annotation)}")
        self.classes[name] = lines

    def used(self) -> Iterable[type[BaseModel]]:
        """Return the models that may be given in place of their parameters."""
        written = "\n".join(line for lines in self.classes.values() for line in lines)
        return [m for m in self.names if f"| {m.__name__}" in written]


def _first(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().splitlines()[0]


def text_of(path: Path) -> str:
    """Return the content that a file of :data:`FILES` should have."""
    of, named = FILES[path]
    found = _Types(named)
    imports: dict[str, list[str]] = {}
    for model in found.used():
        imports.setdefault(model.__module__, []).append(model.__name__)
    text = _HEAD.format(of=of)
    if imports:
        text = text.replace("from typing import Any, ", "from typing import TYPE_CHECKING, Any, ")
        text += "\nif TYPE_CHECKING:\n"
        text += "".join(f"    from {m} import {', '.join(sorted(names))}\n" for m, names in sorted(imports.items()))
    for name, lines in found.classes.items():
        text += f"\n\nclass {name}(TypedDict, total=False):\n" + "\n".join(lines) + "\n"
    ruff = [sys.executable, "-m", "ruff"]
    for how in (["check", "--fix", "--quiet", "--select", "F401"], ["format", "--quiet"]):
        command = [*ruff, *how, "--stdin-filename", str(path), "-"]
        text = subprocess.run(command, input=text, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    return text


if __name__ == "__main__":
    for written in FILES:
        written.write_text(text_of(written), encoding="utf-8")
