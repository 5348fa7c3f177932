"""XML from elsewhere, within limits."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular

_MAX_BYTES = 8 << 20
_PREFIX = re.compile(rb"<(/?)(\w+):")  # Drake's elements are written without their namespace


class _NoTypes(ElementTree.TreeBuilder):
    """Refuses a document type: its entities could multiply to any size, or name other files."""

    def doctype(self, *_: object) -> None:
        """Called where one begins, in any encoding."""
        raise ValueError("it declares a document type; such files have none")


def read_xml(path: Path, fix: str) -> ElementTree.Element:
    """The root element of a file. Raises InputError, with `fix`."""
    data = read_regular(path, _MAX_BYTES, fix).lstrip()
    try:
        try:
            return ElementTree.fromstring(data, ElementTree.XMLParser(target=_NoTypes()))
        except ElementTree.ParseError as error:
            if "unbound prefix" not in str(error):
                raise
        data = _PREFIX.sub(rb"<\1\2-", data)
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=_NoTypes()))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(path, "", f"is not XML ({error})", fix) from error
