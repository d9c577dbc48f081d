"""Plan of a suite: its cells, one experiment and one estimator each."""

import itertools
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from pathlib import PurePosixPath
from typing import Any

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.errors import SysidBenchError, UsageError, unknown_name
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    normal_noise,
    normal_payload,
    normal_prior,
)
from sysid_bench.harness.labels import BASES, labels_of, robot_key
from sysid_bench.harness.log_specs import log_labels, log_specs
from sysid_bench.harness.plan_size import check_size, has_random_sensors, is_redrawn, prior_table
from sysid_bench.harness.suite.data_entries import Signals
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.model import Suite
from sysid_bench.harness.suite.names import Names, installed_names
from sysid_bench.models.payload import parse_payload
from sysid_bench.units import quantity
from sysid_bench.vocabulary import CELL_FIELDS, LABELS

# Rough cost on one core of 2025: set-up and cross-check of a robot, simulation and regressor per
# sample of a motion, reduction and scores per estimator.
_SETUP_SECONDS = 0.3
_SAMPLE_SECONDS = 1e-4
_ESTIMATOR_SECONDS = 0.05
_ID = '{"id": "'
_LOG_SECONDS = 2.0  # of half a minute of a recording, with a choice of terms


@dataclass(frozen=True)
class Cell:
    """One future row. `facts` are fields that depend on the models behind the names."""

    spec: ExperimentSpec
    estimator: Mapping[str, Any]  # {use, settings...} without a label
    labels: Mapping[str, str]  # vocabulary.LABELS -> text
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
    def head(self) -> dict[str, Any]:
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


@dataclass(frozen=True)
class Plan:
    """Every cell in the order of the suite. `excluded` counts cells per reason."""

    cells: tuple[Cell, ...]
    excluded: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def experiments(self) -> tuple[ExperimentSpec, ...]:
        """The experiments in the order of their first cell."""
        return tuple({cell.experiment: cell.spec for cell in self.cells}.values())

    @property
    def seconds(self) -> float:
        """Expected cost on one worker."""
        return sum(cell.seconds for cell in self.cells)

    @property
    def fields(self) -> frozenset[str]:
        """Names of fields that expressions can read."""
        return CELL_FIELDS.union(*(fields(cell) for cell in self.cells))

    def select(self, text: str | None) -> tuple[Cell, ...]:
        """Return the cells that meet an expression; all of them for None."""
        if text is None:
            return self.cells
        condition = Expression.parse(text, self.fields)
        return tuple(cell for cell in self.cells if condition.matches(fields(cell)))

    def missing_values(self, text: str) -> list[str]:
        """Return a sentence for each text of an expression that no cell has in that field."""
        cell_fields = [fields(cell) for cell in self.cells]
        sentences = []
        for name, wanted in Expression.parse(text, self.fields).text_values:
            values = {word for flat in cell_fields for word in _words(flat.get(name))}
            if values and wanted not in values:
                near = get_close_matches(wanted, sorted(values), n=3, cutoff=0.5)
                shown = near or [*sorted(values)[:8], *["..."][: len(values) > 8]]
                sentences.append(
                    f"No cell has {name} == {wanted!r}; {'nearest' if near else 'there'} "
                    f"{'is' if len(shown) == 1 else 'are'} {', '.join(shown)}."
                )
        return sentences

    def to_json_lines(self) -> str:
        """Text of plan.jsonl, from which a run is resumed without the suite."""
        return "".join(json.dumps(cell.to_json()) + "\n" for cell in self.cells)

    @classmethod
    def from_json_lines(cls, text: str) -> "Plan":
        """Read the cells of a plan.jsonl, which holds neither exclusions nor notes."""
        return cls(tuple(_cell_of(number, line) for number, line in _numbered(text)))


