"""Text of an XML file as the parsers of both engines read it, more tolerant than the standard.

ROS, Pinocchio and MuJoCo read files through tinyxml2, which ignores the declaration, takes any
bytes, and ends a comment at the first "-->".
"""

import codecs
import re
from typing import Final

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
    for encoding in (*_declared(data), "utf-8"):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("latin-1")


def _declared(data: bytes) -> tuple[str, ...]:
    """Return the declared encoding where Python knows it as one of text in which ASCII is itself:
    others, as idna or unicode_escape, would change the tags."""
    found = _ENCODING.search(data[:_HEAD])
    try:
        name = codecs.lookup(found[1].decode()).name if found else ""
    except LookupError:
        return ()
    return (name,) if name.startswith(_EXTENDED_ASCII) else ()
