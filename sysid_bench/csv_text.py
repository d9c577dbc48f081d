"""Comma-separated values whose texts no spreadsheet evaluates."""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from typing import Final

_FORMULAS: Final = (*"=+-@\t\r\n", *"\uff1d\uff0b\uff0d\uff20")
"""Beginnings of texts that spreadsheets evaluate; some take the wide signs of East Asian fonts for
the plain ones."""


def csv_text(lines: Iterable[Sequence[object]]) -> str:
    """Return lines of cells as CSV. A text that a spreadsheet would evaluate begins with ' there;
    numbers, also as texts, stay numbers."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerows([_without_formula(cell) for cell in line] for line in lines)
    return out.getvalue()


def cell_text(cell: str) -> str:
    """Return the text of which `csv_text` made a cell."""
    return cell[1:] if cell.startswith("'") and cell[1:].startswith(_FORMULAS) else cell


def _without_formula(cell: object) -> object:
    is_formula = isinstance(cell, str) and cell.startswith(_FORMULAS) and not _is_number(cell)
    return f"'{cell}" if is_formula else cell


def _is_number(text: str) -> bool:
    try:
        # "-1.5" begins like a formula and is a number; "-inf" is not a number for a spreadsheet.
        return math.isfinite(float(text))
    except ValueError:
        return False
