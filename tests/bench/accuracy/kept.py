"""Results of long benches, kept as they come: one that was stopped goes on where it was.

Kept below ``build/accuracy`` by what they depend on: after a change of ``core`` or of the scenes all is measured anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
_DEPENDS_ON = ("core/**/*.py", "tests/support/relief_*.py", "tests/bench/accuracy/*reliefs.py")


@cache
def _state() -> str:
    digest = hashlib.sha256()
    for pattern in _DEPENDS_ON:
        for path in sorted(ROOT.glob(pattern)):
            digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def kept(bench: str, name: str, measure: Callable[[], dict[str, float]]) -> dict[str, float]:
    """Return what was measured before under this name, or measure and keep it."""
    path = ROOT / "build" / "accuracy" / f"{bench}-{_state()}.json"
    known: dict[str, dict[str, float]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if name not in known:
        known[name] = measure()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".new").write_text(json.dumps(known, indent=1), encoding="utf-8")
        path.with_suffix(".new").replace(path)
        print(name, known[name], flush=True)
    return known[name]
