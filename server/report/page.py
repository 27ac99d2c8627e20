"""The page: its templates filled, its style, and its permissions in a browser."""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import jinja2
from markupsafe import Markup

from stereorig.core.errors import FileFormatError
from stereorig.server.report.items import plain

PNG, SVG = "image/png", "image/svg+xml"
LOGO_NAME = "report_logo"
_MAX_LOGO_BYTES = 1 << 20
#: by the beginning of a file
_LOGOS = ((b"\x89PNG\r\n\x1a\n", PNG), (b"\xff\xd8\xff", "image/jpeg"))


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


def read_logo(path: Path) -> PagePicture:
    """Read a logo: PNG, JPEG or SVG, at most 1 MiB.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable``.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_LOGO_BYTES + 1)
    except FileNotFoundError as error:
        raise FileFormatError(f"{path} does not exist.", code="file_missing", remedy="Check the path.") from error
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {error}.") from error
    found = next((media for begin, media in _LOGOS if data.startswith(begin)), None)
    # a picture of a page runs no script of an SVG file and loads nothing for it
    media = found or (SVG if b"<svg" in data[:2000] else None)
    if media is None or len(data) > _MAX_LOGO_BYTES:
        raise FileFormatError(
            f"{path} is not a PNG, JPEG or SVG picture of at most 1 MiB.", remedy="Save the logo in one of these forms."
        )
    return PagePicture(data, media, "logo", "")


def kept_logo(test: Path | None) -> Path | None:
    """Return the logo that is kept in the data folder of a test; None if there is none."""
    if test is None:
        return None
    candidates = (test.parent.parent / f"{LOGO_NAME}.{ending}" for ending in ("png", "jpg", "svg"))
    return next((path for path in candidates if path.is_file()), None)
