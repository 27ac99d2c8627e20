"""XML of other programs as a tree; entities, inclusions of files and absurd depth are refused."""

from __future__ import annotations

import re
from typing import NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

_MAX_DEPTH = 64
_MAX_ELEMENTS = 300_000
_DECLARATION = re.compile(rb"<\?xml[^<>]*>")
_DOCTYPE = re.compile(rb"<!DOCTYPE[^<>]*>")
_SEVERAL = ("junk after document element", "XML or text declaration not at start of entity")
_INCLUSIONS = ("{http://www.w3.org/2001/XInclude}", "{http://www.w3.org/2003/XInclude}")


def read_side_by_side(data: bytes) -> Element:
    """Return an element around all elements of a text, as programs write that forget the one around them.

    Raises
    ------
    ValueError
        As :func:`read_xml`.
    """
    try:
        parts = Element("parts")
        parts.append(read_xml(data))
        return parts
    except ValueError as error:
        if not str(error).startswith(_SEVERAL):
            raise
    declared = _DECLARATION.search(data)
    rest = _DOCTYPE.sub(b"", _DECLARATION.sub(b"", data.removeprefix(b"\xef\xbb\xbf")))
    return read_xml((declared[0] if declared else b"") + b"<parts>" + rest + b"</parts>")


def read_xml(data: bytes) -> Element:
    """Return the root of an XML document.

    A document type may be named, as VIC-3D and XDMF do; it is never opened.

    Raises
    ------
    ValueError
        For text that is no XML, that declares or needs an entity, that includes other files, or that is nested more
        than 64 deep.
    """
    parser = expat.ParserCreate(namespace_separator="}")
    builder = TreeBuilder()
    depth = count = 0

    def name_of(text: str) -> str:
        return "{" + text if "}" in text else text

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > _MAX_DEPTH or count > _MAX_ELEMENTS:
            raise ValueError(f"it has more than {_MAX_DEPTH} levels or {_MAX_ELEMENTS} elements")
        if name_of(tag).startswith(_INCLUSIONS) and attributes.get("href"):  # without one it is of the same document
            raise ValueError("it includes another file")
        builder.start(name_of(tag), {name_of(key): value for key, value in attributes.items()})

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(name_of(tag))

    def refuse(*_: object) -> NoReturn:
        raise ValueError("Entities are not read")

    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.EntityDeclHandler = parser.SkippedEntityHandler = parser.ExternalEntityRefHandler = refuse
    try:
        parser.Parse(data, True)
        return builder.close()
    except expat.ExpatError as error:
        raise ValueError(str(error)) from error
    except (LookupError, AssertionError) as error:  # an encoding that Python does not know; no element
        raise ValueError(f"its encoding or its elements are unknown ({type(error).__name__})") from error
