"""A table as LaTeX (booktabs, siunitx 3) and its numbers as macros, so that prose follows data."""

import hashlib
import sys
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from textwrap import wrap
from typing import Final

from sysid_bench.reporting.notation import Notation
from sysid_bench.reporting.tables import Entry, Key, Table

_ESCAPES: Final = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#",
    "%": r"\%", "_": r"\_", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"{\char34}",
    "`": r"\textasciigrave{}", "[": "{[}", "]": "{]}", "*": "{*}",
    "\N{EN DASH}": r"\textendash{}", "\N{EM DASH}": r"\textemdash{}",
}  # fmt: skip
_SYMBOLS: Final = {
    "\N{DEGREE SIGN}": r"^\circ", "\N{MIDDLE DOT}": r"\cdot", "\N{PLUS-MINUS SIGN}": r"\pm",
    "\N{DOWNWARDS ARROW}": r"\downarrow", "\N{UPWARDS ARROW}": r"\uparrow",
    "\N{MULTIPLICATION SIGN}": r"\times", "\N{MINUS SIGN}": "-", "\N{MICRO SIGN}": r"\mu",
    "\N{GREEK SMALL LETTER ALPHA}": r"\alpha", "\N{GREEK SMALL LETTER BETA}": r"\beta",
    "\N{GREEK SMALL LETTER THETA}": r"\theta", "\N{GREEK SMALL LETTER MU}": r"\mu",
    "\N{GREEK SMALL LETTER SIGMA}": r"\sigma", "\N{GREEK SMALL LETTER TAU}": r"\tau",
}  # fmt: skip
_UNITS: Final = {
    "N": r"\newton", "m": r"\metre", "kg": r"\kilogram", "s": r"\second", "rad": r"\radian",
}  # fmt: skip
_NEW_LINE: Final = r" \\ "
_WIDEST_IN_ONE_COLUMN: Final = 4
_HEAD_LETTERS: Final = 16
"""Letters in a line of the head of a metric; its title and unit make several lines."""

_DIGIT_WORDS: Final = (
    "Zero", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine",
)  # fmt: skip


@dataclass(frozen=True)
class Origin:
    """Origin of the numbers: the run, a hash of its suite, the command that prints them."""

    run: str
    suite_hash: str
    command: str


def to_latex(table: Table, origin: Origin) -> str:
    """A `table` float. Needs booktabs and siunitx; no other package."""
    layout = [_lay_out(table, column) for column in table.columns]
    body = "\n".join(_rows(table, layout))
    notes = [rf"\textsuperscript{{{mark}}}\,{escape(n)}" for n, mark in table.note_labels.items()]
    notes += [escape(note) for note in table.notes]
    float_, size = _fit(sum(column.width for column in layout))
    below = "".join(f"\n\n\\smallskip\n{{\\footnotesize {note}\\par}}" for note in notes)
    return (
        f"{origin_text(origin)}\\begin{{{float_}}}\n\\centering\n{size}"
        f"\\caption{{{escape(table.title)}. {_caption(table)}}}\n"
        f"\\label{{tab:{label_name(table.name)}}}\n\\smallskip\n"
        # siunitx sets bold numbers in medium weight without detect-weight.
        "\\sisetup{detect-weight=true}\n"
        f"\\begin{{tabular}}{{@{{}}{'l' * len(table.row_fields)}"
        f"{''.join(column.spec for column in layout)}@{{}}}}\n\\toprule\n"
        f"{_heads(table, layout)}\\midrule\n{body}\n\\bottomrule\n\\end{{tabular}}{below}\n"
        f"\\end{{{float_}}}\n"
    )


def _fit(width: int) -> tuple[str, str]:
    """The float and the type size for so many columns; `table*` spans both columns of a paper."""
    if width <= _WIDEST_IN_ONE_COLUMN:
        return "table", ""
    size = "\\footnotesize" if width < 2 * _WIDEST_IN_ONE_COLUMN else "\\scriptsize"
    return "table*", f"{size}\\setlength{{\\tabcolsep}}{{3pt}}\n"


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
        f"\\newcommand{{\\{name}}}{{{_inline(style, entry)}}}"
        for name, (_, style, entry) in zip(names, entries, strict=True)
    ]
    return origin_text(origin) + "\n".join(lines) + "\n"


