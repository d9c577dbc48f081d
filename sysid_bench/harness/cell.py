"""One planned cell of a suite, and its fields in expressions."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePosixPath
from typing import Any

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.harness.labels import BASES
from sysid_bench.signals.pipeline_choice import PLAIN


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
    flat["robot"] = _names(cell.labels["robot"], *_robot_names(cell.labels["robot"], spec.robot))
    return flat


def _below(name: str, table: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a table of an axis, as "plant.use"."""
    return {f"{name}.{key}": value for key, value in table.items()}


def _plugin_names(label: str, use: str) -> str | tuple[str, ...]:
    return _names(label, use, use.rpartition(":")[2])


def _robot_names(label: str, source: str) -> Iterator[str]:
    """Yield names of a robot besides its label: without its base, as written, and its file."""
    for base in BASES.values():
        if base and label.endswith(base):
            yield label.removesuffix(base)
    yield source
    if "/" in source:
        yield PurePosixPath(source).stem


def _names(*names: str) -> str | tuple[str, ...]:
    different = tuple(dict.fromkeys(names))
    return different[0] if len(different) == 1 else different
