"""Tables as LaTeX, and their numbers as macros, so that prose follows data."""

import hashlib
import math
import re
import sys
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby, pairwise
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.reporting.selection import Choose, select_rows
from sysid_bench.reporting.table_entries import statistic_of
from sysid_bench.reporting.tables import NO_ENTRY, Entry, Key, Notation, Table, notation
from sysid_bench.types import Metric

if TYPE_CHECKING:
    import pandas as pd


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
# Accented Latin letters are in every T1 font; letters beyond would stop the compiler.
_ACCENTED: Final = [c for c in map(chr, range(0xC0, 0x100)) if unicodedata.decomposition(c)]
_PRINTED: Final = {
    **{c: c for c in (*map(chr, range(ord(" "), ord("~") + 1)), *_ACCENTED)},
    **{c: rf"\ensuremath{{{symbol}}}" for c, symbol in _SYMBOLS.items()},
    **_ESCAPES,
}
_DIGIT_WORDS: Final = (
    "Zero", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine",
)  # fmt: skip
_SPELLED: Final = dict(zip(map(ord, "0123456789"), _DIGIT_WORDS, strict=True))


def latex_text(text: str) -> str:
    """Any text as LaTeX that prints as it is; letters beyond Latin-1 as their code, [U+4E2D]."""
    one_line = " ".join(str(text).split())
    printed = "".join(_PRINTED.get(c, f"{{[}}U+{ord(c):04X}{{]}}") for c in one_line)
    return printed.replace("--", "-{}-")  # two hyphens would print as a dash


def label_name(text: str) -> str:
    """Letters and hyphens of a name, with its digits spelled: LaTeX allows no others in a name."""
    return re.sub("[^A-Za-z-]", "", text.translate(_SPELLED))


_UNITS: Final = {
    "N": r"\newton", "m": r"\metre", "kg": r"\kilogram", "s": r"\second", "rad": r"\radian",
    "mm": r"\milli\metre", "%": r"\percent",
}  # fmt: skip
_NEW_LINE: Final = r" \\ "
_WIDEST_IN_ONE_COLUMN: Final = 4
BOX: Final = "\\setbox0=\\hbox{"
FITTED: Final = (
    "}\n\\ifdim\\wd0>\\linewidth\\ifdefined\\resizebox"
    "\\resizebox{\\linewidth}{!}{\\box0}\\else\\leavevmode\\box0\\fi\\else\\leavevmode\\box0\\fi"
)
"""A box around a tabular, which shrinks to the width of its column where it is wider."""

_HEAD_LETTERS: Final = 16
"""Letters in a line of the head of a metric; its title and unit make several lines."""


@dataclass(frozen=True)
class Origin:
    """Origin of the numbers: the run, a hash of its suite, the command that prints them, and a
    note on rows of other code ("")."""

    run: str
    suite_hash: str
    command: str
    note: str = ""


@dataclass(frozen=True)
class _Column:
    """One column of numbers and, where something follows the numbers, one of text next to it."""

    key: Key
    style: Notation
    format: str
    has_text: bool
    power: int | None  # of ten, that all numbers of the column share

    def text(self, value: float) -> str:
        """A number of the column, without the power in its head."""
        return self.style.text(value if self.power is None else value / 10.0**self.power)

    @property
    def spec(self) -> str:
        return f"S[table-format={self.format}]" + ("@{\\,}l" if self.has_text else "")


def to_latex(table: Table, origin: Origin) -> str:
    """A `table` float. Needs booktabs and siunitx; a table wider than its column is made smaller
    where graphicx is loaded."""
    layout = [_lay_out(table, column) for column in table.columns]
    # A field is text (l); numbers align at their points (S).
    columns = "l" * len(table.row_fields) + "".join(column.spec for column in layout)
    float_, size, width = "table", "", _width(layout)
    if width > _WIDEST_IN_ONE_COLUMN:
        # `table*` spans both columns of a paper.
        letters = "footnotesize" if width < 2 * _WIDEST_IN_ONE_COLUMN else "scriptsize"
        float_, size = "table*", f"\\{letters}\\setlength{{\\tabcolsep}}{{3pt}}\n"
    marked = [rf"\textsuperscript{{{m}}}\,{latex_text(n)}" for n, m in table.note_labels.items()]
    return (
        f"{origin_text(origin)}\\begin{{{float_}}}\n\\centering\n{size}"
        f"\\caption{{{latex_text(table.title)}. {_caption(table, layout)}}}\n"
        f"\\label{{tab:{label_name(table.name)}}}\n\\smallskip\n"
        # siunitx sets bold numbers in medium weight without detect-weight, and parts 0.005 66.
        "\\sisetup{detect-weight=true,group-minimum-digits=99}\n"
        f"{BOX}\\begin{{tabular}}{{@{{}}{columns}@{{}}}}\n\\toprule\n"
        f"{_heads(table, layout)}\\midrule\n{_body(table, layout)}\\bottomrule\n"
        f"\\end{{tabular}}{FITTED}{notes_text([*marked, *map(latex_text, table.notes)])}\n"
        f"\\end{{{float_}}}\n"
    )