def names_of_macros(keys: Sequence[tuple[str, ...]]) -> list[str]:
    """A macro name of letters for each key; different keys never share one."""
    plain = ["sid" + "".join(map(_camel, key)) for key in keys]
    shared = Counter(plain)
    return [
        name + (_hash_letters(key) if shared[name] > 1 else "")
        for name, key in zip(plain, keys, strict=True)
    ]


def escape(text: str) -> str:
    """Any text as LaTeX that prints as it is; letters beyond Latin-1 as their code, [U+4E2D]."""
    printed = "".join(_escaped(c) for c in " ".join(str(text).split()))
    return printed.replace("--", "-{}-")  # two hyphens would print as a dash


def _escaped(c: str) -> str:
    if c in _ESCAPES:
        return _ESCAPES[c]
    if c in _SYMBOLS:
        return rf"\ensuremath{{{_SYMBOLS[c]}}}"
    if " " <= c <= "~":
        return c
    plain = unicodedata.normalize("NFKD", c)
    # Accented Latin letters are in every T1 font; the rest would stop the compiler.
    if "\u00c0" <= c <= "\u00ff" and len(plain) > 1:
        return c
    return f"{{[}}U+{ord(c):04X}{{]}}"


@dataclass(frozen=True)
class _Column:
    """One column of numbers and, where something follows the numbers, one of text next to it."""

    key: Key
    style: Notation
    format: str
    has_text: bool

    @property
    def spec(self) -> str:
        return f"S[table-format={self.format}]" + ("@{\\,}l" if self.has_text else "")

    @property
    def width(self) -> int:
        return 2 if self.has_text else 1


def _lay_out(table: Table, column: Key) -> _Column:
    style = table.column_notation[column]
    entries = [entry for key, entry in table.entries.items() if key[1] == column]
    texts = [style.text(entry.value) for entry in entries if entry.value is not None]
    has_text = any(entry.note or entry.low is not None for entry in entries)
    return _Column(column, style, _table_format(texts), has_text)


def _cell(table: Table, column: _Column, entry: Entry | None) -> str:
    number, after = "{--}", ""
    if entry is not None and entry.value is not None:
        number = ("\\bfseries " if entry.best else "") + column.style.text(entry.value)
    elif entry is not None and entry.label:
        number = f"{{{escape(entry.label)}}}"
    if entry is not None and entry.low is not None and entry.high is not None:
        after = _between(column.style.text(entry.low), column.style.text(entry.high))
    if entry is not None and entry.note:
        after += rf"\textsuperscript{{{table.note_labels[entry.note]}}}"
    return f"{number} & {after}" if column.has_text else number


def _between(low: str, high: str) -> str:
    """The interval in small type; a power of ten that both ends share is written once."""
    (low_digits, _, power), (high_digits, _, other) = low.partition("e"), high.partition("e")
    if power and power == other:
        inner = f"[\\num{{{low_digits}}}, \\num{{{high_digits}}}]\\,\\num{{e{power}}}"
    else:
        inner = f"[\\num{{{low}}}, \\num{{{high}}}]"
    return f"{{\\scriptsize {inner}}}"


def _table_format(texts: Sequence[str]) -> str:
    """siunitx table-format: sign, digits before and after the point, digits of the exponent."""
    parts = [text.partition("e") for text in texts] or [("0", "", "")]
    sign = "-" if any(mantissa.startswith("-") for mantissa, _, _ in parts) else ""
    digits = [mantissa.lstrip("-").partition(".") for mantissa, _, _ in parts]
    whole, decimals = (max(len(part[i]) for part in digits) for i in (0, 2))
    exponents = [exponent for _, _, exponent in parts if exponent]
    power = ""
    if exponents:
        minus = "-" if any(e.startswith("-") for e in exponents) else ""
        power = f"e{minus}{max(len(e.lstrip('-')) for e in exponents)}"
    return f"{sign}{whole}.{decimals}{power}"


