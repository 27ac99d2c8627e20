"""The service's own pages: plain HTML with nothing from elsewhere."""

from __future__ import annotations

import html

from stereorig.server.formats.version import software_version

_HEAD = (
    "<!doctype html><html lang='en'><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
    "<link rel='stylesheet' href='/static/reference.css'>"
)
_LINKS = {"/": "stereorig", "/docs": "API", "/docs/operations": "Operations", "/problems": "Problems"}
_NAVIGATION = f"<nav>{' '.join(f'<a href={link!r}>{name}</a>' for link, name in _LINKS.items())}</nav>"


def page(title: str, body: str, *, more_head: str = "") -> str:
    """Return a page; ``body`` and ``more_head`` are HTML, ``title`` is text."""
    shown = html.escape(title)
    version = html.escape(software_version())
    return (
        f"{_HEAD}<title>{shown} - stereorig</title>{more_head}{_NAVIGATION}<main><h1>{shown}</h1>{body}</main>"
        f"<footer>stereorig {version}</footer></html>"
    )
