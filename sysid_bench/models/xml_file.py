"""XML of model files as elements: entities, huge files and deep nesting are refused."""

import codecs
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Final
from xml.parsers import expat

from sysid_bench.errors import ModelError
from sysid_bench.input_files import read_data

_MARKS: Final = (
    (codecs.BOM_UTF8, "utf-8"),
    # The mark of UTF-32 begins with that of UTF-16.
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_DECLARATION: Final = re.compile(r"<\?xml\s[^>]*?\?>")
_ENCODING: Final = re.compile(rb"""<\?xml\s[^>]*?encoding\s*=\s*["']([A-Za-z0-9_.:-]+)["']""")
_COMMENT: Final = re.compile(r"<!--.*?-->", re.DOTALL)
_EXTENDED_ASCII: Final = ("utf-8", "ascii", "iso8859-", "cp125", "koi8-", "gb", "big5", "euc_")
_HEAD: Final = 400  # bytes that hold the declaration


def xml_text(data: bytes) -> str:
    """Return the text without byte order mark, declaration, comments and leading white space, up to
    the first NUL, where texts of C end.

    The bytes are decoded as marked or declared, else as UTF-8, else as Latin-1. Lines keep their
    numbers, but for leading ones.
    """
    text = _decoded(data).partition("\0")[0].lstrip("\ufeff \t\r\n")
    text = _DECLARATION.sub("", text, count=1) if text.startswith("<?xml") else text
    return _COMMENT.sub(lambda comment: "\n" * comment[0].count("\n"), text)


def _decoded(data: bytes) -> str:
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return data[len(mark) :].decode(encoding, errors="replace")
    found = _ENCODING.search(data[:_HEAD])
    try:
        name = codecs.lookup(found[1].decode()).name if found else ""
    except LookupError:
        name = ""
    # Only encodings of text in which ASCII is itself: others, as idna or unicode_escape, would
    # change the tags.
    declared = [name] if name.startswith(_EXTENDED_ASCII) else []
    for encoding in (*declared, "utf-8"):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("latin-1")


LARGEST_FILE: Final = 64 * 2**20
"""Bytes; a larger model text is a mistake."""

DEEPEST: Final = 400
"""Levels of nested elements; MuJoCo stops at 500, Python's recursion at 1000."""


def read_file(path: Path) -> bytes:
    """Return the bytes of a model file; raises ModelError for a file that cannot be read, or is
    larger than `LARGEST_FILE`."""
    try:
        return read_data(path, LARGEST_FILE)
    except OSError as error:
        raise ModelError(f"{path.name} cannot be read: {error.strerror or error}.") from error


def parse_xml(text: str | bytes, name: str) -> ET.Element:
    """Return the root element of an XML text; raises ModelError with the file's `name`.

    DOCTYPE and entities are refused, since they can grow without bound or read files. Prefixes of
    names stay as written, declared or not, as both engines read them; so do byte order marks,
    declarations and comments that the standard forbids (`xml_text`).
    """
    data = xml_text(text.encode() if isinstance(text, str) else text).encode()
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ModelError(
            f"{name} declares a DOCTYPE or entities; robot models need none: remove them."
        )
    # expat itself, since ElementTree's parser resolves prefixes and refuses undeclared ones.
    builder, parser = ET.TreeBuilder(), expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
        root = builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise ModelError(f"{name} is not well-formed XML: {error}.") from error
    # Level by level: recursion would overflow on the files that this is to refuse.
    level = [root]
    for _ in range(DEEPEST):
        level = [child for element in level for child in element]
    if level:
        raise ModelError(
            f"{name} nests elements more than {DEEPEST} levels deep; simplify the file."
        )
    return root