def _heads(table: Table, layout: Sequence[_Column]) -> str:
    """One line per column field; equal neighbours share a heading."""
    fields, depth = [escape(name) for name in table.row_fields], len(table.column_fields)
    if depth == 0:
        return _line([*fields, _spanning(layout, table.metric.title)])
    lines = ""
    for level in range(depth - 1):
        groups = _grouped(layout, level)
        names = [_spanning(group, group[0].key[level]) for group in groups]
        lines += _line([""] * len(fields) + names) + _rules(groups, len(fields) + 1)
    heads = [(c, table.column_labels(c.key)[-1]) for c in layout]
    width = _HEAD_LETTERS if table.has_metric_columns else sys.maxsize
    return lines + _line([*fields, *(_spanning([c], head, width) for c, head in heads)])


def _grouped(layout: Sequence[_Column], level: int) -> list[list[_Column]]:
    return [list(group) for _, group in groupby(layout, key=lambda c: c.key[: level + 1])]


def _line(parts: Sequence[str]) -> str:
    return " & ".join(parts) + " \\\\\n"


def _spanning(columns: Sequence[_Column], text: str, letters: int = sys.maxsize) -> str:
    """A head over columns, in lines of at most so many letters."""
    lines = [escape(line) for line in wrap(text, letters, break_long_words=False)] or [""]
    # Not r"\shortstack" around a single line: its baseline would differ from the other heads.
    head = lines[0] if len(lines) == 1 else rf"\shortstack{{{_NEW_LINE.join(lines)}}}"
    return f"\\multicolumn{{{sum(c.width for c in columns)}}}{{c}}{{{head}}}"


def _rules(groups: Sequence[Sequence[_Column]], first: int) -> str:
    rules = []
    for group in groups:
        last = first + sum(column.width for column in group) - 1
        rules.append(f"\\cmidrule(lr){{{first}-{last}}}")
        first = last + 1
    return "".join(rules) + "\n"


def _rows(table: Table, layout: Sequence[_Column]) -> list[str]:
    """Body lines; a label that repeats the line above is left out, groups stand apart."""
    lines: list[str] = []
    above: Key = ("",) * len(table.row_fields)
    for row in table.rows:
        if lines and len(row) > 1 and row[0] != above[0]:
            lines.append("\\addlinespace")
        fresh = [lines == [] or row[: i + 1] != above[: i + 1] for i in range(len(row))]
        names = [escape(part) if new else "" for part, new in zip(row, fresh, strict=True)]
        numbers = [_cell(table, column, table.entry(row, column.key)) for column in layout]
        lines.append(_line([*names, *numbers]).rstrip())
        above = row
    return lines


def _caption(table: Table) -> str:
    if table.own_caption or table.has_metric_columns:
        return escape(table.caption)
    units = [f"\\unit{{{''.join(_UNITS.get(u, u) for u in unit.split())}}}"
             for unit in table.metric.units]  # fmt: skip
    unit = f" ({', '.join(units)})" if units else ""
    rest = table.caption.removeprefix(table.metric.heading)
    return f"{escape(table.metric.title)}{unit}{escape(rest)}"


def _inline(style: Notation, entry: Entry | None) -> str:
    if entry is None or (entry.value is None and not entry.label):
        return "--"
    if entry.value is None:
        return rf"\textit{{{escape(entry.label)}}}"
    return f"\\num{{{style.text(entry.value)}}}"


def origin_text(origin: Origin) -> str:
    pairs = (("run", origin.run), ("suite", origin.suite_hash), ("made by", origin.command))
    return "".join(f"% {name}: {' '.join(text.split())}\n" for name, text in pairs)


def label_name(text: str) -> str:
    spelled = "".join(_DIGIT_WORDS[int(c)] if c in "0123456789" else c for c in text)
    return "".join(c for c in spelled if c.isascii() and (c.isalpha() or c == "-"))


def _camel(text: str) -> str:
    words = "".join(c if c.isascii() and c.isalnum() else " " for c in text).split()
    return label_name("".join(word[0].upper() + word[1:] for word in words))


def _hash_letters(key: tuple[str, ...]) -> str:
    digest = hashlib.sha256("\0".join(key).encode("utf-8", "surrogatepass")).digest()
    return "X" + "".join(chr(ord("a") + byte % 26) for byte in digest[:6])
