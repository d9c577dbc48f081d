"""Main effects of the rows and columns of a table: how much each contributes to an error."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.reporting.table_entries import Entries
from sysid_bench.reporting.tables import Key


@dataclass(frozen=True, eq=False)
class MainEffects:
    """Least squares of log x_ij = m + r_i + c_j over a complete grid of positive values.

    `rows` exp(r_i) and `columns` exp(c_j) are ratios to the geometric mean of the grid, `shares`
    the parts of the variance of log x_ij due to rows, columns and neither (their interaction).
    """

    rows: np.ndarray
    columns: np.ndarray
    shares: tuple[float, float, float]


ROUNDING: Final = 1e-13
"""Relative rounding of logarithms and their mean."""


def main_effects(values: np.ndarray) -> MainEffects:
    """The main effects of positive values (rows, columns)."""
    raw = np.log(values)
    log = raw - raw.mean()
    if np.abs(log).max() <= ROUNDING * max(1.0, float(np.abs(raw).max())):
        log = 0.0 * log  # equal values: what the mean leaves is rounding, and has no parts
    r, c = log.mean(axis=1), log.mean(axis=0)
    parts = [r[:, None] + 0 * log, c[None, :] + 0 * log, log - r[:, None] - c[None, :]]
    total = float((log**2).sum()) or 1.0
    by_row, by_column, neither = (float((part**2).sum()) / total for part in parts)
    return MainEffects(np.exp(r), np.exp(c), (by_row, by_column, neither))


def effect_notes(entries: Entries, fields: tuple[Key, Key]) -> Iterator[str]:
    """Sentences with the main effects of the row and column `fields` of a table, over the rows
    whose values are complete and positive."""
    every_row = list(dict.fromkeys(row for row, _ in entries))
    columns = list(dict.fromkeys(column for _, column in entries))
    rows = [row for row in every_row if _is_whole(entries, row, columns)]
    if len(rows) < 2 or len(columns) < 2:
        yield "Main effects need two rows and two columns with positive numbers throughout."
        return
    values = np.array([[entries[row, column].value for column in columns] for row in rows], float)
    found, (of_rows, of_columns) = main_effects(values), map(" / ".join, fields)
    shares = zip((of_rows, of_columns, "both together"), found.shares, strict=True)
    yield (
        "Main effects, as ratios to the geometric mean of the entries: "
        f"{of_rows}: {_listed(rows, found.rows)}; {of_columns}: {_listed(columns, found.columns)}."
    )
    listed = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares)
    yield f"Share of the variance of the logarithms: {listed}."
    left_out = [" / ".join(row) for row in every_row if row not in rows]
    if left_out:
        yield f"Without an effect, for want of numbers: {', '.join(dict.fromkeys(left_out))}."


def _is_whole(entries: Entries, row: Key, columns: Sequence[Key]) -> bool:
    given = [entries[row, column].value for column in columns if (row, column) in entries]
    return len(given) == len(columns) and all(value and value > 0 for value in given)


def _listed(keys: Sequence[Key], ratios: np.ndarray) -> str:
    pairs = zip(keys, ratios, strict=True)
    return ", ".join(f"{' / '.join(key)} {ratio:.3g}" for key, ratio in pairs)
