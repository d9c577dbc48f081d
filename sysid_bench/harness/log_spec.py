"""Specifications and labels of a suite's [[log]]: recordings in place of simulations."""

import itertools
from collections.abc import Iterator, Mapping
from typing import Any, Final

from sysid_bench.experiments.spec import ExperimentSpec, normal_prior
from sysid_bench.harness.labels import plugin_label, terms_label
from sysid_bench.harness.plan_size import prior_table
from sysid_bench.harness.suite.model import LogEntry
from sysid_bench.signals.log_description import name_of
from sysid_bench.signals.pipeline_choice import PLAIN, default_log_pipeline, pipeline_spec
from sysid_bench.words import LABELS

RECORDED: Final[Mapping[str, Any]] = {"use": "recorded"}
"""In place of the plant, excitation and simulation of a simulated experiment."""


def spec_of_log(entry: LogEntry) -> Iterator[ExperimentSpec]:
    """Yield one specification for each combination of the sweeps of a log."""
    sweeps = itertools.product(
        entry.terms,
        entry.choose,
        entry.filter,
        entry.moving,
        entry.pipeline or (None,),
        entry.prior,
        entry.share,
    )
    for terms, choose, filter, moving, pipeline, prior, share in sweeps:
        written = _written_signals(filter, entry.derivatives)
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
                **_unswept(entry),
            },
        )


def _written_signals(filter: str | None, derivatives: str | None) -> dict[str, Any]:
    """Return the settings of signals that are not the default ones."""
    signals = {"filter": filter, "derivatives": derivatives}
    return {key: value for key, value in signals.items() if value not in (None, "default")}


def _unswept(entry: LogEntry) -> dict[str, Any]:
    """Return the keys of a log that all its experiments share."""
    return {
        "test": list(entry.test),
        "accept": list(entry.accept),
        "position_given": entry.position_given,
        "true_mass": entry.true_mass,
        **({} if entry.feasible == "terms" else {"feasible": entry.feasible}),
        **_controller(entry),
    }


def _first_part(log: Any, share: float) -> Any:
    """Return a log as written, or its first part."""
    if share == 1.0:
        return log
    return {**({"use": log} if isinstance(log, str) else log), "share": share}


def _share_label(spec: ExperimentSpec) -> str:
    """Return ", first 10 %" for an experiment with a part of its training logs."""
    assert spec.log is not None
    shares = {log.get("share", 1.0) for log in spec.log["train"] if isinstance(log, Mapping)}
    return "".join(f", first {100 * share:g} %" for share in sorted(shares) if share != 1.0)


def _controller(entry: LogEntry) -> dict[str, Any]:
    """Return the declared controller as written; nothing without one."""
    if entry.controller is None:
        return {}
    return {"controller": entry.controller.model_dump(mode="json", exclude_unset=True)}


def _pipeline_label(pipeline: Mapping[str, Any] | None) -> str:
    """Return "parallel cutoff=6 Hz" for the pipeline of a log."""
    return plugin_label(pipeline or {"use": PLAIN})[1]


def _prior_label(prior: str | Mapping[str, Any]) -> str:
    """Return "model", "none", or "mass=0.2, inertia=0.3" for the prior of a log."""
    if isinstance(prior, str):
        return prior
    return ", ".join(f"{key}={value:g}" for key, value in prior.items())


def log_labels(entry: LogEntry, spec: ExperimentSpec, robot: str) -> dict[str, str]:
    """Return the labels of rows of recordings: `excitation` names the training logs, `held_out` the
    test logs."""
    labels = {
        "robot": robot,
        "task": spec.task,
        "terms": _terms_label(spec),
        "excitation": entry.label + _share_label(spec),
        "motions": str(len(entry.train)),
        "held_out": ", ".join(map(name_of, entry.test)) or "none",
        "signals": _signals_label(spec),
        "pipeline": _pipeline_label(spec.pipeline),
        "prior": _prior_label(spec.prior),
    }
    return {axis: labels.get(axis, "recorded") for axis in LABELS if axis != "estimator"}


def _terms_label(spec: ExperimentSpec) -> str:
    """Return "default; choose stribeck" for the joint terms of a log, and the candidates."""
    assert spec.log is not None
    chosen = " ".join(spec.log["choose"])
    return f"{terms_label(spec)}; choose {chosen}" if chosen else terms_label(spec)


def _signals_label(spec: ExperimentSpec) -> str:
    """Return "default, central, |v| >= 0.01" for the signals of a log."""
    assert spec.log is not None
    names = [spec.signals.get(key, "default") for key in ("filter", "derivatives")]
    moving = [f"|v| >= {spec.log['moving']:g}"] if spec.log["moving"] else []
    return ", ".join(map(str, [*names, *moving]))
