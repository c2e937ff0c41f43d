"""XML read with care.

A document type could hold entities that expand without end or pull in files: it is
refused.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from clamber.errors import InputError, unreadable

MAX_BYTES = 50_000_000  # of a file


def read_content(path: Path) -> bytes:
    """The bytes of a file that is not too large.

    Raises:
        InputError: It cannot be read, or is.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(
                f"at most {MAX_BYTES // 1_000_000} MB", source=path, value=size
            )
        return path.read_bytes()
    except OSError as e:
        raise unreadable(path, e) from e


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file in UTF-8 without a document type.

    Raises:
        InputError: It is no such file, or too large.
    """
    content = read_content(path)
    if b"\0" in content:  # UTF-16 would hide what is looked for next
        raise InputError("XML in UTF-8", source=path)
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise InputError(
            "XML without a document type: entities are not expanded",
            source=path,
            field="<!DOCTYPE>",
        )
    try:
        return ElementTree.fromstring(content)
    except (ElementTree.ParseError, LookupError, ValueError) as e:  # or an encoding
        raise InputError(f"XML ({e})", source=path) from e
