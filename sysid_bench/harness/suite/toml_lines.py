"""Where a key stands in a TOML text: tomllib reads values, but tells no line numbers."""

import json
import re
from collections.abc import Mapping

Key = tuple[str | int, ...]

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_BLANK = re.compile(r"[ \t\r\n]*(?:#[^\n]*[ \t\r\n]*)*")
_STRINGS = (
    re.compile(r'"""(?:[^\\]|\\.)*?"{3,5}', re.DOTALL),
    re.compile(r"'''.*?'{3,5}", re.DOTALL),
    re.compile(r'"(?:[^"\\\n]|\\.)*"'),
    re.compile(r"'[^'\n]*'"),
)
_SCALAR = re.compile(r"[^,\]}\n#]*")


def toml_line(lines: Mapping[Key, int], key: Key) -> int | None:
    """The line of `key`, or of the nearest thing around it; None where even that is absent."""
    for end in range(len(key), 0, -1):
        if key[:end] in lines:
            return lines[key[:end]]
    return None


def key_lines(text: str) -> dict[Key, int]:
    """Every key of a valid TOML text and its line (from 1), list elements by index.

    ("robot", 0, "payloads", 2) is the third payload of the first [[robot]].
    """
    return _Scanner(text).lines


class _Scanner:
    """One walk through a text that tomllib has accepted; only keys and values are told apart."""

    def __init__(self, text: str) -> None:
        self.text, self.at = text, 0
        self.lines: dict[Key, int] = {}
        self.elements: dict[Key, int] = {}  # how many [[tables]] of a name were met
        table: Key = ()
        self.blank()
        while self.at < len(text):
            if self.peek("["):
                table = self.header()
            else:
                self.pair(table)
            self.blank()

    def peek(self, mark: str) -> bool:
        return self.text.startswith(mark, self.at)

    def take(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self.text, self.at)
        if match is None:
            return ""
        self.at = match.end()
        return match[0]

    def blank(self) -> None:
        self.take(_BLANK)

    def note(self, key: Key, start: int) -> None:
        self.lines.setdefault(key, self.text.count("\n", 0, start) + 1)

    def header(self) -> Key:
        start, array = self.at, self.peek("[[")
        self.at += 2 if array else 1
        name = self.dotted()
        key: Key = ()
        for part in name[:-1]:
            key = self.last((*key, part))
        key += (name[-1],)
        self.note(key, start)
        if array:
            self.elements[key] = self.elements.get(key, 0) + 1
        key = self.last(key)
        self.note(key, start)
        self.at += 2 if array else 1
        return key

    def last(self, key: Key) -> Key:
        """[a.b] after [[a]] lies in the last element of a."""
        return (*key, self.elements[key] - 1) if key in self.elements else key

    def dotted(self) -> list[str]:
        parts = []
        while True:
            self.blank()
            parts.append(self.name())
            self.blank()
            if not self.peek("."):
                return parts
            self.at += 1

    def name(self) -> str:
        if self.peek("'"):
            return self.take(_STRINGS[3])[1:-1]
        if not self.peek('"'):
            # A text that tomllib refuses could stand still here: always move on.
            return self.take(_BARE) or self.skip_one()
        written = self.take(_STRINGS[2])
        try:
            return str(json.loads(written))
        except json.JSONDecodeError:  # an escape that TOML has and JSON has not
            return written[1:-1]

    def skip_one(self) -> str:
        self.at += 1
        return self.text[self.at - 1 : self.at]

    def pair(self, table: Key) -> None:
        start = self.at
        name = self.dotted()
        for end in range(1, len(name) + 1):
            self.note(table + tuple(name[:end]), start)
        self.at += 1  # the equals sign
        self.value(table + tuple(name))

    def value(self, key: Key) -> None:
        self.blank()
        self.note(key, self.at)
        if self.peek("["):
            self.items(key, "]")
        elif self.peek("{"):
            self.items(key, "}")
        elif not any(self.take(pattern) for pattern in _STRINGS):
            self.take(_SCALAR)

    def items(self, key: Key, end: str) -> None:
        self.at += 1
        index = 0
        self.blank()
        while self.at < len(self.text) and not self.peek(end):
            if end == "]":
                self.value((*key, index))
            else:
                self.pair(key)
            index += 1
            self.blank()
            if self.peek(","):
                self.at += 1
            self.blank()
        self.at += 1
