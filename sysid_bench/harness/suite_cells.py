"""Cells of a suite: all combinations of its axes, and its recordings, with each estimator."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from math import prod
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.errors import UsageError
from sysid_bench.evaluation.intervals import LEVEL
from sysid_bench.experiments.simulated.composed_plant import (
    COMPOSED,
    has_exact_motion,
    has_exact_positions,
    has_sensor_errors,
    plant_entries,
    plant_name,
)
from sysid_bench.experiments.spec import (
    REDRAWN,
    ExperimentSpec,
    normal_candidate,
    normal_noise,
    normal_payload,
    normal_prior,
)
from sysid_bench.harness.cell import BASES, Cell, CellLabels, cell_cost
from sysid_bench.harness.suite.log_entries import LogEntry
from sysid_bench.harness.suite.model import Suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.harness.suite.plugin_entries import Pipeline
from sysid_bench.models.data_sets import SCHEME
from sysid_bench.models.payload import parse_payload
from sysid_bench.package_folders import robots
from sysid_bench.signals import pipeline_choice
from sysid_bench.signals.log_description import name_of
from sysid_bench.units import quantity
from sysid_bench.words import LABELS

MANY: Final = 1_000_000
"""Most cells of a plan that nobody has to ask for: more are a mistake more often than a wish."""

# --- Size ---------------------------------------------------------------------------------------

_AXES: Final = ("task", "terms", "excitation", "motions", "held_out", "rate", "signals")
_NOISY_AXES: Final = ("plant", "noise", "prior", "simulation", "pipeline")
"""Axes that decide on repeats: an experiment that draws nothing is not repeated."""


def check_size(suite: Suite) -> None:
    """Raise UsageError with the product that makes a suite too large; no cell is made before."""
    products = [_simulated_size(suite)]
    for log in suite.log:
        sweeps: Mapping[str, Sequence[Any]] = {
            "terms": log.terms, "choose": log.choose, "filter": log.filter, "moving": log.moving,
            "pipeline": log.pipeline or (None,), "prior": log.prior, "estimators": suite.estimator,
        }  # fmt: skip
        sizes = {name: len(values) for name, values in sweeps.items()}
        products.append((prod(sizes.values()), _product(sizes)))
    total = sum(count for count, _ in products)
    if total > MANY:
        terms = " + ".join(text for count, text in products if count)
        raise UsageError(
            f"{suite.name!r} has {total:,} cells before any [[exclude]], more than {MANY:,}: "
            f"{terms} = {total:,}. Make a sweep shorter, or plan and run it with --large."
        )


def _simulated_size(suite: Suite) -> tuple[int, str]:
    axes, repeats = suite.defaults, suite.run.repeats
    loads = [len(entry.use) * len(entry.payloads) for entry in suite.robot]
    sizes = {"robots with payloads": sum(loads)}
    if len(loads) == 1:
        (entry,) = suite.robot
        sizes = {"robots": len(entry.use), "payloads": len(entry.payloads)}
    sizes |= {"estimators": len(suite.estimator)}
    sizes |= {axis: len(getattr(axes, axis)) for axis in _AXES}
    kinds = fixed = 0  # combinations of the noisy axes, and those of them that draw nothing
    given = sum(not is_random_prior(normal_prior(written(prior))) for prior in axes.prior)
    for plant in axes.plant:
        simulations, noises, pipelines = axes.of(plant)
        kinds += len(axes.prior) * len(simulations) * len(noises) * len(pipelines)
        if not (axes.redrawn or has_sensor_errors(plant.spec)):
            exact = sum(not normal_noise(noise.model_dump(exclude_none=True)) for noise in noises)
            played = sum(entry.use == "inverse" for entry in simulations)
            fixed += exact * given * played * len(pipelines)
    name = f"kinds of {', '.join(_NOISY_AXES)}"
    noisy = {axis: len(getattr(axes, axis) or (None,)) for axis in _NOISY_AXES}
    if prod(noisy.values()) != kinds:  # plants with a simulation or noise of their own
        noisy = {name: kinds}
    text = _product({**sizes, **noisy, "repeats": repeats})
    if fixed and repeats > 1:
        text += f" (repeats of {kinds - fixed} of {kinds} {name})"
    return prod(sizes.values()) * ((kinds - fixed) * repeats + fixed), text


def _product(sizes: Mapping[str, int]) -> str:
    """Return "3 robots x payloads x 4 rate"; axes of one value are left out."""
    return " x ".join(f"{size:,} {name}" for name, size in sizes.items() if size != 1) or "1"


def is_random(spec: ExperimentSpec) -> bool:
    """True where the repeats of an experiment differ from each other."""
    played = spec.log is None and has_exact_motion(spec)
    drawn = bool(spec.redrawn) or has_sensor_errors(spec.plant)
    return not played or drawn or bool(spec.noise) or is_random_prior(spec.prior)


def is_random_prior(prior: str | Mapping[str, Any]) -> bool:
    """True for a normal prior that each repeat draws again."""
    return not isinstance(prior, str) and bool(prior.get(REDRAWN))


# --- Labels -------------------------------------------------------------------------------------

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
    # Only labels that are not unique get longer: adding a robot leaves those of the others.
    for finer in (long, hashed):
        count = Counter(labels.values())
        labels = {key: finer[key] if count[text] > 1 else text for key, text in labels.items()}
    return labels


def _plugin_label(spec: Mapping[str, Any], label: str | None = None) -> tuple[str, str]:
    """Return short and long text of a plug-in: "Geodesic" and "Geodesic step=0.1"."""
    use = str(spec["use"])
    short = label or use.rpartition(":")[2]
    settings = [f"{key}={value}" for key, value in spec.items() if key not in ("use", "label")]
    if settings:
        return short, " ".join((short, *settings))
    return short, f"{short} ({use})" if ":" in use else short


def _plugin_texts(spec: Mapping[str, Any], label: str | None = None) -> _Choice:
    return spec, *_plugin_label(spec, label or spec.get("label"))


def _plant_texts(spec: Mapping[str, Any]) -> _Choice:
    """Return a plant with its short and its long text: "L2" and "L2 stribeck share=0.2 delay"."""
    if spec["use"] != COMPOSED:
        return _plugin_texts(spec)
    short = plant_name(spec)
    parts = (_plugin_label(part)[1] for _, part in plant_entries(spec))
    return spec, short, " ".join((short, *parts))


def _table_text(written: str | Mapping[str, Any], empty: str) -> str:
    """Return "q 1e-4 rad, tau 0.5 %" for a table of quantities; words stay."""
    if isinstance(written, str):
        return written
    return ", ".join(f"{key} {value}" for key, value in written.items()) or empty


def written(table: BaseModel | str) -> Any:
    """Return the keys of a table that are set; words stay."""
    return table if isinstance(table, str) else table.model_dump(exclude_none=True)


def labels_of(suite: Suite, names: Names) -> dict[str, dict[str, str]]:
    """Return axis -> canonical value -> label."""
    axes = suite.defaults
    of_plants = zip(*map(axes.of, axes.plant), strict=True)
    simulations, noises, pipelines = map(chain.from_iterable, of_plants)
    loads = [load for entry in suite.robot for load in entry.payloads]
    choices: dict[str, list[_Choice]] = {
        **_plugin_choices(suite, simulations, pipelines),
        "payload": [
            (normal_payload(load), names.payload(load).name, _table_text(load, "none"))
            for load in loads
        ],
        "noise": [],
        "prior": [],
        "robot": [],
    }
    for noise in map(written, noises):
        value = normal_noise(dict(noise))
        text = _table_text(noise, "exact") if value else "exact"
        choices["noise"].append((value, text, text))
    for prior in map(written, axes.prior):
        text = _table_text(prior, "none")
        choices["prior"].append((normal_prior(prior), text, text))
    for entry, source in suite.robots:
        manifest, base = names.robot(source, suite.folder), BASES[entry.free_base]
        # The stem of one's own file is no name: beside a robot that has it the path is the label.
        is_stem = _is_path(names, suite, source) and getattr(manifest, "manifest_file", 1) is None
        name = source if is_stem and manifest.name in robots() else manifest.name
        sensor = "" if entry.sensor is None else f" @ {entry.sensor}"
        key = _robot_key(source, entry.free_base, entry.sensor)
        choices["robot"].append((key, name + base, source + base + sensor))
    # Two files of one name are two robots; a data set may have the robot of a name.
    paths = {log.robot for log in suite.log if _is_path(names, suite, log.robot)}
    choices["robot"] += [(one, names.robot(one, suite.folder).name, one) for one in sorted(paths)]
    return {axis: _unique_labels(texts) for axis, texts in choices.items()}


def _plugin_choices(
    suite: Suite, simulations: Iterable[Any], pipelines: Iterable[Any]
) -> dict[str, list[_Choice]]:
    """Return the choices of the axes whose values are plug-ins or lists of them."""
    axes = suite.defaults
    held_out: list[_Choice] = []
    for motions in axes.held_out:
        specs = [motion.spec for motion in motions]
        short, long = map(", ".join, zip(*map(_plugin_label, specs), strict=True))
        held_out.append((specs, short, long))
    # Where no pipeline is named, it is one of those that may be chosen.
    unnamed = [{"use": pipeline_choice.PLAIN}, {"use": pipeline_choice.DEFAULT}]
    return {
        "excitation": [_plugin_texts(entry.spec) for entry in axes.excitation],
        "simulation": [_plugin_texts(entry.spec) for entry in simulations],
        "pipeline": [
            _plugin_texts(spec)
            for entry in pipelines
            for spec in (unnamed if entry is None else [entry.spec])
        ],
        "plant": [_plant_texts(entry.spec) for entry in axes.plant],
        "estimator": [_plugin_texts(entry.spec, entry.label) for entry in suite.estimator],
        "task": [(task, *_plugin_label({"use": task})) for task in axes.task],
        "held_out": held_out,
    }


def _robot_key(source: str, free_base: bool | None, sensor: str | None) -> Any:
    """Return the key of a robot: its source, with base and sensor where the suite sets them."""
    if sensor is not None:
        return [source, free_base, sensor]
    return source if free_base is None else [source, free_base]


def _terms_label(spec: ExperimentSpec) -> str:
    return "default" if spec.terms is None else " ".join(spec.terms) or "none"


# --- Cells --------------------------------------------------------------------------------------


def suite_cells(suite: Suite, names: Names) -> list[Cell]:
    """Return the cells of recordings, then those of simulated experiments."""
    label, identified = labels_of(suite, names), _identities(suite, names)
    methods = [(one.spec, label["estimator"][canonical(one.spec)]) for one in suite.estimator]
    cells: list[Cell] = []

    def add(spec: ExperimentSpec, texts: Mapping[str, str], facts: Mapping[str, Any]) -> None:
        """Add the cells of an experiment, one for each method."""
        shared = {axis: texts.get(axis, "") for axis in LABELS}
        spec = replace(spec, **identified(spec))
        for estimator, name in methods:
            # Expected CPU seconds of a cell, with its share of the experiment.
            cost = cell_cost(spec, estimator)
            seconds = cost.experiment / len(methods) + cost.estimator
            cells.append(Cell(spec, estimator, CellLabels(shared, name), facts, seconds))

    for log in suite.log:
        for spec in _specs_of_log(log):
            name = names.robot(spec.robot, suite.folder).name
            robot = label["robot"].get(canonical(spec.robot), name)
            spec = replace(spec, confidence=_level(suite))
            add(spec, _log_labels(log, spec, robot), {})
    by_value = (
        "payload", "task", "plant", "prior", "excitation", "held_out", "simulation", "noise",
    )  # fmt: skip
    for spec, facts in _simulated_specs(suite, names):
        # By value and not by place, since plants have simulations and noise of their own.
        keys = {
            **{axis: getattr(spec, axis) for axis in by_value},
            "robot": _robot_key(spec.robot, spec.free_base, spec.sensor),
            "pipeline": spec.pipeline or {"use": pipeline_choice.PLAIN},
        }
        texts = {
            **{axis: label[axis][canonical(key)] for axis, key in keys.items()},
            "terms": _terms_label(spec),
            "rate": f"{spec.rate:.12g} Hz",
            "motions": str(spec.motions),
            "signals": ", ".join(_signals_texts(spec.signals)),
        }
        add(spec, texts, facts)
    return cells


def _is_path(names: Names, suite: Suite, robot: str) -> bool:
    """True for a robot that is given by the path of its file."""
    if robot.startswith(SCHEME):
        return False
    return bool(getattr(names.robot(robot, suite.folder), "by_path", False))


def _identities(suite: Suite, names: Names) -> Callable[[ExperimentSpec], dict[str, Any]]:
    """Return a function that gives the fields `content`, `model` and `data` of a specification:
    what its names and paths lead to; each is looked up once."""
    known: dict[str, Any] = {}

    def looked_up(key: str, look: Callable[[], Any]) -> Any:
        if key not in known:
            known[key] = look()
        return known[key]

    def robot_of(spec: ExperimentSpec) -> dict[str, Any]:
        # That of a data set is part of its content, which is known before it is fetched.
        is_of_set = spec.robot.startswith(SCHEME)
        record = None if is_of_set else names.model(spec.robot, suite.folder, spec.free_base)
        if record is None:
            return {}
        by_path = _is_path(names, suite, spec.robot)
        return {"model": record["hash"]} | ({"content": record["hash"]} if by_path else {})

    def data_of(spec: ExperimentSpec) -> dict[str, str]:
        found: dict[str, str] = {}
        motions = [motion.get("file") for motion in (spec.excitation, *spec.held_out)]
        logs = [] if spec.log is None else [*spec.log["train"], *spec.log["test"]]
        for written in (*logs, *(file for file in motions if isinstance(file, str))):
            look = partial(names.content, written, suite.folder or Path())
            found |= looked_up(canonical(written), look)
        return found

    def fields(spec: ExperimentSpec) -> dict[str, Any]:
        robot = partial(robot_of, spec)
        found: dict[str, Any] = looked_up(canonical([spec.robot, spec.free_base]), robot)
        return found | {"data": data_of(spec) or None}

    return fields


def _specs_of_log(entry: LogEntry) -> Iterator[ExperimentSpec]:
    """Yield one specification for each combination of the sweeps of a log."""
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
    recorded = {"use": "recorded"}  # in place of plant, excitation and simulation
    for terms, choose, filter, moving, pipeline, prior, share in itertools.product(
        entry.terms, entry.choose, entry.filter, entry.moving, entry.pipeline or (None,),
        entry.prior, entry.share,
    ):  # fmt: skip
        # Ids are those of what is written: default settings are left out.
        signals = {"filter": filter, "derivatives": entry.derivatives}
        signals = {key: value for key, value in signals.items() if value not in (None, "default")}
        default = pipeline_choice.default_log_pipeline(signals)
        train = list[Any](entry.train)
        if share != 1.0:  # ids of whole logs are those of what is written
            tables = ({"use": log} if isinstance(log, str) else log for log in train)
            train = [{**table, "share": share} for table in tables]
        yield ExperimentSpec(
            seed=0,  # nothing is drawn
            robot=entry.robot,
            payload="none",
            task=entry.task,
            terms=terms,
            plant=recorded,
            prior=normal_prior(written(prior)),
            excitation=recorded,
            held_out=(),
            simulation=recorded,
            rate=0.0,
            noise={},
            signals=signals,
            repeat=0,
            pipeline=default if pipeline is None else pipeline_choice.pipeline_spec(pipeline.spec),
            log={"train": train, "choose": list(choose), "moving": moving, **shared},
        )


def _log_labels(entry: LogEntry, spec: ExperimentSpec, robot: str) -> dict[str, str]:
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
    return {
        **dict.fromkeys(LABELS[:-1], "recorded"),
        "robot": robot,
        "task": spec.task,
        "terms": _terms_label(spec) + (f"; choose {candidates}" if candidates else ""),
        "excitation": entry.label + "".join(parts),
        "motions": str(len(entry.train)),
        "held_out": ", ".join(map(name_of, entry.test)) or "none",
        "signals": ", ".join(signals),
        "pipeline": _plugin_label(spec.pipeline or {"use": pipeline_choice.PLAIN})[1],
        "prior": prior,
    }


def _simulated_specs(suite: Suite, names: Names) -> Iterator[tuple[ExperimentSpec, dict[str, Any]]]:
    """Yield the simulated experiments with the facts about their robot and payload."""
    for entry, source in suite.robots:
        robot, free_base = names.robot(source, suite.folder), entry.free_base
        free = bool(robot.free_base) if free_base is None else free_base
        for load in entry.payloads:
            facts = {"robot.free_base": free, "payload.mass": names.payload(load).mass}
            for spec in _specs(suite, source, normal_payload(load)):
                yield replace(spec, free_base=free_base, sensor=entry.sensor), facts


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
            spec = ExperimentSpec(
                seed=suite.seed,
                robot=robot,
                payload=payload,
                task=task,
                terms=terms,
                plant=plant.spec,
                prior=normal_prior(written(prior)),
                excitation=excitation.spec,
                held_out=tuple(motion.spec for motion in held_out),
                simulation=simulation.spec,
                rate=quantity(rate, "Hz"),
                noise=normal_noise(written(noise)),
                signals={},
                repeat=0,
                motions=motions,
                redrawn=tuple(sorted(set(axes.redrawn))),
                candidate=normal_candidate(written(axes.candidate)),
                confidence=_level(suite),
            )
            # The table of signals as JSON. Defaults of keys that are younger than ids are left
            # out, so that ids stay
            table: dict[str, Any] = written(signals)
            if signals.runs == "B":
                del table["runs"]
            if signals.calibration is not None:
                table["calibration"] = [normal_payload(load) for load in signals.calibration]
            spec = _with_pipeline(spec, line, table)
            repeats = suite.run.repeats if is_random(spec) else 1
            yield from (replace(spec, repeat=repeat) for repeat in range(repeats))


def _level(suite: Suite) -> float | None:
    """Return the confidence level of a suite; None for the usual one: ids are older than the
    key."""
    return None if suite.confidence == LEVEL else suite.confidence


def _with_pipeline(
    spec: ExperimentSpec, named: Pipeline | None, signals: Mapping[str, Any]
) -> ExperimentSpec:
    """Return the specification with its pipeline, named or the default one, and the settings of
    the written `signals` that it uses."""
    if named is None:
        pipeline = pipeline_choice.default_pipeline(signals, has_exact_positions(spec))
    else:
        pipeline = pipeline_choice.pipeline_spec(named.spec)
    if pipeline_choice.is_plain(pipeline):  # ids hold the settings that are not written, too
        signals = {"filter": "none", "derivatives": "exact", "torque": "filtered", **signals}
    return replace(
        spec, pipeline=pipeline, signals=pipeline_choice.signals_of_pipeline(signals, pipeline)
    )


def _signals_texts(signals: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a label says of the signals, one after the other."""
    own = "of the pipeline"  # which has settings of its own
    yield f"{signals['filter']}, {signals['derivatives']}" if "filter" in signals else own
    if signals.get("torque") == "raw":
        yield "raw torque"
    if loads := signals.get("calibration"):
        yield f"calibrated with {', '.join(parse_payload(load).name for load in loads)}"
    contacts = signals.get("contacts", [])
    if periods := contacts if isinstance(contacts, str) else ", ".join(contacts):
        yield f"contacts {periods}"
    if "runs" in signals:
        yield f"runs {signals['runs']}"
