"""The page's skeleton: text made safe, tables, pictures as data, style, what the browser may do."""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


class Markup(str):
    """Text that is markup already; everything else is escaped."""

    __slots__ = ()


def safe(value: object) -> str:
    """Return text as it may stand in a page, also inside an attribute."""
    if isinstance(value, Markup):
        return str(value)
    # what no page may hold
    text = "".join(c for c in str(value) if c in "\n\t" or c >= " ")
    return html.escape(text, quote=True)


def element(name: str, *content: object, **attributes: object) -> Markup:
    """Return an element; ``class_`` is written as class, ``data_item`` as data-item; None leaves an attribute out."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{safe(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{name}{written}>{''.join(safe(part) for part in content)}</{name}>")


@dataclass(frozen=True)
class Cell:
    """A table's cell: text, and the number behind it in plain form."""

    text: object
    number: float | None = None
    span: int | None = None
    head: bool = False


def table(
    head: Sequence[object],
    rows: Iterable[Sequence[object]],
    *,
    caption: object | None = None,
    key: str | None = None,
    keys: Sequence[str] | None = None,
) -> Markup:
    """Return a table; the first cell of a row is its head.

    Parameters
    ----------
    key
        Its id.
    keys
        Id of each row.
    """
    parts = [element("caption", caption)] if caption else []
    if head:
        cells = [element("th", h, scope="col") for h in head]
        parts.append(element("thead", element("tr", *cells)))
    body = []
    for index, row in enumerate(rows):
        cells = [_cell(value, head=k == 0) for k, value in enumerate(row)]
        body.append(element("tr", *cells, data_item=None if keys is None else keys[index]))
    parts.append(element("tbody", *body))
    # a table wider than the page is scrolled, by keyboard too
    return element(
        "div",
        element("table", *parts, id=key),
        class_="wide",
        tabindex="0",
        role="group",
        aria_label=key or "table" if isinstance(caption, Markup) or not caption else caption,
    )


def _cell(value: object, *, head: bool) -> Markup:
    cell = value if isinstance(value, Cell) else Cell("" if value is None else value)
    number = None if cell.number is None else repr(float(cell.number))
    if head or cell.head:
        return element("th", cell.text, scope="row", data_value=number)
    kind = "number" if cell.number is not None else None
    return element("td", cell.text, data_value=number, colspan=cell.span, class_=kind)


def picture(data: bytes, media_type: str, text: str, caption: object, *, half: bool = False) -> Markup:
    """Return a figure whose picture is part of the page."""
    source = f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"
    image = Markup(f'<img src="{source}" alt="{safe(text)}">')
    return element("figure", image, element("figcaption", caption), class_="half" if half else None)


def section(title: str, key: str, *content: object) -> Markup:
    """Return a section with its heading."""
    return element("section", element("h2", title), *content, id=key)


def note(*content: object) -> Markup:
    """Return a paragraph of explanation."""
    return element("p", *content, class_="note")


STYLE = """
:root{color-scheme:light}
*{box-sizing:border-box}
body{font:10.5pt/1.45 "Helvetica Neue",Arial,"Liberation Sans",sans-serif;color:#1b1f24;background:#fff;margin:0 auto;
 padding:1.2cm 1.2cm 2cm;max-width:21cm}
h1{font-size:20pt;line-height:1.15;margin:0 0 .1em}
h2{font-size:13pt;margin:1.6em 0 .5em;padding-bottom:.15em;border-bottom:1.5px solid #1b4f72;color:#1b4f72}
h3{font-size:11pt;margin:1.2em 0 .3em}
p{margin:.4em 0}
.under{color:#57606a;margin:0 0 1em}
.note{color:#57606a;font-size:9pt}
.boxes{display:grid;grid-template-columns:repeat(4,1fr);gap:8px;margin:1em 0}
.box{border:1px solid #d0d7de;border-left:4px solid #57606a;border-radius:3px;padding:.45em .7em}
.box b{display:block;font-size:8.5pt;font-weight:600;color:#57606a}
.box span{font-size:12pt}
.box small{display:block;color:#57606a}
.good{border-left-color:#1a7f37}.warning{border-left-color:#bf8700}.failed{border-left-color:#cf222e}
.warn{border:1px solid #bf8700;background:#fff8e5;padding:.5em .8em;border-radius:3px}
.wide{overflow-x:auto}
table{border-collapse:collapse;width:100%;margin:.5em 0;font-size:9pt}
caption{text-align:left;font-weight:600;padding:.2em 0}
th,td{text-align:left;vertical-align:top;padding:.22em .6em .22em 0;border-bottom:1px solid #e4e8ec}
thead th{border-bottom:1.5px solid #8c959f;vertical-align:bottom}
tbody th{font-weight:500}
td.number{font-variant-numeric:tabular-nums}
#inputs-table code{font-size:6.8pt}
#steps-table td.number{white-space:nowrap;padding-right:.3em}
#steps-table,#motion-table,#quality-table{font-size:8pt}
td.missing,.missing{color:#9a3412}
figure{margin:.8em 0;break-inside:avoid}
figure img{width:100%;height:auto;border:1px solid #e4e8ec}
figcaption{font-size:9pt;color:#57606a}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:10px}
.pair figure{margin:.3em 0}
ul{margin:.3em 0;padding-left:1.3em}
code{font:8.5pt "DejaVu Sans Mono",monospace;overflow-wrap:anywhere}
code+br+code{margin-top:1pt}
pre{font:8pt/1.35 "DejaVu Sans Mono",monospace;white-space:pre-wrap;overflow-wrap:anywhere;
 background:#f6f8fa;padding:.6em}
@page{size:A4;margin:17mm 14mm 16mm}
@media print{
 body{padding:0;max-width:none;font-size:9.5pt}
 h2,h3,caption,thead,.lead{break-after:avoid}
 tr,figure,.box{break-inside:avoid}
 thead{display:table-header-group}
 .wide{overflow:visible}
 section.page{break-before:page}
 a{color:inherit;text-decoration:none}
}
"""


def _quoted(text: str) -> str:
    """Return text as a CSS string."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return '"' + "".join(f"\\{ord(c):x} " if c in '"\\<>&' else c for c in plain) + '"'


def style_of(head: str) -> str:
    """Return the style with the test's name at the head of every printed page, and numbered pages."""
    boxes = (
        f"@page{{@top-left{{content:{_quoted(head)};font:8pt sans-serif;color:#57606a}}"
        '@bottom-right{content:counter(page) " of " counter(pages);font:8pt sans-serif;color:#57606a}}'
    )
    return STYLE + boxes


def policy_of(style: str) -> str:
    """Return the Content-Security-Policy that the page needs: its own style, pictures that it holds, nothing else."""
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    return f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:; base-uri 'none'; form-action 'none'"


def document(title: str, style: str, body: Iterable[object]) -> str:
    """Return the whole page."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{safe(policy_of(style))}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{safe(title)}</title><style>{style}</style></head>\n<body><main>"
        + "\n".join(safe(part) for part in body)
        + "</main></body></html>\n"
    )
