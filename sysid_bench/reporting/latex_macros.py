"""Numbers of tables as LaTeX macros, so that prose follows data."""

import hashlib
import re
from collections import Counter
from collections.abc import Sequence

from sysid_bench.reporting.latex import Origin, origin_text
from sysid_bench.reporting.latex_text import escape, label_name
from sysid_bench.reporting.notation import Notation
from sysid_bench.reporting.tables import NO_ENTRY, Entry, Table


def to_macros(tables: Sequence[Table], origin: Origin) -> str:
    """`numbers.tex`: one \\newcommand per entry, \\sid<Table><Row><Column>, letters only.

    Digits are spelled; names that would fall together get letters from a hash of their labels.
    """
    entries = [
        ((table.name, *row, *column), table.column_notation[column], table.entry(row, column))
        for table in tables
        for row, column in table.indices
    ]
    names = names_of_macros([labels for labels, _, _ in entries])
    lines = [
        f"\\newcommand{{\\{name}}}{{{_inline(style, entry or NO_ENTRY)}}}"
        for name, (_, style, entry) in zip(names, entries, strict=True)
    ]
    return origin_text(origin) + "\n".join(lines) + "\n"


def names_of_macros(keys: Sequence[tuple[str, ...]]) -> list[str]:
    """A macro name of letters for each key; different keys never share one."""
    plain = ["sid" + "".join(map(_camel, key)) for key in keys]
    shared = Counter(plain)
    return [
        name if shared[name] == 1 else name + _hash_letters(key)
        for name, key in zip(plain, keys, strict=True)
    ]


def _camel(text: str) -> str:
    words = re.split("[^A-Za-z0-9]+", text)
    return label_name("".join(word[:1].upper() + word[1:] for word in words))


def _hash_letters(key: tuple[str, ...]) -> str:
    digest = hashlib.sha256("\0".join(key).encode("utf-8", "surrogatepass")).digest()
    return "X" + "".join(chr(ord("a") + byte % 26) for byte in digest[:6])


def _inline(style: Notation, entry: Entry) -> str:
    """A number, or the words instead of it in italics."""
    if entry.value is not None:
        return f"\\num{{{style.text(entry.value)}}}"
    return rf"\textit{{{escape(entry.label)}}}" if entry.label else "--"
