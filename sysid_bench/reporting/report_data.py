"""Content of the HTML report as plain values for its template."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

import numpy as np

from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.notation import ABSENT, notation
from sysid_bench.reporting.selection import label
from sysid_bench.types import Metric

if TYPE_CHECKING:
    import pandas as pd

_WORDS: Final = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "repeat",
    "estimator", "status",
)  # fmt: skip
_EXAMPLES_OF_A_FAILURE: Final = 12
_LONGEST: Final = 160
_STATUSES: Final = ("ok", "failed", "timeout", "crash", "unsupported", "skipped")


@dataclass(frozen=True)
class Headline:
    """Summary of a run: cells by status, numbers of robots and payloads, worst agreement."""

    total: int
    statuses: tuple[tuple[str, int], ...]
    robots: int
    payloads: int
    estimators: int
    worst: tuple[tuple[str, str, str], ...]  # title, value, where


@dataclass(frozen=True)
class CrossCheck:
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


@dataclass(frozen=True)
class JointErrors:
    """Relative torque error per joint of a robot; one column per estimator, median and worst."""

    robot: str
    estimators: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def headline(cells: "pd.DataFrame") -> Headline:
    """Counts of every status, the known ones first."""
    counts = {label(k): int(n) for k, n in cells["status"].value_counts().items()}
    order = [s for s in _STATUSES if s in counts] + sorted(set(counts) - set(_STATUSES))
    worst = [_worst(cells, name) for name in ("gap", "closure")]
    return Headline(
        total=len(cells),
        statuses=tuple((status, counts[status]) for status in order),
        robots=_distinct(cells, "robot"),
        payloads=_distinct(cells, "payload"),
        estimators=_distinct(cells, "estimator"),
        worst=tuple(found for found in worst if found is not None),
    )


def _agrees(group: "pd.DataFrame") -> bool:
    """The verdict of the run's cross-check; false where it or a figure is missing."""
    if not {"crosscheck", "gap", "closure"} <= set(group.columns):
        return False
    figures = group[["gap", "closure"]].dropna()
    return set(group["crosscheck"].dropna()) == {"ok"} and len(figures) > 0


def crosscheck_rows(cells: "pd.DataFrame") -> list[CrossCheck]:
    """Agreement per robot and payload, also of failed cells; a missing number never passes."""
    rows = []
    for robot, payload, group in _groups(cells, "robot", "payload"):
        gap, closure, native = (_largest(group, n) for n in ("gap", "closure", "native_gap"))
        passed = _agrees(group)
        rows.append(
            CrossCheck(
                robot=robot,
                payload=payload,
                gap=_number(gap),
                closure=_number(closure),
                native=_first(group, "native_reason") if native is None else _number(native),
                passed=passed,
                repairs=_first(group, "repairs"),
            )
        )
    return rows


def assumptions(suite: Mapping[str, Any], cells: "pd.DataFrame") -> list[tuple[str, str]]:
    """Assumptions behind the numbers, from the suite, else from the cells."""
    defaults = suite.get("defaults") or {}
    run = suite.get("run") or {}
    found = [("Data", "Simulated with MuJoCo; no real robot was measured.")]
    found.append(("Task", _setting(defaults, cells, "task")))
    plant = _setting(defaults, cells, "plant")
    matched = " (the robot with exactly the terms of its model)" if plant == "matched" else ""
    found.append(("Plant", plant + matched if plant else ""))
    prior = _setting(defaults, cells, "prior")
    drawn = " (standard deviations of a draw around the truth)" if "mass" in prior else ""
    found.append(("Prior knowledge given to methods", prior + drawn))
    for title, key in (
        ("Simulation", "simulation"), ("Excitation", "excitation"), ("Rate", "rate"),
        ("Noise", "noise"), ("Signals", "signals"), ("Held-out motions", "held_out"),
    ):  # fmt: skip
        found.append((title, _setting(defaults, cells, key)))
    found.append(("Repeats", f"{run['repeats']} noise draws" if "repeats" in run else ""))
    found.append(
        ("Payload and link tasks", "Payload and link tasks take the rest of the robot as known.")
    )
    found.append(("Scores", "Torque errors are against the noise-free torque of held-out motions."))
    return [(title, text) for title, text in found if text]


def failures(cells: "pd.DataFrame") -> list[FailedCells]:
    """Every cell that is not ok, grouped by status and reason, the most frequent first."""
    lost = cells[cells["status"] != "ok"]
    if "reason" not in lost:
        lost = lost.assign(reason="")
    found = []
    for status, reason, group in _groups(lost, "status", "reason"):
        first = group.head(_EXAMPLES_OF_A_FAILURE)
        examples = tuple((str(row["id"]), _what(row)) for row in first.to_dict("records"))
        found.append(FailedCells(status, reason, len(group), examples))
    return sorted(found, key=lambda failure: -failure.count)


def joint_errors(cells: "pd.DataFrame", joints: "pd.DataFrame") -> list[JointErrors]:
    """Per robot: joints as rows; joints of small torque are named so."""
    key = next((name for name in ("id", "cell") if name in joints.columns), None)
    if key is None or not {"name", "relative"} <= set(joints.columns) or len(joints) == 0:
        return []
    who = cells[["id", "robot"]].assign(method=_methods(cells))
    merged = joints[joints.columns.difference(["robot", "method"])].rename(columns={key: "id"})
    merged = merged.merge(who, on="id")
    return [
        _errors_of_robot(label(robot), group)
        for robot, group in merged.groupby("robot", sort=False)
    ]


