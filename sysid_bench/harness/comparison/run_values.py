"""Quantities by which runs are compared: status and values of cells, true base parameters."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from operator import itemgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.harness.comparison.speed import EXPERIMENT, KERNEL, Key, Speed, relative_speed
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.metrics import METRICS, metric_from_record, names_of
from sysid_bench.models.behaviour_change import Behaviour
from sysid_bench.types import Better, Metric, Row
from sysid_bench.words import LABELS

if TYPE_CHECKING:
    import pandas as pd


METRICS_COMPARED: Final = (
    *("rank", "data_rank", "gap", "closure", "condition", "torque_error", "torque_error_moving"),
    *("parameter_error", "feasible"),
)
"""Metrics that are compared where none is named."""
SETTING: Final = ("payload", "task", "terms", "plant")
"""Axes on which the true base parameters of a robot depend."""
ALL_PARAMETERS: Final = " all parameters"
"""End of a setting whose methods return all parameters, none the base ones alone."""
_AXES: Final = (*(axis for axis in LABELS if axis != "robot"), "repeat")
_OPEN: Final = "open"
_SEPARATOR: Final = " | "


@dataclass(frozen=True)
class CellValues:
    """One cell: its robot, its other labels (those that vary in its run, with `repeat`), its
    status, and its value of each metric (None where it has none)."""

    robot: str
    labels: tuple[str, ...]
    status: str
    values: tuple[float | None, ...]
    reason: str = ""

    @property
    def is_ok(self) -> bool:
        """True for a cell with an estimate."""
        return self.status == "ok"

    @property
    def is_open(self) -> bool:
        """True for a cell that has not run yet."""
        return self.status == _OPEN


@dataclass(frozen=True)
class RunValues:
    """A run or a baseline: cells by id, with values in the order of `metrics`.

    `parameters`: true base parameters in SI units, (robot, setting) -> parameter -> value.
    `origin`: what env.json says of code, libraries and machine. `speeds`: ratios of times within
    the run, where they were asked for. `models`: behaviour of each robot, where it is known.
    `heads`: all labels of each cell of a run; a baseline has those of its axes alone.
    """

    name: str
    axes: tuple[str, ...]
    metrics: Mapping[str, Metric]
    cells: Mapping[str, CellValues]
    parameters: Mapping[tuple[str, str], Mapping[str, float]]
    origin: Mapping[str, Any]
    speeds: Mapping[Key, Speed] = field(default_factory=dict)
    models: Mapping[str, Behaviour] = field(default_factory=dict)
    heads: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def by_labels(self, axes: Sequence[str]) -> dict[str, str]:
        """Cells by their robot and labels on some axes; without those that share them."""
        found: dict[str, list[str]] = {}
        for name, cell in self.cells.items():
            labels = cell.labels
            if name in self.heads:
                labels = tuple(str(self.heads[name][axis]) for axis in axes)
            # Joined: a label may hold what separates them in a baseline.
            found.setdefault(_SEPARATOR.join((cell.robot, *labels)), []).append(name)
        return {labels: names[0] for labels, names in found.items() if len(names) == 1}

    def has_cell(self, first: Mapping[str, Any]) -> bool:
        """True for the first fields of a cell whose id or labels are here."""
        labels = (first["robot"], *(str(first[axis]) for axis in self.axes))
        return first["id"] in self.cells or _SEPARATOR.join(labels) in self.by_labels(self.axes)

    def cell_labels(self, robot: str) -> set[tuple[str, ...]]:
        """Labels but the repeat of the ok cells of a robot: groups that its speeds are of."""
        is_kept = [axis != "repeat" for axis in self.axes]
        cells = (one for one in self.cells.values() if one.robot == robot and one.is_ok)
        return {tuple(compress(cell.labels, is_kept)) for cell in cells}

    def label(self, identifier: str) -> str:
        """Labels of a cell as "ur5 none ols 0"."""
        cell = self.cells[identifier]
        return " ".join((cell.robot, *cell.labels))


def with_ids_of(before: RunValues, after: RunValues) -> RunValues:
    """Return the values of before with the ids that cells of the same labels have after: an id
    changes with the model, a label says which cell is meant. Equal ids are equal cells."""
    same = before.cells.keys() & after.cells.keys()
    later = after.by_labels(before.axes)
    new = {
        cell: later[labels]
        for labels, cell in before.by_labels(before.axes).items()
        if cell not in same and later.get(labels, cell) not in same and labels in later
    }
    if before.name != after.name or not new:  # labels of two suites mean different cells
        return before
    return replace(
        before,
        cells={new.get(name, name): one for name, one in before.cells.items()},
        heads={new.get(name, name): one for name, one in before.heads.items()},
    )


def read_run(folder: RunFolder, names: Sequence[str] = (), *, times: bool = False) -> RunValues:
    """Read what a run is compared by; `names` of metrics replace METRICS_COMPARED; `times`: its
    speeds, too.

    Raises UsageError for an unknown metric and for metrics that are not numbers of cells.
    """
    records = filter(None, (entry.record for entry in folder.suite.metric))
    known = {name: METRICS[name] for name in names_of("cell")}
    known |= {metric.name: metric for metric in map(metric_from_record, records)}
    for name in names:
        if name not in known or known[name].text:
            raise unknown_name("metric of cells", name, known)
    metrics = {name: known[name] for name in names or METRICS_COMPARED}
    cells = folder.frames().read("cells", [*_FIELDS, *metrics])
    planned = folder.planned_fields
    axes = label_axes([*planned.values()])
    rows = {row["id"]: row for row in _records(cells)}
    found = {
        cell: cell_values(first, rows.get(cell), axes, metrics) for cell, first in planned.items()
    }
    return RunValues(
        name=folder.suite.name,
        axes=axes,
        metrics=metrics,
        cells=found,
        parameters=_true_parameters(folder, cells),
        origin=folder.environment,
        speeds=_speeds(folder, planned) if times else {},
        models={robot: record["behaviour"] for robot, record in folder.models.items()},
        heads=planned,
    )


def _speeds(folder: RunFolder, planned: Mapping[str, Mapping[str, Any]]) -> dict[Key, Speed]:
    """Speeds of the parts; rows from before CPU times were stored have none."""
    needed = ["id", "estimator", "status", "seconds_cpu", "seconds_experiment_cpu"]
    timed = folder.frames().read("cells", [*needed, _KERNEL_TIME])
    if not {*needed} <= {*timed.columns}:
        return {}
    done = [row for row in _records(timed) if row["status"] == "ok"]
    return relative_speed(part_times(done, planned))


_KERNEL_TIME: Final = "seconds_kernel_cpu"


def part_times(
    rows: Iterable[Row], heads: Mapping[str, Mapping[str, Any]]
) -> dict[Key, list[list[float]]]:
    """CPU times (s) of each robot and part, a list for each group of repeats; `heads`: id -> first
    fields of the cell. An estimator with the name of another part is "estimator experiment"."""
    found: dict[Key, dict[tuple[Any, ...], list[float]]] = {}
    experiments: set[str] = set()
    for row in rows:
        head = heads[row["id"]]
        name = head["estimator"]
        part = f"estimator {name}" if name in (EXPERIMENT, KERNEL) else name
        timed = {part: _number(row["seconds_cpu"])}
        if head["experiment"] not in experiments:
            experiments.add(head["experiment"])
            whole, kernel = _number(row["seconds_experiment_cpu"]), _number(row.get(_KERNEL_TIME))
            timed[EXPERIMENT] = whole
            if whole is not None and kernel is not None:  # older rows have the whole alone
                timed |= {EXPERIMENT: whole - kernel, KERNEL: kernel}
        for part, value in timed.items():
            if value is not None:
                groups = found.setdefault((head["robot"], part), {})
                groups.setdefault(_group(head), []).append(value)
    return {key: [*groups.values()] for key, groups in found.items()}


_group: Final = itemgetter(*(axis for axis in LABELS if axis != "estimator"))
"""First fields that the repeats of a cell have in common."""


_FIELDS: Final = ("id", "robot", *SETTING, "status", "reason")


def label_axes(cells: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Axes that tell cells of one robot apart; those that follow from the ones before are not."""
    kept: tuple[str, ...] = ()
    settings = len({cell["robot"] for cell in cells})
    for axis in _AXES:
        more = len(set(map(itemgetter("robot", *kept, axis), cells)))
        # An axis that splits no group says nothing that the ones before it do not.
        if more > settings:
            kept, settings = (*kept, axis), more
    return kept