def _check_rankings(suite: Suite, cells: Sequence[Cell]) -> None:
    """Raise UsageError for a ranking against an unknown method, before all is computed."""
    methods = sorted({cell.labels["estimator"] for cell in cells})
    for entry in suite.ranking:
        if entry.against is not None and entry.against not in methods:
            where = f"The ranking {entry.name!r} names it."
            raise unknown_name("estimator of this suite", entry.against, methods, where)


def expand(suite: Suite, names: Names | None = None, *, large: bool = False) -> Plan:
    """Return all cells of a suite, without those of an [[exclude]] and without duplicates.

    Raises UsageError for more than MANY cells, unless `large`.
    """
    if not large:
        check_size(suite)
    cells = _cells(suite, names or installed_names())
    _check_rankings(suite, cells)
    kept, excluded = _exclude(suite, cells)
    unique = {cell.id: cell for cell in reversed(kept)}
    ordered = tuple({cell.id: unique[cell.id] for cell in kept}.values())
    return Plan(ordered, excluded, tuple(_notes(suite, kept, ordered)))


def fields(cell: Cell) -> dict[str, Any]:
    """Return the flat mapping that expressions read; a tuple holds alternative names."""
    spec = cell.spec
    flat: dict[str, Any] = {
        **cell.labels,
        "id": cell.id,
        "experiment": cell.experiment,
        "repeat": spec.repeat,
        "rate": spec.rate,
        "terms": cell.labels["terms"],
        **cell.facts,
        **{f"signals.{key}": value for key, value in spec.signals.items()},
    }
    for key, value in spec.noise.items():
        flat["noise." + key.removesuffix("_relative")] = value
    if not isinstance(spec.prior, str):
        flat |= {f"prior.{key}": value for key, value in spec.prior.items()}
    plugins = {
        "plant": spec.plant,
        "excitation": spec.excitation,
        "simulation": spec.simulation,
        "estimator": cell.estimator,
    }
    for axis, plugin in plugins.items():
        flat |= {f"{axis}.{key}": value for key, value in plugin.items()}
        flat[axis] = _names(cell.labels[axis], plugin["use"], plugin["use"].rpartition(":")[2])
    flat["task"] = _names(cell.labels["task"], spec.task, spec.task.rpartition(":")[2])
    flat["robot"] = _names(cell.labels["robot"], *_robot_names(cell.labels["robot"], spec.robot))
    return flat


def _robot_names(label: str, source: str) -> Iterator[str]:
    """Yield names of a robot besides its label: without its base, as written, and its file."""
    for base in BASES.values():
        if base and label.endswith(base):
            yield label.removesuffix(base)
    yield source
    if "/" in source:
        yield PurePosixPath(source).stem


def _words(value: Any) -> tuple[str, ...]:
    """Return the texts of a field, none for a number."""
    values = value if isinstance(value, tuple) else (value,)
    return tuple(word for word in values if isinstance(word, str))


def _names(*names: str) -> str | tuple[str, ...]:
    different = tuple(dict.fromkeys(names))
    return different[0] if len(different) == 1 else different


def _exclude(suite: Suite, cells: Iterable[Cell]) -> tuple[list[Cell], dict[str, int]]:
    rules = [(Expression.parse(rule.when), rule.reason) for rule in suite.exclude]
    kept, counts = [], {reason: 0 for _, reason in rules}
    for cell in cells:
        flat = fields(cell)
        reason = next((reason for rule, reason in rules if rule.matches(flat)), None)
        if reason is None:
            kept.append(cell)
        else:
            counts[reason] += 1
    return kept, counts


def _notes(suite: Suite, kept: Sequence[Cell], unique: Sequence[Cell]) -> Iterator[str]:
    if suite.run.repeats > 1 and any(_repeats_nothing(cell.spec) for cell in unique):
        yield (
            "Experiments without noise under the simulation 'inverse' give the same numbers each "
            f"time: repeat 0 stands for all {suite.run.repeats}."
        )
    if any(cell.spec.noise and cell.spec.signals["derivatives"] == "exact" for cell in unique):
        yield (
            "Some cells have noise and derivatives = 'exact': their v and a come from ideal "
            "sensors, without noise. signals = { derivatives = 'from q', filter = ... } makes them "
            "from the encoders."
        )
    if len(kept) > len(unique):
        yield f"{len(kept) - len(unique)} cells were specified twice and are run once."


