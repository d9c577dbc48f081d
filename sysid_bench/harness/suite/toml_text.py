"""TOML texts: plain data as TOML, and the line numbers of keys, which tomllib does not report."""

import json
import re
from collections.abc import Mapping
from itertools import starmap
from typing import Any

from sysid_bench.errors import UsageError

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(data: Mapping[str, Any]) -> str:
    """Return TOML of a mapping; keys with the value None are left out, tuples become arrays."""
    data = _without_none(data)
    sections = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            sections[key] = f"[{_key(key)}]", [value]
        elif isinstance(value, list) and value and all(isinstance(x, Mapping) for x in value):
            sections[key] = f"[[{_key(key)}]]", value
    lines = [_pair(key, value) for key, value in data.items() if key not in sections]
    for heading, tables in sections.values():
        for table in tables:
            lines += ["", heading, *starmap(_pair, table.items())]
    return "\n".join(lines) + "\n"


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        # A key with None, or with a sweep of None alone, was not written.
        kept = (
            (key, x) for key, x in value.items() if x is not None and x not in ([None], (None,))
        )
        return {key: _without_none(inner) for key, inner in kept}
    if isinstance(value, (list, tuple)):
        return [_without_none(inner) for inner in value]
    return value


def _pair(key: str, value: Any) -> str:
    return f"{_key(key)} = {_value(value)}"


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def _text(text: str) -> str:
    # JSON strings are TOML strings, but for DEL, which JSON does not escape.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    # Before numbers: True is an int.
    if isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(starmap(_pair, value.items())) + " }" if value else "{}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    raise UsageError(
        f"{value!r} ({type(value).__name__}) cannot be written in a suite; use a string."
    )


Key = tuple[str | int, ...]

_BLANK = re.compile(r"[ \t\r\n]*(?:#[^\n]*[ \t\r\n]*)*")
_QUOTED = re.compile(r'"(?:[^"\\\n]|\\.)*"')
_LITERAL = re.compile(r"'[^'\n]*'")
_VALUES = (
    re.compile(r'"""(?:[^\\]|\\.)*?"{3,5}', re.DOTALL),
    re.compile(r"'''.*?'{3,5}", re.DOTALL),
    _QUOTED,
    _LITERAL,
    re.compile(r"[^,\]}\n#]*"),
)


def toml_line(lines: Mapping[Key, int], key: Key) -> int | None:
    """Return the line of `key`, or of the nearest table around it; None where both are absent."""
    ends = range(len(key), 0, -1)
    return next((lines[key[:end]] for end in ends if key[:end] in lines), None)


def key_lines(text: str) -> dict[Key, int]:
    """Return every key of a valid TOML text with its line (from 1), list elements by index.

    ("robot", 0, "payloads", 2) is the third payload of the first [[robot]].
    """
    return _Scanner(text).lines


class _Scanner:
    """One pass through a text that tomllib has accepted, which separates keys from values."""

    def __init__(self, text: str) -> None:
        self.text, self.position = text, 0
        self.lines: dict[Key, int] = {}
        self.elements: dict[Key, int] = {}  # number of [[tables]] of a name so far
        table: Key = ()
        self.take(_BLANK)
        while self.position < len(text):
            if self.peek("["):
                table = self.header()
            else:
                self.pair(table)
            self.take(_BLANK)

    def peek(self, mark: str) -> bool:
        return self.text.startswith(mark, self.position)

    def take(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self.text, self.position)
        if match is None:
            return ""
        self.position = match.end()
        return match[0]

    def note(self, key: Key, start: int) -> None:
        # The first line of a key: a table whose parts are apart is reported at its beginning.
        self.lines.setdefault(key, self.text.count("\n", 0, start) + 1)

    def header(self) -> Key:
        start, size = self.position, 2 if self.peek("[[") else 1
        self.position += size
        *outer, name = self.dotted()
        key: Key = ()
        for part in outer:
            key = self.last((*key, part))
        key += (name,)
        self.note(key, start)
        if size == 2:
            self.elements[key] = self.elements.get(key, 0) + 1
        key = self.last(key)
        self.note(key, start)
        self.position += size
        return key

    def last(self, key: Key) -> Key:
        """Return the key of the last element: [a.b] after [[a]] belongs to it."""
        return (*key, self.elements[key] - 1) if key in self.elements else key

    def dotted(self) -> list[str]:
        names = []
        while True:
            self.take(_BLANK)
            if self.peek("'"):
                names.append(self.take(_LITERAL)[1:-1])
            elif self.peek('"'):
                written = self.take(_QUOTED)
                try:
                    names.append(str(json.loads(written)))
                except json.JSONDecodeError:  # an escape of TOML that JSON lacks
                    names.append(written[1:-1])
            else:
                names.append(self.take(_BARE))
            self.take(_BLANK)
            if not self.peek("."):
                return names
            self.position += 1

    def pair(self, table: Key) -> None:
        start = self.position
        key = table
        for name in self.dotted():
            key += (name,)
            self.note(key, start)
        self.position += 1  # the equals sign
        self.value(key)

    def value(self, key: Key) -> None:
        self.take(_BLANK)
        self.note(key, self.position)
        if self.peek("["):
            self.items(key, "]")
        elif self.peek("{"):
            self.items(key, "}")
        else:
            # The first that matches, longer quotes before shorter ones: '""' begins '"""'.
            any(self.take(pattern) for pattern in _VALUES)

    def items(self, key: Key, end: str) -> None:
        self.position += 1
        index = 0
        self.take(_BLANK)
        while self.position < len(self.text) and not self.peek(end):
            if end == "]":
                self.value((*key, index))
            else:
                self.pair(key)
            index += 1
            self.take(_BLANK)
            if self.peek(","):
                self.position += 1
            self.take(_BLANK)
        self.position += 1
