"""Objects as a notebook shows them: a table of facts, and a picture."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable


def card(title: str, facts: Iterable[tuple[str, object]], picture: bytes = b"", text: str = "") -> str:
    """Return HTML of an object: its title, facts by name, and a PNG picture with its description.

    Facts without a value are left out.
    """
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th><td style='text-align:left'>{_cell(value)}</td></tr>"
        for name, value in facts
        if value is not None and value != ""
    )
    drawn = ""
    if picture:
        data = base64.b64encode(picture).decode("ascii")
        drawn = f'<img alt="{html.escape(text)}" src="data:image/png;base64,{data}">'
    return f"<div><b>{html.escape(title)}</b><table>{rows}</table>{drawn}</div>"


def _cell(value: object) -> str:
    return html.escape(f"{value:.6g}" if isinstance(value, float) else str(value))
