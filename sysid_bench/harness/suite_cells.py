"""Cells of a suite: all combinations of its axes, and its recordings, with each estimator."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import prod
from typing import Any, Final

from sysid_bench.canonical_json import canonical
from sysid_bench.errors import UsageError
from sysid_bench.experiments.simulated.composed_plant import (
    has_exact_motion,
    has_exact_positions,
    has_sensor_errors,
)
from sysid_bench.experiments.spec import (
    REDRAWN,
    ExperimentSpec,
    normal_candidate,
    normal_noise,
    normal_payload,
    normal_prior,
)
from sysid_bench.harness.cell import (
    Cell,
    CellLabels,
    cell_cost,
    labels_of,
    plugin_label,
    robot_key,
    terms_label,
)
from sysid_bench.harness.suite.data_entries import Pipeline, Plant, Signals, prior_table
from sysid_bench.harness.suite.model import LogEntry, Suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.models.payload import parse_payload
from sysid_bench.signals.log_description import name_of
from sysid_bench.signals.pipeline_choice import (
    PLAIN,
    default_log_pipeline,
    default_pipeline,
    is_plain,
    pipeline_spec,
    signals_of_pipeline,
)
from sysid_bench.units import quantity
from sysid_bench.words import LABELS

RECORDED: Final[Mapping[str, Any]] = {"use": "recorded"}
"""In place of the plant, excitation and simulation of a simulated experiment."""


def spec_of_log(entry: LogEntry) -> Iterator[ExperimentSpec]:
    """Yield one specification for each combination of the sweeps of a log."""
    sweeps = itertools.product(
        entry.terms, entry.choose, entry.filter, entry.moving, entry.pipeline or (None,),
        entry.prior, entry.share,
    )  # fmt: skip
    shared = {
        "test": list(entry.test),
        "accept": list(entry.accept),
        "position_given": entry.position_given,
        "true_mass": entry.true_mass,
    }
    # Keys that are younger than ids are left out where they are not written, so that ids stay.
    if entry.feasible != "terms":
        shared["feasible"] = entry.feasible
    if entry.controller is not None:
        shared["controller"] = entry.controller.model_dump(mode="json", exclude_unset=True)
    for terms, choose, filter, moving, pipeline, prior, share in sweeps:
        # Ids are those of what is written: default settings are left out.
        signals = {"filter": filter, "derivatives": entry.derivatives}
        written = {key: value for key, value in signals.items() if value not in (None, "default")}
        default = default_log_pipeline(written)
        yield ExperimentSpec(
            seed=0,  # nothing is drawn
            robot=entry.robot,
            payload="none",
            task=entry.task,
            terms=terms,
            plant=RECORDED,
            prior=normal_prior(prior_table(prior)),
            excitation=RECORDED,
            held_out=(),
            simulation=RECORDED,
            rate=0.0,
            noise={},
            signals=written,
            repeat=0,
            pipeline=default if pipeline is None else pipeline_spec(pipeline.spec),
            log={
                "train": [_first_part(log, share) for log in entry.train],
                "choose": list(choose),
                "moving": moving,
                **shared,
            },
        )


def _first_part(log: Any, share: float) -> Any:
    """Return a log as written, or its first part."""
    if share == 1.0:
        return log
    return {**({"use": log} if isinstance(log, str) else log), "share": share}


def log_labels(entry: LogEntry, spec: ExperimentSpec, robot: str) -> dict[str, str]:
    """Return the labels of rows of recordings: `excitation` names the training logs, `held_out` the
    test logs."""
    assert spec.log is not None
    shares = {log.get("share", 1.0) for log in spec.log["train"] if isinstance(log, Mapping)}
    parts = [f", first {100 * share:g} %" for share in sorted(shares) if share != 1.0]
    candidates = " ".join(spec.log["choose"])
    signals = [str(spec.signals.get(key, "default")) for key in ("filter", "derivatives")]
    if spec.log["moving"]:
        signals.append(f"|v| >= {spec.log['moving']:g}")
    prior = spec.prior
    if not isinstance(prior, str):
        prior = ", ".join(f"{key}={value:g}" for key, value in prior.items())
    labels = {
        "robot": robot,
        "task": spec.task,
        "terms": terms_label(spec) + (f"; choose {candidates}" if candidates else ""),
        "excitation": entry.label + "".join(parts),
        "motions": str(len(entry.train)),
        "held_out": ", ".join(map(name_of, entry.test)) or "none",
        "signals": ", ".join(signals),
        "pipeline": plugin_label(spec.pipeline or {"use": PLAIN})[1],
        "prior": prior,
    }
    return {axis: labels.get(axis, "recorded") for axis in LABELS if axis != "estimator"}


MANY: Final = 1_000_000
"""Most cells of a plan that nobody has to ask for: more are a mistake more often than a wish."""

_AXES: Final = ("task", "terms", "excitation", "motions", "held_out", "rate", "signals")
_NOISY_AXES: Final = ("plant", "noise", "prior", "simulation", "pipeline")
"""Axes that decide on repeats: an experiment that draws nothing is not repeated."""


def check_size(suite: Suite) -> None:
    """Raise UsageError with the product that makes a suite too large."""
    products = [_simulated(suite), *(_recorded(suite, log) for log in suite.log)]
    total = sum(count for count, _ in products)
    if total > MANY:
        terms = " + ".join(text for count, text in products if count)
        raise UsageError(
            f"{suite.name!r} has {total:,} cells before any [[exclude]], more than {MANY:,}: "
            f"{terms} = {total:,}. Make a sweep shorter, or plan and run it with --large."
        )


def is_random_prior(prior: str | Mapping[str, Any]) -> bool:
    """True for a normal prior that each repeat draws again."""
    return not isinstance(prior, str) and bool(prior.get(REDRAWN))


def _simulated(suite: Suite) -> tuple[int, str]:
    axes = suite.defaults
    if len(suite.robot) == 1:
        (entry,) = suite.robot
        sizes = {"robots": len(entry.use), "payloads": len(entry.payloads)}
    else:
        loaded = (len(entry.use) * len(entry.payloads) for entry in suite.robot)
        sizes = {"robots with payloads": sum(loaded)}
    sizes |= {"estimators": len(suite.estimator)}
    sizes |= {axis: len(getattr(axes, axis)) for axis in _AXES}
    repeats = suite.run.repeats
    kinds = [_kinds(suite, plant) for plant in axes.plant]
    drawn, fixed = (sum(counts) for counts in zip(*kinds, strict=True))
    count = prod(sizes.values()) * (drawn * repeats + fixed)
    noisy = {axis: len(getattr(axes, axis) or (None,)) for axis in _NOISY_AXES}
    if prod(noisy.values()) != drawn + fixed:  # plants with a simulation or noise of their own
        noisy = {f"kinds of {', '.join(_NOISY_AXES)}": drawn + fixed}
    text = _product({**sizes, **noisy, "repeats": repeats})
    if fixed and repeats > 1:
        text += f" (repeats of {drawn} of {drawn + fixed} kinds of {', '.join(_NOISY_AXES)})"
    return count, text


def _kinds(suite: Suite, plant: Plant) -> tuple[int, int]:
    """Numbers of combinations of the axes of noise with a plant that draw something, and that do
    not."""
    axes = suite.defaults
    simulations, noises, pipelines = axes.of(plant)
    count = len(axes.prior) * len(simulations) * len(noises) * len(pipelines)
    exact = sum(not normal_noise(noise.model_dump(exclude_none=True)) for noise in noises)
    given = sum(not is_random_prior(normal_prior(prior_table(prior))) for prior in axes.prior)
    if axes.redrawn:
        return count, 0
    played = sum(entry.use == "inverse" for entry in simulations)
    fixed = (not has_sensor_errors(plant.spec)) * exact * given * played * len(pipelines)
    return count - fixed, fixed


def _recorded(suite: Suite, log: LogEntry) -> tuple[int, str]:
    sweeps: Mapping[str, Sequence[Any]] = {
        "terms": log.terms, "choose": log.choose, "filter": log.filter, "moving": log.moving,
        "pipeline": log.pipeline or (None,), "prior": log.prior, "estimators": suite.estimator,
    }  # fmt: skip
    sizes = {name: len(values) for name, values in sweeps.items()}
    return prod(sizes.values()), _product(sizes)


def _product(sizes: Mapping[str, int]) -> str:
    """Return "3 robots x payloads x 4 rate"; axes of one value are left out."""
    return " x ".join(f"{size:,} {name}" for name, size in sizes.items() if size != 1) or "1"


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
    drawn = bool(spec.redrawn) or has_sensor_errors(spec.plant)
    return not played or drawn or bool(spec.noise) or is_random_prior(spec.prior)


def suite_cells(suite: Suite, names: Names) -> list[Cell]:
    """Return the cells of recordings, then those of simulated experiments."""
    label = labels_of(suite, names)
    methods = [
        (estimator.spec, label["estimator"][canonical(estimator.spec)])
        for estimator in suite.estimator
    ]
    cells: list[Cell] = []
    for spec, labels in _recorded_specs(suite, names):
        cells += _cells(spec, labels, {}, methods)
    for spec, facts in _simulated_specs(suite, names):
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
        cells += _cells(spec, {axis: texts[axis] for axis in LABELS}, facts, methods)
    return cells


def _cells(
    spec: ExperimentSpec,
    labels: Mapping[str, str],
    facts: Mapping[str, Any],
    methods: Sequence[tuple[Mapping[str, Any], str]],
) -> Iterator[Cell]:
    """Yield the cells of an experiment, one for each (specification, label) of a method."""
    for estimator, name in methods:
        # Expected CPU seconds of a cell, with its share of the experiment.
        cost = cell_cost(spec, estimator)
        seconds = cost.experiment / len(methods) + cost.estimator
        yield Cell(spec, estimator, CellLabels(labels, name), facts, seconds)


def _simulated_specs(suite: Suite, names: Names) -> Iterator[tuple[ExperimentSpec, dict[str, Any]]]:
    """Yield the simulated experiments with the facts about their robot and payload."""
    for entry, source in suite.robots:
        robot, free_base = names.robot(source, suite.folder), entry.free_base
        free = bool(robot.free_base) if free_base is None else free_base
        for written in entry.payloads:
            facts = {"robot.free_base": free, "payload.mass": names.payload(written).mass}
            for spec in _specs(suite, source, normal_payload(written)):
                yield replace(spec, free_base=free_base, sensor=entry.sensor), facts


def _recorded_specs(suite: Suite, names: Names) -> Iterator[tuple[ExperimentSpec, dict[str, str]]]:
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
