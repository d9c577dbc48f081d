"""Seeded damage to a file: bytes, words, keys, numbers, nesting, encodings, and what it is."""

import os
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

_WORD: Final = re.compile(rb"""\s+|"[^"\n]*"|'[^'\n]*'|[-+]?[\d.]+(?:[eE][-+]?\d+)?|\w+|.""", re.S)
_NUMBER: Final = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")
_QUOTED: Final = re.compile(rb'"[^"\n]*"')
_VALUES: Final = (
    *(b"0", b"-1", b"1e308", b"-1e308", b"1e-320", b"1e999", b"nan", b"-inf", b"inf", b"1e9"),
    *(b"9223372036854775808", b"9" * 400, b"3.5", b"true", b"null", b'""', b"''", b'"\\u0000"'),
    *(b"[]", b"{}", b"[[]]", b"[1, 'a']", b"abc", b"../../x", b"/dev/zero", b"file:x.py:Y", b"="),
    *(b"-", b"#", b",", b'"', b"]", b"[", b"<", b">", b"&amp;", b"%s", b"{0}", b"\\", b"1_000"),
    "é∞½".encode(),
    b"1970-01-01T00:00:00Z",
)
_BYTES: Final = (b"\0", b"\xff", b"\xc3", b"\r", b"\n", b"\x1b[31m", b"\xef\xbb\xbf", b"\x7f", b"'")

Mutation = Callable[[bytes, random.Random], bytes]


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return the data with one to three mutations."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data = rng.choice(MUTATIONS)(data, rng)
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    """Change some bits; half of the time near the start, where headers are."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8)) if data else 0):
        end = rng.choice((len(changed), min(len(changed), 200)))
        changed[rng.randrange(end)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    """Replace 1, 2, 4 or 8 bytes by the largest numbers: lengths, offsets, sizes."""
    size = rng.choice((1, 2, 4, 8))
    place = rng.randrange(max(len(data) - size, 1))
    number = rng.choice((b"\xff" * size, b"\0" * size, b"\x7f" + b"\xff" * (size - 1)))
    return data[:place] + number + data[place + size :]


def _truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _cut_out(data: bytes, rng: random.Random) -> bytes:
    first, last = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:first] + data[min(last, first + 100) :]


def _insert(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + rng.choice(_BYTES) + data[place:]


def _replace_match(pattern: re.Pattern[bytes]) -> Mutation:
    """Mutation that replaces something in the text by a value of another kind or size."""

    def replace(data: bytes, rng: random.Random) -> bytes:
        found = list(pattern.finditer(data))
        if not found:
            return _insert(data, rng)
        match, value = rng.choice(found), rng.choice(_VALUES)
        if match[0].startswith(b'"') and rng.random() < 0.7:  # within its quotes
            value = b'"' + value.replace(b'"', b"") + b'"'
        return data[: match.start()] + value + data[match.end() :]

    return replace


def _change_words(data: bytes, rng: random.Random) -> bytes:
    """Remove, double or exchange words."""
    words = _WORD.findall(data)
    places = [i for i, word in enumerate(words) if word.strip()]
    if not places:
        return data
    one, other = rng.choice(places), rng.choice(places)
    match rng.randrange(3):
        case 0:
            words[one] = b""
        case 1:
            words[one] = words[one] * rng.choice((2, 3, 1000))
        case _:
            words[one], words[other] = words[other], words[one]
    return b"".join(words)


def _change_lines(data: bytes, rng: random.Random) -> bytes:
    """Remove, double or exchange lines: keys, rows, elements."""
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    one, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(3):
        case 0:
            del lines[one]
        case 1:
            lines.insert(other, lines[one])
        case _:
            lines[one], lines[other] = lines[other], lines[one]
    return b"".join(lines)


def _nest(data: bytes, rng: random.Random) -> bytes:
    """Insert deep brackets, elements or signs."""
    depth = rng.choice((50, 2000, 100_000))
    start, end = rng.choice(
        ((b"[", b"]"), (b"{ a = ", b" }"), (b"(", b")"), (b"<a>", b"</a>"), (b"-", b""))
    )
    found = list(_NUMBER.finditer(data)) or list(_QUOTED.finditer(data))
    place = rng.choice(found).start() if found else 0
    return data[:place] + start * depth + rng.choice((b"", end * depth)) + data[place:]


def _recode(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("utf-8", errors="replace")
    return text.encode(rng.choice(("utf-16", "utf-32", "latin-1", "utf-8-sig")), errors="replace")


MUTATIONS: Final[tuple[Mutation, ...]] = (
    *(_flip, _overwrite, _truncate, _cut_out, _insert, _change_words, _change_lines),
    *(_nest, _recode),
    *(_replace_match(_NUMBER), _replace_match(_NUMBER)),
    *(_replace_match(_QUOTED), _replace_match(_WORD)),
)


def replaced(path: Path, rng: random.Random) -> None:
    """Put something else than a regular file in the place of a file."""
    path.unlink()
    rng.choice(PLACES)(path)


def _link(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def _sparse(path: Path) -> None:
    """1.5 GB that occupy no disk, more than reading may add to the memory."""
    with path.open("wb") as file:
        file.truncate(15 * 10**8)


PLACES: Final[tuple[Callable[[Path], None], ...]] = (
    Path.mkdir,
    _link("absent"),
    lambda path: path.symlink_to(path.name),  # a loop
    *(_link("/dev/zero"), _link("/dev/null"), _link("/proc/self/mem")),
    os.mkfifo,  # waits for a writer for ever
    _sparse,
    Path.touch,
    lambda path: None,  # absent
)
