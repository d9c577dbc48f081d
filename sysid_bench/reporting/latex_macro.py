"""Numbers of tables as LaTeX macros, so that prose follows data."""

import hashlib
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_bench.reporting.latex import Origin, origin_text
from sysid_bench.reporting.latex_text import label_name, latex_text
from sysid_bench.reporting.notation import Notation, notation
from sysid_bench.reporting.selection import Choose, select_rows
from sysid_bench.reporting.statistic import statistic_of
from sysid_bench.reporting.tables import NO_ENTRY, Entry, Table
from sysid_bench.types import Array, Metric

if TYPE_CHECKING:
    import pandas as pd


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
    lines = [f"\\newcommand{{\\{spec['name']}}}{{{_number_of(cells, spec, choose, metrics)}}}"
             for spec in specs]  # fmt: skip
    return origin_text(origin) + "\n".join(lines) + "\n"


def _finite_values(cells: "pd.DataFrame", name: str) -> Array:
    """The finite numbers of a metric in the cells that are ok."""
    given = cells[name].where(cells["status"] == "ok") if name in cells else ()
    return np.array([v for v in map(_finite, given) if v is not None])


def _number_of(
    cells: "pd.DataFrame", spec: Mapping[str, Any], choose: Choose, metrics: Mapping[str, Metric]
) -> str:
    """The statistic of a metric over the cells that a macro selects; "--" where none has it."""
    metric = metrics[spec["metric"]]
    found = select_rows(cells, spec, choose)
    values = metric.scale * _finite_values(found, metric.name)
    if len(values) == 0:
        return "--"
    value = statistic_of(spec["stat"], values)
    digits = 0 if spec["stat"] == "count" else metric.digits
    return f"\\num{{{notation([value], digits).text(value)}}}"


def _finite(value: Any) -> float | None:
    """A number, None where there is none."""
    number = math.nan if value is None else float(value)
    return number if math.isfinite(number) else None


def macro_names(keys: Sequence[tuple[str, ...]]) -> list[str]:
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
    return rf"\textit{{{latex_text(entry.label)}}}" if entry.label else "--"