def origin_text(origin: Origin) -> str:
    """The origin as comments above a table."""
    pairs = (("run", origin.run), ("suite", origin.suite_hash), ("made by", origin.command))
    lines = [f"% {name}: {' '.join(text.split())}\n" for name, text in pairs]
    return "".join([*lines, f"% {origin.note}\n" if origin.note else ""])


def notes_text(notes: Sequence[str]) -> str:
    """Notes (LaTeX) in small type, a paragraph each."""
    return "".join(f"\n\n\\smallskip\n{{\\footnotesize {note}\\par}}" for note in notes)


def _width(columns: Sequence[_Column]) -> int:
    """Number of LaTeX columns."""
    return len(columns) + sum(column.has_text for column in columns)


def _lay_out(table: Table, column: Key) -> _Column:
    entries = [entry for key, entry in table.entries.items() if key[1] == column]
    shared = table.column_notation[column]
    if shared.scientific and shared.scale is None:
        # Where the columns differ by decades, one of them may need none, or share a power.
        own = notation([entry.value for entry in entries], shared.digits)
        shared = shared if own.scientific and own.scale is None else own
    has_text = any(entry.low is not None or entry.note for entry in entries)
    plain = _Column(column, shared.without_scale(), "", has_text, shared.scale)
    return replace(plain, format=_column_format(plain, entries))


def _column_format(column: _Column, entries: Sequence[Entry]) -> str:
    """siunitx table-format: sign, digits before and after the point, digits of the exponent."""
    texts = [column.text(entry.value) for entry in entries if entry.value is not None] or ["0"]
    numbers = [text.partition("e") for text in texts]
    mantissas = [mantissa.partition(".") for mantissa, _, _ in numbers]
    exponents = [exponent for _, _, exponent in numbers]
    power = f"e{_digit_format(exponents)}" if any(exponents) else ""
    decimals = max(len(after) for _, _, after in mantissas)
    return f"{_digit_format([before for before, _, _ in mantissas])}.{decimals}{power}"


def _digit_format(numbers: Sequence[str]) -> str:
    """Sign, where one of the whole numbers has it, and digits of the longest."""
    sign = "-" if any("-" in number for number in numbers) else ""
    return f"{sign}{max(len(number.lstrip('-')) for number in numbers)}"


def _heads(table: Table, layout: Sequence[_Column]) -> str:
    """One line per column field; equal neighbours share a heading, with a rule below it."""
    fields = list(map(latex_text, table.row_fields))
    if not table.column_fields:
        return table_line([*fields, _spanning(layout, table.metric.title)])
    lines = ""
    for level in range(len(table.column_fields) - 1):
        groups = [list(group) for _, group in groupby(layout, key=lambda c: c.key[: level + 1])]
        names = [_spanning(group, group[0].key[level]) for group in groups]
        lines += table_line([""] * len(fields) + names)
        first = len(fields) + 1
        for group in groups:
            lines += f"\\cmidrule(lr){{{first}-{first + _width(group) - 1}}}"
            first += _width(group)
        lines += "\n"
    width = _HEAD_LETTERS if table.has_metric_columns else sys.maxsize
    has_own_powers = len({column.power for column in layout}) > 1
    lowest = [
        _spanning([c], table.column_labels(c.key)[-1], width, c.power if has_own_powers else None)
        for c in layout
    ]
    return lines + table_line([*fields, *lowest])


def table_line(parts: Iterable[str]) -> str:
    """A line of a tabular."""
    return " & ".join(parts) + " \\\\\n"


def _spanning(
    columns: Sequence[_Column], text: str, letters: int = sys.maxsize, power: int | None = None
) -> str:
    """A head over columns, in lines of at most so many letters, and the power of its numbers."""
    lines = [latex_text(line) for line in wrap(text, letters, break_long_words=False)]
    lines += [] if power is None else [f"$[\\num{{e{power}}}]$"]
    head = _NEW_LINE.join(lines)
    # Not r"\shortstack" around a single line: its baseline would differ from the other heads.
    stacked = head if len(lines) < 2 else rf"\shortstack{{{head}}}"
    return f"\\multicolumn{{{_width(columns)}}}{{c}}{{{stacked}}}"


def _body(table: Table, layout: Sequence[_Column]) -> str:
    """Body lines; a label that repeats the line above is left out, groups stand apart."""
    groups = []
    for rows in table.rows_by_group:
        lines = ""
        for above, row in pairwise([(), *rows]):
            # A label is left out where it and all before it are those of the row above.
            labels = [
                latex_text(part) if row[:i] != above[:i] else ""
                for i, part in enumerate(row, start=1)
            ]
            lines += table_line([*labels, *map(partial(_cell, table, row), layout)])
        groups.append(lines)
    return "\\addlinespace\n".join(groups)


