"""Content of the HTML report as plain values for its template."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.metrics import metric_of
from sysid_bench.reporting.notation import ABSENT, notation
from sysid_bench.reporting.selection import label
from sysid_bench.words import STATUSES

if TYPE_CHECKING:
    import pandas as pd

_EXAMPLES_OF_A_FAILURE: Final = 12


@dataclass(frozen=True)
class RunSummary:
    """Summary of a run: cells by status, numbers of robots and payloads, worst agreement."""

    total: int
    statuses: tuple[tuple[str, int], ...]
    robots: int
    payloads: int
    estimators: int
    worst: tuple[tuple[str, str, str], ...]  # title, value, where


@dataclass(frozen=True)
class CrosscheckRow:
    """Agreement of one robot with one payload; numbers as text."""

    robot: str
    payload: str
    gap: str
    closure: str
    native: str
    passed: bool
    repairs: str


@dataclass(frozen=True)
class FailedCells:
    """Cells that share a status and a reason; `examples` are (id, what) of the first of them."""

    status: str
    reason: str
    count: int
    examples: tuple[tuple[str, str], ...]


def run_summary(cells: "pd.DataFrame") -> RunSummary:
    """Counts of every status, the known ones first."""
    counts = Counter(map(label, cells["status"].dropna()))
    known = filter(counts.__contains__, STATUSES)
    others = sorted(set(counts) - set(STATUSES))
    return RunSummary(
        total=len(cells),
        statuses=tuple((status, counts[status]) for status in (*known, *others)),
        robots=_distinct(cells, "robot"),
        payloads=_distinct(cells, "payload"),
        estimators=_distinct(cells, "estimator"),
        worst=(*_worst(cells, "gap"), *_worst(cells, "closure")),
    )


def _distinct(cells: "pd.DataFrame", name: str) -> int:
    return len(set(map(label, cells.get(name, ()))))


def _worst(cells: "pd.DataFrame", name: str) -> Iterator[tuple[str, str, str]]:
    """Title, largest value of a metric and its robot and payload; nothing where it is missing."""
    value = _largest(cells, name)
    if value is not None:
        row = cells.iloc[int(np.nanargmax(cells[name].astype(float)))]
        title = metric_of(name).title
        where = f"{label(row['robot'])}, {label(row['payload'])}"
        yield f"Worst {title[0].lower()}{title[1:]}", _number(value), where


def crosscheck_rows(cells: "pd.DataFrame") -> list[CrosscheckRow]:
    """Agreement per robot and payload, also of failed cells; a missing number never passes."""
    return [_crosscheck_row(*group) for group in _groups(cells, "robot", "payload")]


def _crosscheck_row(robot: str, payload: str, group: "pd.DataFrame") -> CrosscheckRow:
    native = _largest(group, "native_gap")
    return CrosscheckRow(
        robot=robot,
        payload=payload,
        gap=_number(_largest(group, "gap")),
        closure=_number(_largest(group, "closure")),
        native=_first(group, "native_reason") if native is None else _number(native),
        passed=_agrees(group),
        repairs=_first(group, "repairs"),
    )


def _agrees(group: "pd.DataFrame") -> bool:
    """The verdict of the run's cross-check; false where it or a figure is missing."""
    if not {"crosscheck", "gap", "closure"} <= set(group.columns):
        return False
    figures = group[["gap", "closure"]].dropna()
    return set(group["crosscheck"].dropna()) == {"ok"} and len(figures) > 0


def failed_cells(cells: "pd.DataFrame") -> list[FailedCells]:
    """Every cell that is not ok, grouped by status and reason, the most frequent first."""
    lost = cells[cells["status"] != "ok"]
    if "reason" not in lost:
        lost = lost.assign(reason="")
    found = [_failed(*group) for group in _groups(lost, "status", "reason")]
    return sorted(found, key=lambda failure: -failure.count)


def _failed(status: str, reason: str, group: "pd.DataFrame") -> FailedCells:
    first = group.head(_EXAMPLES_OF_A_FAILURE).to_dict("records")
    examples = tuple((str(row["id"]), _description(row)) for row in first)
    return FailedCells(status, reason, len(group), examples)


def _description(row: Mapping[Any, Any]) -> str:
    """Robot, payload, noise, estimator and repeat of a cell, as far as it has them."""
    parts = [label(row[n]) for n in ("robot", "payload", "noise", "estimator") if n in row]
    return ", ".join(parts) + (f", repeat {label(row['repeat'])}" if "repeat" in row else "")


def environment_lines(env: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """The environment as (dotted key, text) lines."""
    lines: list[tuple[str, str]] = []
    for key, value in env.items():
        name = f"{prefix}{key}"
        lines += environment_lines(value, f"{name}.") if isinstance(value, Mapping) else [
            (name, label(value))
        ]  # fmt: skip
    return lines


def _groups(cells: "pd.DataFrame", one: str, two: str) -> Iterator[tuple[str, str, "pd.DataFrame"]]:
    """Groups of cells by the labels of two fields, in the order of first appearance."""
    if {one, two} <= set(cells.columns):
        keys = [cells[one].map(label), cells[two].map(label)]
        for (first, second), group in cells.groupby(keys, sort=False):
            yield str(first), str(second), group


def _largest(cells: "pd.DataFrame", name: str) -> float | None:
    if name not in cells.columns:
        return None
    known = cells[name].dropna().astype(float)
    return float(known.max()) if len(known) else None


def _first(group: "pd.DataFrame", name: str) -> str:
    """The first text of a column, "" where there is none."""
    texts = map(_sentence, group.get(name, ()))
    return next((text for text in texts if text not in ("", "none")), "")


def _sentence(value: Any) -> str:
    """A text, or a list of texts as one."""
    if value is None or isinstance(value, (str, float)):
        return label(value)
    return "; ".join(map(label, value))


def _number(value: float | None) -> str:
    return ABSENT if value is None else notation([value], 3).html_text(value)
