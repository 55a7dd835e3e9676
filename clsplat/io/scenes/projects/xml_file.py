"""Parses the XML of other programs, which may be damaged or hostile."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element


def root_of(data: bytes) -> Element:
    """The root of an XML file; ValueError if it is damaged, or defines entities, which no program
    writes and a few of which may expand to more than the memory holds."""
    if b"<!ENTITY" in data.replace(b"\0", b""):  # in UTF-16, too
        raise ValueError("it defines entities")
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError) as error:  # the last: an unknown encoding
        raise ValueError(str(error)) from None
