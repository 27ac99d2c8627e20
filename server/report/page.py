"""The page: its templates filled, its style, and its permissions in a browser."""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import dataclass

import jinja2
from markupsafe import Markup

from stereorig.server.report.items import plain

PNG, SVG = "image/png", "image/svg+xml"


@dataclass(frozen=True)
class PagePicture:
    """A picture that becomes part of the page.

    Attributes
    ----------
    data, media_type
        The file.
    text
        Description, for readers who do not see it.
    caption
        Text below it.
    half
        True if two of its kind are set side by side.
    """

    data: bytes
    media_type: str
    text: str
    caption: str
    half: bool = True

    @property
    def source(self) -> str:
        """The file as an address."""
        return f"data:{self.media_type};base64,{base64.b64encode(self.data).decode('ascii')}"


def _printable(value: object) -> object:
    """Return the text without the characters that a page must not hold."""
    if isinstance(value, Markup):
        return value
    return "".join(c for c in str(value) if c in "\n\t" or c >= " ")


def _tight(markup: Markup) -> Markup:
    """Return markup without space between its elements: a cell holds its text alone."""
    return Markup(re.sub(r">\s+<", "><", markup.strip()))


def _css_text(text: str) -> Markup:
    """Return text as a CSS string."""
    printable = "".join(c if c.isprintable() else " " for c in text)
    return Markup('"' + "".join(f"\\{ord(c):x} " if c in '"\\<>&' else c for c in printable) + '"')


def render(head: str, *, template: str = "report.html.j2", **content: object) -> tuple[bytes, str]:
    """Fill the page.

    Parameters
    ----------
    head
        Text at the head of every printed page.
    template
        The page's.
    content
        Variables of the templates.

    Returns
    -------
    tuple
        The page, and the Content-Security-Policy that it needs: its own style, pictures that it holds, nothing else.
    """
    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("stereorig.server.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {"tight": _tight, "plain": plain, "css_text": _css_text}
    style = templates.get_template("style.css.j2").render(head=head)
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    policy = f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:; base-uri 'none'; form-action 'none'"
    page = templates.get_template(template).render(style=Markup(style), policy=policy, **content)
    return page.encode(), policy
