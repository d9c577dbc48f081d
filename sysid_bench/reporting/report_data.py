"""Content of the HTML report."""

import base64
import gzip
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

import numpy as np

from sysid_bench.evaluation.intervals import with_level
from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.selection import label
from sysid_bench.reporting.signal_figures import StoredTorque
from sysid_bench.reporting.tables import ABSENT, notation
from sysid_bench.types import Array, Metric
from sysid_bench.words import LABELS, STATUSES

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
    worst = []
    for name in ("gap", "closure"):
        if (value := _largest(cells, name)) is not None:
            row = cells.iloc[int(np.nanargmax(cells[name].astype(float)))]
            title = metric_of(name).title
            if name == "gap" and "second_engine" in cells and cells["second_engine"].notna().any():
                title = "Regressor gap to MuJoCo's own inverse dynamics (without Pinocchio)"
            where = f"{label(row['robot'])}, {label(row['payload'])}"
            worst.append((f"Worst {title[0].lower()}{title[1:]}", _number(value), where))
    return RunSummary(
        total=len(cells),
        statuses=tuple((status, counts[status]) for status in (*known, *others)),
        **{
            f"{name}s": len(set(map(label, cells.get(name, ()))))
            for name in ("robot", "payload", "estimator")
        },
        worst=tuple(worst),
    )


def crosscheck_rows(cells: "pd.DataFrame") -> list[CrosscheckRow]:
    """Agreement per robot and payload, also of failed cells; a missing number never passes."""
    rows = []
    for robot, payload, group in _groups(cells, "robot", "payload"):
        native = _largest(group, "native_gap")
        # The verdict of the run's cross-check; false where it or a figure is missing.
        passed = {"crosscheck", "gap", "closure"} <= set(group.columns)
        passed = passed and set(group["crosscheck"].dropna()) == {"ok"}
        passed = passed and len(group[["gap", "closure"]].dropna()) > 0
        rows.append(
            CrosscheckRow(
                robot=robot,
                payload=payload,
                gap=_number(_largest(group, "gap")),
                closure=_number(_largest(group, "closure")),
                native=_first(group, "native_reason") if native is None else _number(native),
                passed=passed,
                repairs=_first(group, "repairs"),
            )
        )
    return rows


def failed_cells(cells: "pd.DataFrame") -> list[FailedCells]:
    """Every cell that is not ok, grouped by status and reason, the most frequent first."""
    lost, found = cells[cells["status"] != "ok"], []
    if "reason" not in lost:
        lost = lost.assign(reason="")
    for status, reason, group in _groups(lost, "status", "reason"):
        first = group.head(_EXAMPLES_OF_A_FAILURE).to_dict("records")
        examples = tuple((str(row["id"]), _description(row)) for row in first)
        found.append(FailedCells(status, reason, len(group), examples))
    return sorted(found, key=lambda failure: -failure.count)


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
    """The first text of a column, "" where there is none; a list of texts is one text."""
    for value in group.get(name, ()):
        is_list = value is not None and not isinstance(value, (str, float))
        text = "; ".join(map(label, value)) if is_list else label(value)
        if text not in ("", "none"):
            return text
    return ""


def _number(value: float | None) -> str:
    return ABSENT if value is None else notation([value], 3).html_text(value)


JOINT_SCORES: Final = ("id", "name", "relative", "rmse_test")
"""Columns of the joints that an open row shows."""

CELLS: Final = 500
"""Cells of a chunk of joints: reading one takes a few milliseconds."""

MOST_JOINTS: Final = 4_500_000
"""Bytes of all chunks of joints; a page of 50,000 cells stays below 8 MB."""

_SAMPLES: Final = 400  # of a curve: as many as a figure has points across


