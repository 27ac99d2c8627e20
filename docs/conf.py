"""Sphinx's settings for the site: ``make docs`` builds it into build/site, offline, and fails at the first warning."""

from __future__ import annotations

import tomllib
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

_PROJECT = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = "stereorig"
author = "the authors of stereorig"
version = release = _PROJECT["version"]
extensions = ["myst_parser", "docs.built"]
source_suffix = {".md": "markdown"}
nitpicky = True
#: formulas between dollar signs, definition lists, a picture in the text's size
myst_enable_extensions = ["dollarmath", "deflist", "attrs_inline"]
#: headings down to this level can be linked to, by the names that GitHub gives them
myst_heading_anchors = 4

#: options keep both their dashes
smartquotes = False

html_theme = "furo"
html_title = f"stereorig {release}"
html_static_path = ["site"]
html_css_files = ["stereorig.css"]
#: decisions and operations of the API come last in the search
html_search_scorer = str(Path(__file__).parent / "site" / "scorer.js")
html_copy_source = html_show_sourcelink = html_show_sphinx = False
#: figures by nothing but the page's own files: no font, script or style comes from elsewhere
html_theme_options = {"navigation_with_keys": True}
html_math_renderer = "mathml"
pygments_style = "friendly"
pygments_dark_style = "github-dark"
highlight_language = "none"


def _mathml(node: nodes.Element, display: str) -> str:
    return str(convert(node.astext(), display=display))


def _inline(writer: HTML5Translator, node: nodes.math) -> None:
    writer.body.append(_mathml(node, "inline"))
    raise nodes.SkipNode


def _block(writer: HTML5Translator, node: nodes.math_block) -> None:
    number = f'<span class="eqno">({node["number"]})</span>' if node["number"] else ""
    writer.body.append(f'<div class="math">{number}{_mathml(node, "block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Write formulas as MathML, which browsers draw by themselves: no script and no font to bundle."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