def _records(frame: "pd.DataFrame") -> Iterator[Row]:
    """Lines of a frame."""
    names = [str(name) for name in frame.columns]
    for values in zip(*(frame[name].tolist() for name in names), strict=True):
        yield dict(zip(names, values, strict=True))


def cell_values(
    first: Mapping[str, Any], row: Row | None, axes: Sequence[str], metrics: Mapping[str, Metric]
) -> CellValues:
    """Values of a cell from its first fields and its row (None: it has none yet)."""
    labels = tuple(str(first[axis]) for axis in axes)
    if row is None:
        return CellValues(first["robot"], labels, _OPEN, (None,) * len(metrics), "has not run yet")
    values = tuple(_number(row.get(name)) for name in metrics)
    return CellValues(first["robot"], labels, row["status"], values, row["reason"] or "")


def _number(value: Any) -> float | None:
    """A number of a frame; None for an empty field."""
    if value is None or isinstance(value, str):
        return None
    number = float(value)
    return None if math.isnan(number) else number


def _true_parameters(
    folder: RunFolder, cells: "pd.DataFrame"
) -> dict[tuple[str, str], dict[str, float]]:
    """True parameters of each robot and setting, from the first ok cell that has those of the base;
    from the first one that has any where no method returns base parameters alone."""
    fields = ["id", "body", "name", "true", "base_error"]
    lines = folder.frames().read("parameters", fields)
    if "true" not in lines:
        return {}
    lines = lines[lines["true"].notna()]
    done = cells[(cells["status"] == "ok") & cells["id"].isin(lines["id"].unique())]
    if "base_error" in lines:
        in_base = lines["base_error"].notna().groupby(lines["id"])
        is_partly = in_base.any() & ~in_base.all()
        # Stable: among those that have base parameters alone the first one stays the first.
        done = done.sort_values("id", key=lambda ids: ids.map(is_partly), kind="stable")
    first = done.drop_duplicates(["robot", *SETTING])
    found = lines[lines["id"].isin(first["id"])]
    by_cell = {name: [*_records(table)] for name, table in found.groupby("id", sort=False)}
    tables = ((cell, by_cell[cell["id"]]) for cell in _records(first))
    return {settings_key(cell, table): true_values(table) for cell, table in tables}