def data_text(data: Any) -> str:
    """JSON data as base64 of gzip, which can end no element of a page; the same text every time."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return _packed_text(text)


def joint_blocks(cells: "pd.DataFrame", joints: "pd.DataFrame") -> tuple[str, ...]:
    """Scores per joint of `CELLS` cells each, in the order of the cells, packed; the last chunks
    are left out where all of them are larger than `MOST_JOINTS`.

    A chunk has `names` (lists of joints), `which` of them each cell has (-1: none), and the
    numbers of one cell after another.
    """
    joints = joints if "id" in joints else joints.rename(columns={"cell": "id"})
    if joints.empty or not set(JOINT_SCORES[:3]) <= set(joints.columns):
        return ()
    import pandas as pd

    places = pd.Series(np.arange(len(cells)), index=cells["id"].astype(str))
    known = joints["id"].map(places)
    # Stable: the joints of a cell keep their order.
    kept = joints.assign(place=known)[known.notna()].sort_values("place", kind="stable")
    place = kept["place"].to_numpy(int)
    chunks, size = list[str](), 0
    for first in range(0, len(cells), CELLS):
        start, stop = np.searchsorted(place, [first, first + CELLS])
        counts = np.bincount(place[start:stop] - first, minlength=min(CELLS, len(cells) - first))
        chunks.append(_packed_text(_joint_text(kept.iloc[start:stop], counts)))
        size += len(chunks[-1])
        if size > MOST_JOINTS:
            return tuple(chunks[:-1])
    return tuple(chunks)


def _joint_text(joints: "pd.DataFrame", counts: np.ndarray) -> str:
    """JSON of the joints of a few cells, `counts` of them for each."""
    names, ends = joints["name"].astype(str).tolist(), np.cumsum(counts)
    lists: dict[tuple[str, ...], int] = {(): -1}
    # Cells of a robot share one list of joints, which is stored once.
    which = [
        lists.setdefault(tuple(names[end - count : end]), len(lists) - 1)
        for end, count in zip(ends.tolist(), counts.tolist(), strict=True)
    ]
    # Numbers are written as text by column: json.dumps of a float has up to 17 digits.
    head = json.dumps({"names": list(lists)[1:], "which": which}, separators=(",", ":"))
    columns = (f'"{name}":[{_numbers(joints, name)}]' for name in JOINT_SCORES[2:])
    return f"{head[:-1]},{','.join(columns)}}}"


def _numbers(joints: "pd.DataFrame", name: str) -> str:
    """Three digits of each number; null where there is none."""
    # A column without any number holds None, which no format takes.
    given = joints[name].astype(float).tolist() if name in joints else [math.nan] * len(joints)
    return ",".join("null" if text[-1] in "nf" else text for text in map("%.3g".__mod__, given))


def torque_data(sample: StoredTorque) -> str:
    """Curves of a row that opens, packed: every n-th sample, four digits."""
    # Picked, not averaged: residuals would look smaller than they are.
    step = max(1, -(-len(sample.t) // _SAMPLES))
    return data_text(
        {
            "title": sample.title,
            "step": step,
            "rows": sample.rows,
            "units": sample.units,
            "t": _rounded(sample.t[::step]),
            "measured": [_rounded(curve) for curve in sample.measured[::step].T],
            "predicted": [_rounded(curve) for curve in sample.predicted[::step].T],
        }
    )


def _rounded(values: Array) -> list[float | None]:
    return [float(f"{v:.4g}") if np.isfinite(v) else None for v in values.tolist()]


def _packed_text(text: str) -> str:
    # mtime=0: the time of writing would make each page differ from the last.
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


_SHOWN: Final = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "repeat",
    "estimator",
)  # fmt: skip
"""Words that are columns of the table at first, where cells differ by them."""

_WORDS: Final = tuple(dict.fromkeys((*_SHOWN, *LABELS, "stop", "status")))
_LONGEST: Final = 2000
_LARGEST_WHOLE: Final = 1e9


def cells_to_json(
    cells: "pd.DataFrame", recordings: Mapping[str, str], metrics: Mapping[str, Metric] = METRICS
) -> dict[str, Any]:
    """All cells as columns of JSON data: words as numbers of a dictionary, four digits of a metric.

    `metrics` by name; those that are `shown` become columns. `links` has the place of each cell
    with a recording. Codes of a dictionary of one word are absent; `count` is that of all cells.
    """
    words = {name: list(map(label, cells[name])) for name in _WORDS if name in cells.columns}
    words["reason"] = list(map(_reason, cells.get("reason", [None] * len(cells))))
    # A word is stored once: thousands of cells repeat few robots, payloads and estimators.
    dictionary = [list(dict.fromkeys(texts)) for texts in words.values()]
    ids = list(map(str, cells["id"]))
    return {
        "ids": ids,
        "words": list(words),
        "dictionary": dictionary,
        "codes": list(map(_codes, words.values(), dictionary)),
        "shown": [
            name in ("status", "reason") or (name in _SHOWN and len(texts) > 1)
            for name, texts in zip(words, dictionary, strict=True)
        ],
        **_metric_columns(cells, metrics),
        "links": {i: quote(recordings[cell]) for i, cell in enumerate(ids) if cell in recordings},
        "hasLinks": not set(recordings).isdisjoint(ids),
        "count": len(ids),
    }


def _metric_columns(cells: "pd.DataFrame", metrics: Mapping[str, Metric]) -> dict[str, Any]:
    shown = [one for one in metrics.values() if one.shown and one.name in cells.columns]
    return {
        "scores": [metric.name for metric in shown],
        "titles": [with_level(metric.heading) for metric in shown],
        "values": [
            [_four_digits(metric.scale, value) for value in cells[metric.name]] for metric in shown
        ],
    }


def first_cells(data: Mapping[str, Any], most: int) -> dict[str, Any]:
    """The same columns with at most so many cells, and with the words of these alone."""
    dictionary, kept = [], []
    for words, codes in zip(data["dictionary"], data["codes"], strict=True):
        used = sorted(set(codes[:most] or range(len(words))))
        place = {code: i for i, code in enumerate(used)}
        dictionary.append([words[code] for code in used])
        kept.append([place[code] for code in codes[:most]])
    return {
        **data,
        "ids": data["ids"][:most],
        "dictionary": dictionary,
        "codes": kept,
        "values": [values[:most] for values in data["values"]],
        "links": {i: place for i, place in data["links"].items() if i < most},
    }


def _reason(value: Any) -> str:
    """A reason, cut where it is beyond reading: the row of the cell has it in full."""
    text = label(value)
    if text == "none":
        return ""
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def _codes(texts: Iterable[str], dictionary: list[str]) -> list[int]:
    """Index of each text in the dictionary; empty where there is one text alone."""
    index = {text: i for i, text in enumerate(dictionary)}
    return [index[text] for text in texts] if len(index) > 1 else []


def _four_digits(scale: float, value: Any) -> float | int | None:
    """A score times `scale` as a JSON number of four digits; None where it is not finite."""
    try:
        number = float(f"{scale * float(value):.4g}")
    except (TypeError, ValueError):
        return None
    if not math.isfinite(number):
        return None
    # A whole number is shorter without its point, up to the power of ten of a float's text.
    return int(number) if number.is_integer() and abs(number) < _LARGEST_WHOLE else number
