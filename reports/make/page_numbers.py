"""Numbers in the sentences of a page: each is bound to a cell of a table of the page, or given.

`0.71<!-- is: TITLE | ROW | COLUMN -->` binds the number before it: words of the bold line above
the table, of the first columns of the row, and of the head of the column, as far as they are needed
to find one cell, and `#2` for the second number of the cell, as an end of an interval;
`<!-- is: text WORDS -->` binds it to the number after these words in what a
command printed. `<!-- given: 10 95 95 -->` lists all numbers that are settings or published ones,
each as often as it is written. Numbers in code, in years of publications and as words are not
looked at.
"""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

PART: Final = re.compile(r"<!-- made by: (.*?) -->\n(.*?)<!-- end -->", re.DOTALL)
_GIVEN: Final = re.compile(r"<!-- given: (.*?) -->", re.DOTALL)
_NUMBER: Final = r"(?<![\w./#-])[-−]?\d+(?:[.,]\d+)*(?:e[+-]?\d+)?(?!\d)"
_BOUND: Final = re.compile(rf"({_NUMBER})((?: ?(?:%|°|\w{{1,3}}))?)<!-- is: (.*?) -->", re.DOTALL)
_NOT_SENTENCES: Final = (
    re.compile(r"```.*?```", re.DOTALL),
    re.compile(r"`[^`]*`"),
    re.compile(r"\]\([^)]*\)"),
    re.compile(r"\b20\d\d-\d\d-\d\d\b"),
    re.compile(r"(?<=[a-z.,] )(?:19|20)\d\d(?=[);,])|\((?:19|20)\d\d\)"),  # "(Gautier 1997)"
    re.compile(r"\bcommit [0-9a-f]{7,40}\b"),
    re.compile(r"<!--.*?-->", re.DOTALL),
)


@dataclass(frozen=True)
class Cell:
    """A cell of a table: title, words of its row and of its column, and its text."""

    title: str
    row: str
    column: str
    text: str

    @property
    def numbers(self) -> list[str]:
        """All numbers of the cell."""
        return re.findall(_NUMBER, self.text.replace("\\[", " ").replace("**", ""))

    def has(self, words: Sequence[str]) -> bool:
        """True for the cell of an address "TITLE | ROW | COLUMN", or "ROW | COLUMN"."""
        own = (self.title, self.row, self.column)
        return all(word in place for word, place in zip(words[::-1], own[::-1], strict=False))


def problems(text: str) -> list[str]:
    """Faults of the numbers in the sentences of a page."""
    found = list[str]()
    cells = list(table_cells(text))
    printed = "\n".join(part[2] for part in PART.finditer(text))
    sentences = PART.sub("", text)
    given = Counter(" ".join(_GIVEN.findall(sentences)).split())
    for number, _, address in _BOUND.findall(sentences):
        if said := _difference(number, " ".join(address.split()), cells, printed):
            found.append(f"{number} is bound to '{address}': {said}")
    sentences = _BOUND.sub("", sentences)
    for pattern in _NOT_SENTENCES:
        sentences = pattern.sub(" ", sentences)
    for line in sentences.splitlines():
        for number in re.findall(_NUMBER, line):
            if given[number] > 0:
                given[number] -= 1
                continue
            near = [f"{c.row} | {c.column}" for c in cells if _is(number, c.numbers)][:3]
            hint = f"; cells with it: {near}" if near else ""
            found.append(f"{number} is bound to no cell and not given: '{line.strip()}'{hint}")
    found += [f"{number} is given {count} times too often" for number, count in (+given).items()]
    return found


def table_cells(text: str) -> Iterator[Cell]:
    """Yield the cells of the tables in made parts."""
    for part in PART.finditer(text):
        title, head = "", list[str]()
        for line in part[2].splitlines():
            if line.startswith("**"):
                title, head = line.strip("* "), []
            elif not line.startswith("|"):
                head = []
            elif not head:
                head = _split(line)
            elif set(line) - set("|-: "):
                values = _split(line)
                row = " ".join(value for value in values if not re.fullmatch(_NUMBER, value))
                for column, value in zip(head, values, strict=False):
                    yield Cell(title, row, column, value)


def _split(line: str) -> list[str]:
    return [value.strip() for value in line.strip("|").split("|")]


def _difference(number: str, address: str, cells: Sequence[Cell], printed: str) -> str:
    """Why a bound number does not stand; "" where it does."""
    if address.startswith("text "):
        words = address.removeprefix("text ")
        after = printed.split(words)[1:]
        values = [re.findall(_NUMBER, rest)[:1] for rest in after]
        if len(after) != 1:
            return f"these words are printed {len(after)} times"
        return "" if _is(number, values[0]) else f"{values[0]} is printed there"
    address, _, place = address.partition(" #")
    words_of = [word.strip() for word in address.split("|")]
    fit = [cell for cell in cells if cell.has(words_of)]
    if len(fit) != 1:
        return f"{len(fit)} cells have these words"
    index = int(place or 1) - 1
    return "" if _is(number, fit[0].numbers[index : index + 1]) else f"the cell is '{fit[0].text}'"


def _is(number: str, values: Sequence[str]) -> bool:
    """True where one of the values, rounded to the digits of the number, is the number."""
    plain = number.replace(",", "").replace("−", "-")
    mantissa, _, exponent = plain.partition("e")
    digits = len(mantissa.partition(".")[2])
    unit = 10.0 ** (int(exponent or 0) - digits)
    wanted = float(plain)
    known = [float(value.replace(",", "").replace("−", "-")) for value in values]
    # A value that rounds to zero has no digit that could be wrong.
    return any(
        abs(one - wanted) <= 0.5 * unit * (1 + 1e-9) and (wanted != 0 or one == 0) for one in known
    )
