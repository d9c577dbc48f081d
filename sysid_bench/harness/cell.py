"""One planned cell of a suite: its labels, its fields in expressions, and its expected cost."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import PurePosixPath
from typing import Any, Final

from pydantic import BaseModel

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.errors import SysidBenchError
from sysid_bench.experiments.simulated.composed_plant import (
    COMPOSED,
    plant_entries,
    plant_name,
)
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    normal_noise,
    normal_payload,
    normal_prior,
)
from sysid_bench.harness.suite.data_entries import RobotEntry
from sysid_bench.harness.suite.model import Suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.harness.suite.plugin_entries import Plant
from sysid_bench.signals.pipeline_choice import DEFAULT, PLAIN
from sysid_bench.units import quantity

BASES: Final = {None: "", True: " (free base)", False: " (fixed base)"}
"""Suffix of a robot's name where the suite sets its base."""


DEFAULTS: Final = ({"use": PLAIN}, {"use": DEFAULT})
"""Pipelines of experiments that name none."""

_Choice = tuple[Any, str, str]
"""A value of a sweep, its short text and its long one."""


def _unique_labels(choices: Iterable[_Choice]) -> dict[str, str]:
    """Return canonical(value) -> label: the short text of a choice where it is unique, else the
    long one, else the long one with a hash."""
    short, long = dict[str, str](), dict[str, str]()
    for value, *texts in choices:
        key = canonical(value)
        short.setdefault(key, texts[0])
        long.setdefault(key, texts[1])
    hashed = {key: f"{text} #{canonical_hash(key)[:6]}" for key, text in long.items()}
    labels = short
    for finer in (long, hashed):
        count = Counter(labels.values())
        labels = {key: finer[key] if count[text] > 1 else text for key, text in labels.items()}
    return labels


def plugin_label(spec: Mapping[str, Any], label: str | None = None) -> tuple[str, str]:
    """Return short and long text of a plug-in: "Geodesic" and "Geodesic step=0.1"."""
    use = str(spec["use"])
    short = label or use.rpartition(":")[2]
    settings = [f"{key}={value}" for key, value in spec.items() if key not in ("use", "label")]
    if settings:
        return short, " ".join((short, *settings))
    return short, f"{short} ({use})" if ":" in use else short


def _plugin_texts(spec: Mapping[str, Any], label: str | None = None) -> _Choice:
    return spec, *plugin_label(spec, label or spec.get("label"))


def _plant_texts(entry: Plant) -> _Choice:
    """Return a plant with its short and its long text: "L2" and "L2 stribeck share=0.2 delay"."""
    spec = entry.spec
    if spec["use"] != COMPOSED:
        return _plugin_texts(spec)
    short = plant_name(spec)
    parts = (plugin_label(part)[1] for _, part in plant_entries(spec))
    return spec, short, " ".join((short, *parts))


def terms_label(spec: ExperimentSpec) -> str:
    """Return the label of the joint terms of an experiment."""
    return "default" if spec.terms is None else " ".join(spec.terms) or "none"


def table_text(written: str | Mapping[str, Any], empty: str) -> str:
    """Return "q 1e-4 rad, tau 0.5 %" for a table of quantities; words stay."""
    if isinstance(written, str):
        return written
    return ", ".join(f"{key} {value}" for key, value in written.items()) or empty


def prior_table(prior: BaseModel | str) -> str | dict[str, Any]:
    """Return a prior as its words or keys."""
    return prior if isinstance(prior, str) else prior.model_dump(exclude_none=True)


def labels_of(suite: Suite, names: Names) -> dict[str, dict[str, str]]:
    """Return axis -> canonical value -> label."""
    axes = suite.defaults
    of_plants = zip(*map(axes.of, axes.plant), strict=True)
    simulations, noises, pipelines = map(chain.from_iterable, of_plants)
    choices: dict[str, list[_Choice]] = {
        "excitation": [_plugin_texts(entry.spec) for entry in axes.excitation],
        "simulation": [_plugin_texts(entry.spec) for entry in simulations],
        "pipeline": [
            # Where none is named, it is one of those that may be chosen.
            _plugin_texts(spec)
            for entry in pipelines
            for spec in (DEFAULTS if entry is None else (entry.spec,))
        ],
        "plant": list(map(_plant_texts, axes.plant)),
        "estimator": [_plugin_texts(entry.spec, entry.label) for entry in suite.estimator],
        "task": [(task, *plugin_label({"use": task})) for task in axes.task],
        "robot": [_robot_texts(names, suite, source, entry) for entry, source in suite.robots],
        "payload": [
            (normal_payload(load), names.payload(load).name, table_text(load, "none"))
            for entry in suite.robot
            for load in entry.payloads
        ],
        "noise": [_noise_texts(noise.model_dump(exclude_none=True)) for noise in noises],
        "prior": [
            (normal_prior(prior), text, text)
            for prior in map(prior_table, axes.prior)
            for text in [table_text(prior, "none")]
        ],
        "held_out": [_motion_texts([motion.spec for motion in one]) for one in axes.held_out],
    }
    return {axis: _unique_labels(texts) for axis, texts in choices.items()}