def settings_key(cell: Mapping[str, Any], entries: Sequence[Row]) -> tuple[str, str]:
    """Robot and setting of a cell whose row has these parameters. A base parameter and the one of
    its body are different numbers under one name, and are never compared: where a method returns
    all parameters, some are without an error of the base."""
    setting = " ".join(cell[axis] for axis in SETTING)
    without = [_number(entry.get("base_error")) for entry in entries].count(None)
    return cell["robot"], setting + ALL_PARAMETERS * (0 < without < len(entries))


def true_values(entries: Iterable[Row]) -> dict[str, float]:
    """True parameters, "body.name" -> SI value, of the entries of a row that have one."""
    return {
        f"{entry['body']}.{entry['name']}": float(entry["true"])
        for entry in entries
        if entry.get("true") is not None
    }


Kind = Literal["exact", "absolute", "ratio"]
Verdict = Literal["same", "better", "worse", "changed"]
Value = float | None

ROUNDING: Final = 1e-11
"""Errors below this are rounding: 1e-15 of a double times the condition number of a regressor."""


@dataclass(frozen=True)
class Tolerance:
    """Largest change that does not count.

    "exact": none. "absolute": a difference of `size`. "ratio": a factor of `size` (> 1) between two
    values, each at least `floor`.
    """

    kind: Kind
    size: float = 0.0
    floor: float = 0.0

    def __post_init__(self) -> None:
        least = 1.0 if self.kind == "ratio" else 0.0
        are_in_range = least <= self.size < math.inf and 0.0 <= self.floor < math.inf
        if self.kind not in get_args(Kind) or not are_in_range:
            raise UsageError(
                f"{self.to_json()} is not a tolerance: {{'exact': 0}}, {{'absolute': x}} with "
                "x >= 0, or {'ratio': r} with r >= 1 and a floor >= 0."
            )

    def holds(self, before: float, after: float) -> bool:
        """True where the change from `before` to `after` does not count."""
        if before == after:
            return True
        if self.kind == "exact" or not (math.isfinite(before) and math.isfinite(after)):
            return False
        if self.kind == "absolute":
            return abs(after - before) <= self.size
        # Below the floor both are rounding; a change of sign above it is never the same.
        low, high = sorted((max(abs(before), self.floor), max(abs(after), self.floor)))
        return (before * after >= 0 and high <= self.size * low) or high <= self.floor

    def stored_value(self, value: float) -> float:
        """`value`, or 0 where it is below what the tolerance can see: files stay short and do not
        change with rounding."""
        smallest = {"exact": 0.0, "absolute": self.size, "ratio": self.floor}[self.kind]
        return 0.0 if abs(value) <= smallest else value

    def to_json(self) -> dict[str, float]:
        """{"ratio": 1.01, "floor": 1e-11}."""
        return {self.kind: self.size} | ({"floor": self.floor} if self.floor else {})

    @classmethod
    def from_json(cls, values: Any) -> "Tolerance":
        """The tolerance of `to_json`; raises UsageError for anything else."""
        # The size of one kind, with or without a floor.
        given = values if isinstance(values, Mapping) else {}
        kinds = [kind for kind in get_args(Kind) if kind in given]
        are_known = len(kinds) == 1 and given.keys() <= {*kinds, "floor"}
        if not are_known or not all(isinstance(size, (int, float)) for size in given.values()):
            raise UsageError(
                f"{values!r} is not a tolerance: {{'exact': 0}}, {{'absolute': x}} or "
                "{'ratio': r, 'floor': x}."
            )
        (kind,) = kinds
        return cls(kind, float(values[kind]), float(values.get("floor", 0.0)))

    def __str__(self) -> str:
        return "exact" if self.kind == "exact" else f"{self.kind} {self.size:g}"


