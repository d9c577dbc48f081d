"""One planned cell of a suite: its labels, its fields in expressions, and its expected cost."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from math import isfinite
from pathlib import PurePosixPath
from typing import Any, Final

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.errors import SysidBenchError
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.signals.pipeline_choice import PLAIN
from sysid_bench.units import quantity

BASES: Final = {None: "", True: " (free base)", False: " (fixed base)"}
"""Suffix of a robot's name where the suite sets its base."""


@dataclass(frozen=True)
class Cell:
    """One future row. `facts` are fields that depend on the models behind the names."""

    spec: ExperimentSpec
    estimator: Mapping[str, Any]  # {use, settings...} without a label
    labels: Mapping[str, str]  # words.LABELS -> text
    facts: Mapping[str, Any]
    seconds: float  # expected; the share of one estimator in its experiment

    @cached_property
    def id(self) -> str:
        """12 hex digits of the experiment and the estimator without its label."""
        # Of canonical JSON: the order of keys in a suite changes no id. With 48 bits two of a
        # million cells have one id with a probability of 0.2 %.
        return canonical_hash([self.spec.id, self.estimator])[:12]

    @property
    def code_key(self) -> str:
        """Canonical JSON of the parts of a cell that decide its fingerprint."""
        return f"[{self.spec.code_key},{canonical(self.estimator)}]"

    @property
    def experiment(self) -> str:
        """The experiment's id, shared by its estimators."""
        return self.spec.id

    @property
    def first_fields(self) -> dict[str, Any]:
        """The first fields of the row of this cell, of any status."""
        return {
            "id": self.id,
            "experiment": self.experiment,
            **self.labels,
            "repeat": self.spec.repeat,
        }

    def to_json(self) -> dict[str, Any]:
        """One line of plan.jsonl."""
        return {
            "id": self.id,
            "experiment": self.experiment,
            "labels": dict(self.labels),
            "facts": dict(self.facts),
            "seconds": self.seconds,
            "estimator": dict(self.estimator),
            "spec": self.spec.to_json(),
        }


@dataclass(frozen=True, slots=True, eq=False)
class CellLabels(Mapping[str, str]):
    """Labels of a cell: those of its experiment, which its cells share, and its estimator's."""

    shared: Mapping[str, str]
    estimator: str

    def __getitem__(self, axis: str) -> str:
        """Label of an axis."""
        return self.estimator if axis == "estimator" else self.shared[axis]

    def __iter__(self) -> Iterator[str]:
        """Axes in their order."""
        return iter(self.shared)

    def __len__(self) -> int:
        """Number of axes."""
        return len(self.shared)


@dataclass(frozen=True, slots=True)
class PlannedRow(Mapping[str, Any]):
    """First fields of the row of a planned cell with its fingerprint and its losses before: made
    when they are read, since a run holds those of all its cells."""

    cell: Cell
    fingerprint: str
    losses: int

    def __getitem__(self, key: str) -> Any:
        """One field; a worker is given cells by their id alone."""
        return self.cell.id if key == "id" else self._fields()[key]

    def __iter__(self) -> Iterator[str]:
        """Names of the fields in the order of a row."""
        return iter(self._fields())

    def __len__(self) -> int:
        """Number of fields."""
        return len(self._fields())

    def __reduce__(self) -> tuple[type[dict[str, Any]], tuple[dict[str, Any]]]:
        """As plain fields to other processes."""
        return dict, (self._fields(),)

    def _fields(self) -> dict[str, Any]:
        more = {"fingerprint": self.fingerprint, "losses": self.losses}
        return {**self.cell.first_fields, **more}