def _noise_texts(written: Mapping[str, Any]) -> _Choice:
    value = normal_noise(dict(written))
    text = table_text(written, "exact") if value else "exact"
    return value, text, text


def _motion_texts(specs: Sequence[Mapping[str, Any]]) -> _Choice:
    short, long = map(", ".join, zip(*map(plugin_label, specs), strict=True))
    return specs, short, long


def robot_key(source: str, free_base: bool | None, sensor: str | None = None) -> Any:
    """Return the key of a robot: its source, with base and sensor where the suite sets them."""
    if sensor is not None:
        return [source, free_base, sensor]
    return source if free_base is None else [source, free_base]


def _robot_texts(names: Names, suite: Suite, source: str, entry: RobotEntry) -> _Choice:
    base = BASES[entry.free_base]
    sensor = "" if entry.sensor is None else f" @ {entry.sensor}"
    key = robot_key(source, entry.free_base, entry.sensor)
    return key, names.robot(source, suite.folder).name + base, source + base + sensor


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
        "terms": cell.labels["terms"],
        **cell.facts,
        **_below("signals", spec.signals),
    }
    for key, value in spec.noise.items():
        flat["noise." + key.removesuffix("_relative")] = value
    if not isinstance(spec.prior, str):
        flat |= _below("prior", spec.prior)
    plugins = {
        "plant": spec.plant,
        "excitation": spec.excitation,
        "simulation": spec.simulation,
        "pipeline": spec.pipeline or {"use": PLAIN},
        "estimator": cell.estimator,
    }
    for axis, plugin in plugins.items():
        flat |= _below(axis, plugin)
        flat[axis] = _plugin_names(cell.labels[axis], plugin["use"])
    flat["task"] = _plugin_names(cell.labels["task"], spec.task)
    label, source = cell.labels["robot"], spec.robot
    # A robot is also known without its base, as written, and by its file.
    bare = [label.removesuffix(base) for base in BASES.values() if base and label.endswith(base)]
    file = [PurePosixPath(source).stem] if "/" in source else []
    flat["robot"] = _names(label, *bare, source, *file)
    return flat


def _below(name: str, table: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a table of an axis, as "plant.use"."""
    return {f"{name}.{key}": value for key, value in table.items()}


def _plugin_names(label: str, use: str) -> str | tuple[str, ...]:
    return _names(label, use, use.rpartition(":")[2])


def _names(*names: str) -> str | tuple[str, ...]:
    different = tuple(dict.fromkeys(names))
    return different[0] if len(different) == 1 else different


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
    table = _METHODS.get(str(estimator["use"]), _ESTIMATOR)
    budget = _number(estimator.get("budget"), "s", 0.0)
    return CellCost(_experiment(spec), _BUDGET * budget if budget else table)


def _experiment(spec: ExperimentSpec) -> float:
    if spec.log is not None:
        return _LOG
    period = _number(spec.excitation.get("period"), "s", 5.0)
    cycles = _number(spec.excitation.get("cycles"), "1", 2.0)
    seconds = period * cycles * (spec.motions + len(spec.held_out))
    steps = 0.0
    if spec.simulation["use"] == "closed-loop":
        rate = _number(spec.simulation.get("rate"), "Hz", 1000.0)
        steps = seconds * rate * _number(spec.simulation.get("substeps"), "1", 4.0)
    return _EXPERIMENT + _SAMPLE * seconds * spec.rate + _STEP * steps


def _number(written: Any, unit: str, default: float) -> float:
    try:
        return quantity(written, unit)
    except (SysidBenchError, TypeError):  # a plug-in may use this key for something else
        return default


def run_cost(parts: Iterable[float], robots: int) -> float:
    """Return the cost of a whole run of some robots with payloads from those of its parts."""
    return START + ROBOT * robots + sum(parts)