def _repeats_nothing(spec: ExperimentSpec) -> bool:
    simulated = spec.log is None and spec.simulation["use"] == "inverse"
    drawn = is_redrawn(spec.prior) or bool(spec.redrawn)
    return simulated and not spec.noise and not drawn and not has_random_sensors(spec.plant)


def _cells(suite: Suite, names: Names) -> list[Cell]:
    label = labels_of(suite, names)
    drafts = []
    for entry, source in suite.robots:
        robot, free_base = names.robot(source, suite.folder), entry.free_base
        free = bool(robot.free_base) if free_base is None else free_base
        for written in entry.payloads:
            payload = names.payload(written)
            facts = {"robot.free_base": free, "payload.mass": payload.mass}
            drafts += [
                (replace(spec, free_base=free_base, sensor=entry.sensor), facts)
                for spec in _specs(suite, source, normal_payload(written))
            ]
    estimators = [estimator.spec for estimator in suite.estimator]
    return _log_cells(suite, names, label["estimator"]) + [
        Cell(
            spec, estimator, _labelled(spec, estimator, label), facts, _cost(spec, len(estimators))
        )
        for spec, facts in drafts
        for estimator in estimators
    ]


def _log_cells(suite: Suite, names: Names, label: Mapping[str, str]) -> list[Cell]:
    """Cells of recordings, whose labels of simulation read "recorded"."""
    cells = []
    estimators = [estimator.spec for estimator in suite.estimator]
    drafts = [(entry, spec) for entry in suite.log for spec in log_specs(entry)]
    for entry, spec in drafts:
        labels = log_labels(entry, spec, names.robot(spec.robot, suite.folder).name)
        seconds = _SETUP_SECONDS / len(estimators) + _LOG_SECONDS
        cells += [
            Cell(spec, estimator, {**labels, "estimator": label[canonical(estimator)]}, {}, seconds)
            for estimator in estimators
        ]
    return cells


def _specs(suite: Suite, robot: str, payload: str | dict[str, Any]) -> Iterator[ExperimentSpec]:
    axes = suite.defaults
    for task, terms, plant, prior, excitation, held_out, simulation, rate, noise, signals in (
        itertools.product(
            axes.task, axes.terms, axes.plant, axes.prior, axes.excitation, axes.held_out,
            axes.simulation, axes.rate, axes.noise, axes.signals,
        )
    ):  # fmt: skip
        spec = ExperimentSpec(
            seed=suite.seed,
            robot=robot,
            payload=payload,
            task=task,
            terms=terms,
            plant=plant.spec,
            prior=normal_prior(prior_table(prior)),
            excitation=excitation.spec,
            held_out=tuple(motion.spec for motion in held_out),
            simulation=simulation.spec,
            rate=quantity(rate, "Hz"),
            noise=normal_noise(noise.model_dump(exclude_none=True)),
            signals=_signals(signals),
            repeat=0,
        )
        repeats = 1 if _repeats_nothing(spec) else suite.run.repeats
        yield from (replace(spec, repeat=repeat) for repeat in range(repeats))


def _signals(signals: Signals) -> dict[str, Any]:
    """Return the table of signals as JSON. Defaults of keys that are younger than ids are left out,
    so that ids stay."""
    written = signals.model_dump(exclude_none=True)
    if signals.runs == "B":
        del written["runs"]
    if signals.calibration is not None:
        written["calibration"] = [normal_payload(load) for load in signals.calibration]
    return written