def environment_lines(env: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """The environment as (dotted key, text) lines."""
    lines: list[tuple[str, str]] = []
    for key, value in env.items():
        name = f"{prefix}{key}"
        lines += environment_lines(value, f"{name}.") if isinstance(value, Mapping) else [
            (name, label(value))
        ]  # fmt: skip
    return lines


def cells_as_data(
    cells: "pd.DataFrame",
    recordings: Mapping[str, str],
    metrics: Mapping[str, Metric] = METRICS,
) -> dict[str, Any]:
    """All cells as compact JSON data: words as numbers of a dictionary, four digits of a metric.

    `metrics` by name; those that are `shown` become columns.
    """
    words = [name for name in _WORDS if name in cells.columns]
    scores = [m.name for m in metrics.values() if m.shown and m.name in cells.columns]
    columns: list[list[Any]] = [[str(value) for value in cells["id"]]]
    dictionary: list[list[str]] = []
    for name in [*words, "reason"]:
        texts = _reasons(cells) if name == "reason" else [label(value) for value in cells[name]]
        known = {text: i for i, text in enumerate(dict.fromkeys(texts))}
        dictionary.append(list(known))
        columns.append([known[text] for text in texts])
    columns += [[_four_digits(value) for value in cells[name]] for name in scores]
    links = {cell: quote(path) for cell, path in recordings.items()}
    columns.append([links.get(cell, 0) for cell in columns[0]])
    return {
        "words": [*words, "reason"],
        "dictionary": dictionary,
        "scores": scores,
        "titles": [metrics[name].heading for name in scores],
        "rows": [list(row) for row in zip(*columns, strict=True)],
    }


def _groups(cells: "pd.DataFrame", one: str, two: str) -> list[tuple[str, str, "pd.DataFrame"]]:
    if not {one, two} <= set(cells.columns):
        return []
    texts = cells.assign(**{name: [label(v) for v in cells[name]] for name in (one, two)})
    return [
        (str(key[0]), str(key[1]), group)
        for key, group in texts.groupby([one, two], sort=False)
        if isinstance(key, tuple)
    ]


def _errors_of_robot(robot: str, group: "pd.DataFrame") -> JointErrors:
    estimators = tuple(dict.fromkeys(group["method"]))
    rows = []
    for joint, cells in group.groupby("name", sort=False):
        small = bool(cells["small"].any()) if "small" in cells else False
        numbers = [_median_and_worst(cells[cells["method"] == name]) for name in estimators]
        rows.append((label(joint) + (" (small torque)" if small else ""), *numbers))
    return JointErrors(robot, estimators, tuple(rows))


def _methods(cells: "pd.DataFrame") -> list[str]:
    """The estimator of each cell and its noise where there are several: exact data would hide
    what noise does."""
    names = [label(name) for name in cells["estimator"]]
    if _distinct(cells, "noise") < 2:
        return names
    return [f"{name}, {label(n)}" for name, n in zip(names, cells["noise"], strict=True)]


def _median_and_worst(group: "pd.DataFrame") -> str:
    """Median (largest), each in its own notation: a table holds exact and noisy cells."""
    values = group["relative"].dropna()
    if len(values) == 0:
        return ABSENT
    median, worst = (
        notation([v], 2).html_text(v) for v in map(float, (values.median(), values.max()))
    )
    return f"{median} ({worst})"


def _worst(cells: "pd.DataFrame", name: str) -> tuple[str, str, str] | None:
    value = _largest(cells, name)
    if value is None:
        return None
    row = cells.iloc[int(np.nanargmax(cells[name].astype(float)))]
    where = f"{label(row['robot'])}, {label(row['payload'])}"
    title = metric_of(name).title
    return f"Worst {title[0].lower()}{title[1:]}", _number(value), where


def _largest(cells: "pd.DataFrame", name: str) -> float | None:
    if name not in cells.columns:
        return None
    known = cells[name].dropna().astype(float)
    return float(known.max()) if len(known) else None


def _first(group: "pd.DataFrame", name: str) -> str:
    """The first text of a column; lists read as sentences."""
    for value in group[name] if name in group.columns else ():
        many = not isinstance(value, (str, float)) and value is not None
        text = "; ".join(label(part) for part in value) if many else label(value)
        if text not in ("", "none"):
            return text
    return ""


def _setting(defaults: Mapping[str, Any], cells: "pd.DataFrame", key: str) -> str:
    if key in defaults:
        value = defaults[key]
        choices: Sequence[Any] = value if isinstance(value, list) else [value]
        empty = "exact" if key == "noise" else "default"
        texts = [empty if isinstance(c, Mapping) and not c else label(c) for c in choices]
        return "; ".join(texts)
    if key in cells.columns:
        return "; ".join(dict.fromkeys(label(value) for value in cells[key]))
    return ""


def _what(row: Mapping[Any, Any]) -> str:
    parts = [label(row[n]) for n in ("robot", "payload", "noise", "estimator") if n in row]
    return ", ".join(parts) + (f", repeat {label(row['repeat'])}" if "repeat" in row else "")


def _distinct(cells: "pd.DataFrame", name: str) -> int:
    return len({label(value) for value in cells[name]}) if name in cells.columns else 0


def _number(value: float | None) -> str:
    return ABSENT if value is None else notation([value], 3).html_text(value)


def _reasons(cells: "pd.DataFrame") -> list[str]:
    """The reasons of all cells, cut where they are long: the failures above give them in full."""
    if "reason" not in cells.columns:
        return [""] * len(cells)
    texts = [label(value) if value else "" for value in cells["reason"]]
    texts = ["" if text == "none" else text for text in texts]
    return [text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…" for text in texts]


def _four_digits(value: Any) -> float | int | None:
    """A score as a JSON number of four digits; None where it is not finite."""
    try:
        number = float(f"{float(value):.4g}")
    except (TypeError, ValueError):
        return None
    if not math.isfinite(number):
        return None
    return int(number) if number == int(number) and abs(number) < 1e9 else number
