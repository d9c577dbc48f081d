"""XML as bytes: the positions of elements and attributes, so that numbers are replaced in place."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from sysid_bench.errors import ModelError

_ATTRIBUTE: Final = re.compile(rb"\s+([^\s=/>\"']+)\s*=\s*(\"[^\"]*\"|'[^']*')")

# Possessive: quoted values are not tried again in parts, so that the time stays linear.
_START_TAG: Final = re.compile(rb"(?:[^\"'>]++|\"[^\"]*\"|'[^']*')*+>")


@dataclass(eq=False)
class Element:
    """One element: bytes start..head_end are its start tag, head_end..tail its content; `tail` is
    where its end tag begins. `empty`: written as <tag/>. Completed while the text is read."""

    tag: str
    attributes: dict[str, str]
    start: int
    head_end: int
    parent: "Element | None"
    empty: bool
    tail: int = -1
    children: list["Element"] = field(default_factory=list)

    def find(self, tag: str) -> "Element | None":
        """Return the first child with this tag, None without one."""
        return next((child for child in self.children if child.tag == tag), None)

    def subtree(self) -> Iterator["Element"]:
        """Yield the element and all below it, in the order of the text."""
        yield self
        for child in self.children:
            yield from child.subtree()


@dataclass(frozen=True)
class Edit:
    """Replacement of bytes start..end of the source by `text`."""

    start: int
    end: int
    text: str


def element_tree(data: bytes, name: str) -> Element:
    """Return the root element of an XML text in UTF-8; raises ModelError with `name`.

    Entities and a DOCTYPE are refused earlier, by `parse_xml`.
    """
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ModelError(
            f"{name} is not in UTF-8 ({error.reason} at byte {error.start}); convert it first."
        ) from error
    # Positions are those of bytes: a text of characters would shift them after the first "é".
    parser = expat.ParserCreate("utf-8")
    stack: list[Element] = []
    roots: list[Element] = []

    def opened(tag: str, attributes: Mapping[str, str]) -> None:
        start = parser.CurrentByteIndex
        # A ">" within quotes does not end the start tag.
        match = _START_TAG.match(data, start)
        end = len(data) if match is None else match.end()
        parent = stack[-1] if stack else None
        element = Element(tag, dict(attributes), start, end, parent, data[end - 2 : end] == b"/>")
        (parent.children if parent else roots).append(element)
        stack.append(element)

    def closed(tag: str) -> None:
        element = stack.pop()
        element.tail = element.head_end if element.empty else parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = opened, closed
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ModelError(f"{name} is not well-formed XML: {error}.") from error
    return roots[0]


def edit_text(data: bytes, edits: Iterable[Edit]) -> str:
    """Return the text with its edits, which must not overlap; every other byte stays."""
    out, position = [], 0
    # An insertion comes before a replacement that starts at the same byte.
    for edit in sorted(edits, key=lambda e: (e.start, e.end)):
        out += [data[position : edit.start], edit.text.encode()]
        position = edit.end
    return b"".join([*out, data[position:]]).decode("utf-8")


def edit_values(data: bytes, element: Element, values: Mapping[str, str | None]) -> Iterator[Edit]:
    """Yield edits that set attributes of an element; None removes one. New attributes come last."""
    # For each attribute the positions of the blanks before it, and of start and end of its quoted
    # value; and the position after the last one.
    spans = {}
    last = element.start + 1 + len(element.tag.encode())
    for match in _ATTRIBUTE.finditer(data, last, element.head_end):
        spans[match[1].decode()] = match.start(), *match.span(2)
        last = match.end()
    new = ""
    for key, value in values.items():
        if key in spans:
            before, start, end = spans[key]
            yield Edit(before, end, "") if value is None else Edit(start, end, quoteattr(value))
        elif value is not None:
            new += f" {key}={quoteattr(value)}"
    if new:
        yield Edit(last, last, new)


def element_edit(data: bytes, parent: Element, element: str) -> Edit:
    """Return the edit that adds `element` as the first child, indented like the others."""
    if parent.empty:
        # <tag/> becomes <tag>...</tag>; blanks before its slash are kept within the start tag.
        return Edit(parent.head_end - 2, parent.head_end, f">{element}</{parent.tag}>")
    blank = re.match(rb"\s*", data[parent.head_end : parent.tail])
    indent = blank[0].decode() if blank else ""
    if not parent.children:  # the blanks lead to the end tag, not to a child
        return Edit(parent.head_end, parent.head_end, element)
    return Edit(parent.head_end, parent.head_end, indent + element)


def values_text(*values: float) -> str:
    """Return numbers with all digits, so that they read back exactly."""
    return " ".join(repr(float(value)) for value in values)