def _labelled(
    spec: ExperimentSpec, estimator: Mapping[str, Any], label: Mapping[str, Mapping[str, str]]
) -> dict[str, str]:
    plain = {
        "robot": label["robot"][canonical(robot_key(spec.robot, spec.free_base, spec.sensor))],
        "task": label["task"][canonical(spec.task)],
        "terms": "default" if spec.terms is None else " ".join(spec.terms) or "none",
        "rate": f"{spec.rate:.12g} Hz",
        "signals": _signals_text(spec.signals),
        "estimator": label["estimator"][canonical(estimator)],
    }
    found = {
        axis: label[axis][canonical(getattr(spec, axis))] for axis in LABELS if axis not in plain
    }
    return {axis: plain.get(axis) or found[axis] for axis in LABELS}


def _signals_text(signals: Mapping[str, Any]) -> str:
    raw = ", raw torque" if signals.get("torque") == "raw" else ""
    loads = [parse_payload(load).name for load in signals.get("calibration", ())]
    calibrated = f", calibrated with {', '.join(loads)}" if loads else ""
    runs = f", runs {signals['runs']}" if "runs" in signals else ""
    contacts = signals.get("contacts", [])
    periods = contacts if isinstance(contacts, str) else ", ".join(contacts)
    free = f", contacts {periods}" if periods else ""
    return f"{signals['filter']}, {signals['derivatives']}{raw}{calibrated}{free}{runs}"


def _cost(spec: ExperimentSpec, estimators: int) -> float:
    period = _number(spec.excitation.get("period"), "s", 5.0)
    cycles = _number(spec.excitation.get("cycles"), "1", 2.0)
    samples = period * cycles * spec.rate * (1 + len(spec.held_out))
    return (_SETUP_SECONDS + _SAMPLE_SECONDS * samples) / estimators + _ESTIMATOR_SECONDS


def _number(written: Any, unit: str, default: float) -> float:
    try:
        return quantity(written, unit)
    except SysidBenchError:  # a plug-in may use this key for something else
        return default


def _numbered(text: str) -> Iterator[tuple[int, str]]:
    return ((n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip())


def planned_ids(text: str) -> tuple[str, ...]:
    """Return the ids of the cells of a plan.jsonl."""
    return tuple(_id_of(number, line) for number, line in _numbered(text))


def _id_of(number: int, line: str) -> str:
    """Id of a line. Plans begin each line with it: parsing the rest would take 20 times as long."""
    begins, name, ends = line[: len(_ID)], line[len(_ID) : len(_ID) + 12], line[len(_ID) + 12 :]
    if begins == _ID and name.isalnum() and ends.startswith('", ') and ends.endswith("}"):
        return name
    return _cell_of(number, line).id


def planned_heads(text: str) -> Iterator[dict[str, Any]]:
    """Yield `Cell.head` of each cell of a plan.jsonl, without the rest of the cell."""
    for number, line in _numbered(text):
        try:
            data = json.loads(line)
            labels = {sys.intern(key): sys.intern(word) for key, word in data["labels"].items()}
            repeat = data["spec"]["repeat"]
            head = {"id": data["id"], "experiment": data["experiment"], **labels, "repeat": repeat}
        except (ValueError, KeyError, TypeError):
            head = _cell_of(number, line).head  # raises with the reason
        yield head


def _cell_of(number: int, line: str) -> Cell:
    try:
        data = json.loads(line)
        spec = ExperimentSpec.from_json(data["spec"])
        cell = Cell(spec, data["estimator"], data["labels"], data["facts"], data["seconds"])
        written_id, read_id = data["id"], cell.id
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(f"plan.jsonl:{number}: not a valid cell ({error!r}).") from error
    if read_id != written_id:
        raise UsageError(
            f"plan.jsonl:{number}: the cell {written_id} reads as {read_id} with this version of "
            "sysid_bench; run the suite into another folder (-o)."
        )
    return cell
