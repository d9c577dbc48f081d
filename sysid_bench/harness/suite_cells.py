"""Cells of a suite: all combinations of its axes, and its recordings, with each estimator."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from sysid_bench.canonical_json import canonical
from sysid_bench.experiments.simulated.composed_plant import has_exact_motion, has_exact_positions
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    normal_candidate,
    normal_noise,
    normal_payload,
    normal_prior,
)
from sysid_bench.harness.cell import Cell, CellLabels
from sysid_bench.harness.cell_cost import cell_cost
from sysid_bench.harness.labels import labels_of, robot_key, terms_label
from sysid_bench.harness.log_spec import log_labels, spec_of_log
from sysid_bench.harness.plan_size import has_random_sensors, is_random_prior, prior_table
from sysid_bench.harness.suite.data_entries import Signals
from sysid_bench.harness.suite.model import Suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.harness.suite.plugin_entries import Pipeline
from sysid_bench.models.payload import parse_payload
from sysid_bench.signals.pipeline_choice import (
    PLAIN,
    default_pipeline,
    is_plain,
    pipeline_spec,
    signals_of_pipeline,
)
from sysid_bench.units import quantity
from sysid_bench.words import LABELS

_VALUES: Final = (
    "payload", "task", "plant", "prior", "excitation", "held_out", "simulation", "noise",
)  # fmt: skip
"""Axes whose labels are by the value of an experiment."""
OWN: Final = "of the pipeline"
"""Label of signals where the pipeline has settings of its own."""
OF_PLAIN: Final = {"filter": "none", "derivatives": "exact", "torque": "filtered"}
"""Settings of `signals` that are not written; ids hold them."""


def is_random(spec: ExperimentSpec) -> bool:
    """True where the repeats of an experiment differ from each other."""
    played = spec.log is None and has_exact_motion(spec)
    drawn = bool(spec.redrawn) or has_random_sensors(spec.plant)
    return not played or drawn or bool(spec.noise) or is_random_prior(spec.prior)


def suite_cells(suite: Suite, names: Names) -> list[Cell]:
    """Return the cells of recordings, then those of simulated experiments."""
    label = labels_of(suite, names)
    methods = [
        (estimator.spec, label["estimator"][canonical(estimator.spec)])
        for estimator in suite.estimator
    ]
    cells: list[Cell] = []
    for spec, labels in _recorded(suite, names):
        cells += _cells(spec, labels, {}, methods)
    for spec, facts in _simulated(suite, names):
        cells += _cells(spec, _experiment_labels(spec, label), facts, methods)
    return cells


def _cells(
    spec: ExperimentSpec,
    labels: Mapping[str, str],
    facts: Mapping[str, Any],
    methods: Sequence[tuple[Mapping[str, Any], str]],
) -> Iterator[Cell]:
    """Yield the cells of an experiment, one for each (specification, label) of a method."""
    for estimator, name in methods:
        seconds = _cost(spec, estimator, len(methods))
        yield Cell(spec, estimator, CellLabels(labels, name), facts, seconds)


def _simulated(suite: Suite, names: Names) -> Iterator[tuple[ExperimentSpec, dict[str, Any]]]:
    """Yield the simulated experiments with the facts about their robot and payload."""
    for entry, source in suite.robots:
        robot, free_base = names.robot(source, suite.folder), entry.free_base
        free = bool(robot.free_base) if free_base is None else free_base
        for written in entry.payloads:
            facts = {"robot.free_base": free, "payload.mass": names.payload(written).mass}
            for spec in _specs(suite, source, normal_payload(written)):
                yield replace(spec, free_base=free_base, sensor=entry.sensor), facts


def _recorded(suite: Suite, names: Names) -> Iterator[tuple[ExperimentSpec, dict[str, str]]]:
    """Yield the experiments of recordings with their labels, that of the estimator empty."""
    for entry in suite.log:
        for spec in spec_of_log(entry):
            robot = names.robot(spec.robot, suite.folder).name
            yield spec, {**log_labels(entry, spec, robot), "estimator": ""}


def _specs(suite: Suite, robot: str, payload: str | dict[str, Any]) -> Iterator[ExperimentSpec]:
    axes = suite.defaults
    for task, terms, plant in itertools.product(axes.task, axes.terms, axes.plant):
        simulations, noises, pipelines = axes.of(plant)
        for prior, excitation, motions, held_out, simulation, rate, noise, signals, line in (
            itertools.product(
                axes.prior, axes.excitation, axes.motions, axes.held_out, simulations, axes.rate,
                noises, axes.signals, pipelines,
            )
        ):  # fmt: skip
            written = _signals(signals)
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
                signals={},
                repeat=0,
                motions=motions,
                redrawn=tuple(sorted(set(axes.redrawn))),
                candidate=normal_candidate(axes.candidate.model_dump(exclude_none=True)),
            )
            spec = _with_pipeline(spec, line, written)
            repeats = suite.run.repeats if is_random(spec) else 1
            yield from (replace(spec, repeat=repeat) for repeat in range(repeats))


def _with_pipeline(
    spec: ExperimentSpec, named: Pipeline | None, signals: Mapping[str, Any]
) -> ExperimentSpec:
    """Return the specification with its pipeline, named or the default one, and the settings of
    the written `signals` that it uses."""
    if named is None:
        pipeline = default_pipeline(signals, has_exact_positions(spec))
    else:
        pipeline = pipeline_spec(named.spec)
    if is_plain(pipeline):
        signals = {**OF_PLAIN, **signals}
    return replace(spec, pipeline=pipeline, signals=signals_of_pipeline(signals, pipeline))


def _signals(signals: Signals) -> dict[str, Any]:
    """Return the table of signals as JSON. Defaults of keys that are younger than ids are left out,
    so that ids stay."""
    written = signals.model_dump(exclude_none=True)
    if signals.runs == "B":
        del written["runs"]
    if signals.calibration is not None:
        written["calibration"] = [normal_payload(load) for load in signals.calibration]
    return written


def _experiment_labels(
    spec: ExperimentSpec, label: Mapping[str, Mapping[str, str]]
) -> dict[str, str]:
    """Labels of the cells of an experiment in their order; that of the estimator is empty."""
    keys = {
        **{axis: getattr(spec, axis) for axis in _VALUES},
        "robot": robot_key(spec.robot, spec.free_base, spec.sensor),
        "pipeline": spec.pipeline or {"use": PLAIN},
    }
    texts = {
        **{axis: label[axis][canonical(key)] for axis, key in keys.items()},
        "terms": terms_label(spec),
        "rate": f"{spec.rate:.12g} Hz",
        "motions": str(spec.motions),
        "signals": ", ".join(_signals_texts(spec.signals)),
        "estimator": "",
    }
    return {axis: texts[axis] for axis in LABELS}


def _signals_texts(signals: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a label says of the signals, one after the other."""
    yield f"{signals['filter']}, {signals['derivatives']}" if "filter" in signals else OWN
    if signals.get("torque") == "raw":
        yield "raw torque"
    if loads := signals.get("calibration"):
        yield f"calibrated with {', '.join(parse_payload(load).name for load in loads)}"
    contacts = signals.get("contacts", [])
    if periods := contacts if isinstance(contacts, str) else ", ".join(contacts):
        yield f"contacts {periods}"
    if "runs" in signals:
        yield f"runs {signals['runs']}"


def _cost(spec: ExperimentSpec, estimator: Mapping[str, Any], estimators: int) -> float:
    """Expected CPU seconds of a cell, with its share of the experiment."""
    cost = cell_cost(spec, estimator)
    return cost.experiment / estimators + cost.estimator