def _cell(table: Table, row: Key, column: _Column) -> str:
    """A number, or words instead of it; beside it the interval and the mark of a note."""
    entry = table.entry(row, column.key) or NO_ENTRY
    if entry.value is None:
        # siunitx does not parse what is in braces.
        number = f"{{{latex_text(entry.label)}}}" if entry.label else "{--}"
    else:
        number = ("\\bfseries " if entry.best else "") + column.text(entry.value)
    if not column.has_text:
        return number
    interval = ""
    if entry.interval:
        # Both ends in full, alike in every row.
        low, high = map(column.text, entry.interval)
        interval = f"{{\\scriptsize [\\num{{{low}}}, \\num{{{high}}}]}}"
    mark = rf"\textsuperscript{{{table.note_labels[entry.note]}}}" if entry.note else ""
    return f"{number} & {interval}{mark}"


def _caption(table: Table, layout: Sequence[_Column]) -> str:
    """Metric, statistic and interval; the power of ten; repeats, and what bold is."""
    if table.own_caption or table.has_metric_columns:
        statistic = latex_text(table.description)
    else:
        units = ", ".join(map(_unit, table.metric.units))
        rest = latex_text(table.description.removeprefix(table.metric.heading))
        statistic = f"{latex_text(table.metric.title)}{units and f' ({units})'}{rest}"
    powers = {column.power for column in layout}
    power = next(iter(powers)) if len(powers) == 1 else None
    shared = "" if power is None else f" Numbers in units of \\num{{e{power}}}."
    return f"{statistic}{shared}{''.join(f' {latex_text(s)}' for s in table.repeat_notes)}"


def _unit(unit: str) -> str:
    """A unit for siunitx."""
    parts = (_UNITS.get(part, part) for part in unit.split())
    return f"\\unit{{{''.join(parts)}}}"


def macro_text(tables: Sequence[Table], origin: Origin) -> str:
    """`numbers.tex`: one \\newcommand per entry, \\sid<Table><Row><Column>, letters only.

    Digits are spelled; names that would fall together get letters from a hash of their labels.
    """
    entries = [
        ((table.name, *row, *column), table.column_notation[column], table.entry(row, column))
        for table in tables
        for row, column in table.indices
    ]
    names = macro_names([labels for labels, _, _ in entries])
    lines = [
        f"\\newcommand{{\\{name}}}{{{_inline(style, entry or NO_ENTRY)}}}"
        for name, (_, style, entry) in zip(names, entries, strict=True)
    ]
    return origin_text(origin) + "\n".join(lines) + "\n"


def suite_macro_text(
    cells: "pd.DataFrame",
    specs: Iterable[Mapping[str, Any]],
    choose: Choose,
    metrics: Mapping[str, Metric],
    origin: Origin,
) -> str:
    """`macros.tex`: one \\newcommand per [[macro]] of a suite, under the name that it gives.

    `choose(expression, cell)` decides on cells. A macro without any ok cell prints a dash.
    """
    lines = []
    for spec in specs:
        metric, text = metrics[spec["metric"]], "--"
        found = select_rows(cells, spec, choose)
        given = found[metric.name].where(found["status"] == "ok") if metric.name in found else ()
        numbers = np.array([math.nan if value is None else float(value) for value in given])
        values = metric.scale * numbers[np.isfinite(numbers)]
        if len(values):
            value = statistic_of(spec["stat"], values)
            digits = 0 if spec["stat"] == "count" else metric.digits
            text = f"\\num{{{notation([value], digits).text(value)}}}"
        lines.append(f"\\newcommand{{\\{spec['name']}}}{{{text}}}")
    return origin_text(origin) + "\n".join(lines) + "\n"


def macro_names(keys: Sequence[tuple[str, ...]]) -> list[str]:
    """A macro name of letters for each key; different keys never share one."""
    plain = ["sid" + "".join(map(_camel, key)) for key in keys]
    # A hash of the labels and not a running number, which a further row would shift.
    shared, names = Counter(plain), []
    for name, key in zip(plain, keys, strict=True):
        digest = hashlib.sha256("\0".join(key).encode("utf-8", "surrogatepass")).digest()
        letters = "X" + "".join(chr(ord("a") + byte % 26) for byte in digest[:6])
        names.append(name if shared[name] == 1 else name + letters)
    return names


def _camel(text: str) -> str:
    words = re.split("[^A-Za-z0-9]+", text)
    return label_name("".join(word[:1].upper() + word[1:] for word in words))


def _inline(style: Notation, entry: Entry) -> str:
    """A number, or the words instead of it in italics."""
    if entry.value is not None:
        return f"\\num{{{style.text(entry.value)}}}"
    return rf"\textit{{{latex_text(entry.label)}}}" if entry.label else "--"