def fields(cell: Cell) -> dict[str, Any]:
    """Return the flat mapping that expressions read; a tuple holds alternative names."""
    spec = cell.spec
    flat: dict[str, Any] = {
        **cell.labels,
        "id": cell.id,
        "experiment": cell.experiment,
        "repeat": spec.repeat,
        "rate": spec.rate,
        "motions": spec.motions if spec.log is None else len(spec.log["train"]),
        **cell.facts,
    }
    for key, value in spec.noise.items():
        # Noise in percent is stored as "tau_relative"; conditions know both as noise.tau.
        flat["noise." + key.removesuffix("_relative")] = value
    plugins: dict[str, Mapping[str, Any]] = {
        "task": {"use": spec.task},
        "plant": spec.plant,
        "excitation": spec.excitation,
        "simulation": spec.simulation,
        "pipeline": spec.pipeline or {"use": PLAIN},
        "estimator": cell.estimator,
    }
    tables = {axis: plugin for axis, plugin in plugins.items() if axis != "task"}
    tables |= {"signals": spec.signals}
    if not isinstance(spec.prior, str):
        tables["prior"] = spec.prior
    for axis, table in tables.items():
        flat |= {f"{axis}.{key}": value for key, value in table.items()}
    for axis, plugin in plugins.items():
        use = plugin["use"]
        flat[axis] = _names(cell.labels[axis], use, use.rpartition(":")[2])
    label, source = cell.labels["robot"], spec.robot
    # A robot is also known without its base, as written, and by its file.
    bare = [label.removesuffix(base) for base in BASES.values() if base and label.endswith(base)]
    file = [PurePosixPath(source).stem] if "/" in source else []
    flat["robot"] = _names(label, *bare, source, *file)
    return flat


def _names(*names: str) -> str | tuple[str, ...]:
    different = tuple(dict.fromkeys(names))
    return different[0] if len(different) == 1 else different


# Rough figures, of one core of 2025: they share out work and separate minutes from hours. Rows of
# earlier runs replace them (run_time.py).
START: Final = 11.0
"""Start of the processes, tables, figures and report."""
ROBOT: Final = 0.2
"""Loading and cross-check of a robot with a payload."""
_EXPERIMENT: Final = 0.035
_SAMPLE: Final = 1e-5  # regressor and reduction of one sample of a motion
_STEP: Final = 3e-6  # of a simulation in closed loop
_LOG: Final = 1.8  # recordings of an experiment: reading, checks, filters
_ESTIMATOR: Final = 0.01
_BUDGET: Final = 0.7
"""Share of a budget of CPU time that methods take: some stop before."""
_METHODS: Final[Mapping[str, float]] = {
    "ml": 0.7, "log-cholesky": 0.06, "reconstruction": 0.02, "ar-gls": 0.05, "iv": 0.15,
    "didim": 0.4, "didim-guarded": 0.5, "cloe": 5.0, "clie": 3.0, "ekf": 1.2, "ukf": 1.2,
    "rollout": 1.7,
}  # fmt: skip
"""Methods that take more than `_ESTIMATOR`: those that simulate or iterate over all samples."""


@dataclass(frozen=True)
class CellCost:
    """Expected CPU seconds of an experiment, shared by its cells, and of an estimator on it."""

    experiment: float
    estimator: float


def cell_cost(spec: ExperimentSpec, estimator: Mapping[str, Any]) -> CellCost:
    """Return the cost of a cell from the table."""
    budget = _number(estimator.get("budget"), "s", 0.0)
    own = _BUDGET * budget if budget else _METHODS.get(str(estimator["use"]), _ESTIMATOR)
    if spec.log is not None:
        return CellCost(_LOG, own)
    period = _number(spec.excitation.get("period"), "s", 5.0)
    cycles = _number(spec.excitation.get("cycles"), "1", 2.0)
    seconds = period * cycles * (spec.motions + len(spec.held_out))
    steps = 0.0
    if spec.simulation["use"] == "closed-loop":
        rate = _number(spec.simulation.get("rate"), "Hz", 1000.0)
        steps = seconds * rate * _number(spec.simulation.get("substeps"), "1", 4.0)
    return CellCost(_EXPERIMENT + _SAMPLE * seconds * spec.rate + _STEP * steps, own)


def _number(written: Any, unit: str, default: float) -> float:
    if not isinstance(written, str):
        known = type(written) in (int, float) and isfinite(written)
        return float(written) if known else default
    return _number_of_text(written, unit, default)


@cache
def _number_of_text(text: str, unit: str, default: float) -> float:
    try:
        return quantity(text, unit)
    except SysidBenchError:  # a plug-in may use this key for something else
        return default


def run_cost(parts: Iterable[float], robots: int) -> float:
    """Return the cost of a whole run of some robots with payloads from those of its parts."""
    return START + ROBOT * robots + sum(parts)
