"""Reads a report as a stranger would: with an HTML parser of the standard library."""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser

_VOID = {"meta", "img", "br", "link", "input", "hr"}


@dataclass
class Row:
    """A table's row: the text of each cell, and the numbers behind those that have one."""

    cells: list[str] = field(default_factory=list)
    numbers: list[float | None] = field(default_factory=list)


class Page(HTMLParser):
    """A page taken apart."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.rows: dict[str, Row] = {}
        self.tables: dict[str, list[Row]] = {}
        self.texts: dict[str, str] = {}
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.style = ""
        self.policy = ""
        self.heading = ""
        self._open: list[tuple[str, str | None]] = []
        self._row: Row | None = None
        self._table: str | None = None
        self.feed(text)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        self.tags.append((tag, attributes))
        if tag == "meta" and (attributes.get("http-equiv") or "").lower() == "content-security-policy":
            self.policy = attributes["content"] or ""
        if tag not in _VOID:
            self._open.append((tag, attributes.get("id")))
            if attributes.get("id"):
                self.texts.setdefault(str(attributes["id"]), "")
        if tag == "table":
            self._table = attributes.get("id")
        if tag == "tr":
            self._row = Row()
            if attributes.get("data-item"):
                assert attributes["data-item"] not in self.rows, f"twice: {attributes['data-item']}"
                self.rows[str(attributes["data-item"])] = self._row
            if self._table:
                self.tables.setdefault(self._table, []).append(self._row)
        if tag in ("td", "th") and self._row is not None:
            self._row.cells.append("")
            number = attributes.get("data-value")
            self._row.numbers.append(None if number is None else float(number))

    def handle_endtag(self, tag: str) -> None:
        opened, _ = self._open.pop()
        assert opened == tag, f"{tag} closes {opened}"
        if tag == "tr":
            self._row = None

    def handle_data(self, data: str) -> None:
        inside = [tag for tag, _ in self._open]
        if "style" in inside:
            self.style += data
            return
        for _, key in self._open:
            if key:
                self.texts[key] += data
        if "h1" in inside:
            self.heading += data
        if self._row is not None and self._row.cells:
            self._row.cells[-1] += data

    def pictures(self) -> list[dict[str, str | None]]:
        """Attributes of every picture."""
        return [attributes for tag, attributes in self.tags if tag == "img"]

    def missing(self) -> list[str]:
        """What the page lists as not stated."""
        return [row.cells[0] for row in self.tables.get("not-stated-table", [])[1:]]