_RATIO: Final = Tolerance("ratio", 1.01, ROUNDING)
_GAPS: Final = Tolerance("absolute", 1e-12)
DEFAULTS: Final[Mapping[str, Tolerance]] = MappingProxyType(
    {
        **dict.fromkeys(("gap", "closure", "native_gap"), _GAPS),
        # Smallest kept over largest dropped singular value: the latter is rounding.
        "rank_gap": Tolerance("ratio", 1e3),
        "min_eigenvalue": Tolerance("ratio", 1.01, 1e-9),
    }
)
"""Tolerances of single metrics; `tolerance_of` has the rule for all others."""


def tolerance_of(metric: Metric) -> Tolerance:
    """Default tolerance of a metric: exact for numbers of things and shares of yes and no, absolute
    for gaps between engines, and a factor of 1.01 for everything that is computed with noise."""
    if metric.name in DEFAULTS:
        return DEFAULTS[metric.name]
    counted = metric.digits == 0 or metric.name in ("feasible", "plausible", "converged")
    return Tolerance("exact") if counted else _RATIO


def verdict_of(better: Better | None, tolerance: Tolerance, before: Value, after: Value) -> Verdict:
    """Verdict on the change of a value; a value that is gone is worse, a new one is a change."""
    if after is None:
        return "same" if before is None else "worse"
    if before is None:
        return "changed"
    if tolerance.holds(before, after):
        return "same"
    if better is None or math.isnan(before) or math.isnan(after):
        return "changed"
    worse = 1.0 if better == "lower" else -1.0
    return "worse" if math.copysign(1.0, after - before) == worse else "better"
