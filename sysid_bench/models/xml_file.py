"""XML of model files as elements: entities, huge files and deep nesting are refused."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Final
from xml.parsers import expat

from sysid_bench.errors import ModelError
from sysid_bench.input_files import read_data
from sysid_bench.models.plain_xml import xml_text

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
    _check_declarations(data, name)
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
    _check_depth(root, name)
    return root


def _check_declarations(data: bytes, name: str) -> None:
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ModelError(
            f"{name} declares a DOCTYPE or entities; robot models need none: remove them."
        )


def _check_depth(root: ET.Element, name: str) -> None:
    # Level by level: recursion would overflow on the files that this is to refuse.
    level = [root]
    for _ in range(DEEPEST):
        level = [child for element in level for child in element]
    if level:
        raise ModelError(
            f"{name} nests elements more than {DEEPEST} levels deep; simplify the file."
        )
