"""One robot, one method: parse, excite, simulate, solve, export."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.errors import EstimationError, ModelError
from sysid_bench.verbs.ft_summary import sensor_lines as sensor_lines

if TYPE_CHECKING:
    from sysid_bench.experiments.spec import ExperimentSpec

STD_FROM: Final = {
    "periods": "from the spread over repeated periods",
    "residuals": "from residuals and how alike neighbouring ones are",
    "textbook": "by the method's own formula",
}

HELD_OUT: Final = ({"use": "fourier-other"}, {"use": "ptp"})
ENCODERS: Final = {"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"}
IDEAL: Final = {"filter": "none", "derivatives": "exact"}
"""Signals: rates come from the encoders once those are noisy."""


def identify(
    model: str | Path,
    task: str = "robot",
    payload: str | Mapping[str, Any] = "none",
    terms: Sequence[str] | None = None,
    estimator: str | None = None,
    noise: Mapping[str, str] | None = None,
    model_out: str | Path | None = None,
    seed: int = 0,
    robots_dir: Path | None = None,
    complete: str | None = None,
    sensor: str | None = None,
    json_out: str | Path | None = None,
    free_base: bool | None = None,
    contacts: Sequence[str] | str | None = None,
) -> dict[str, Any]:
    """Identifies a robot from its own simulation; the answer as `identify --json` prints it.

    `payload` (a name or a table) and `noise` ({"q": "1e-4 rad", "tau": "0.5 %"}) as in a suite;
    `model_out`: the model file again, with the identified values; `json_out`: the answer as a
    file; `free_base` overrides what the robot's manifest says; `contacts`: periods that are left
    out ("10 s to 25 s"), or "detect". `complete`: whole bodies from what
    was identified, those that can exist and lie nearest to the prior in a distance ("entropic",
    "euclidean", "pullback"), so that all of them can be written. Raises UsageError for unknown
    words, ModelError for a model that cannot be used or values that must not be written,
    EstimationError where the method fails.
    """
    from sysid_bench.canonical_json import plain
    from sysid_bench.evaluation.covariance import standard_errors
    from sysid_bench.evaluation.score import score
    from sysid_bench.experiments.robot_cache import cached_robot
    from sysid_bench.experiments.simulated.prepare import identified_terms, prepare
    from sysid_bench.identification.feasibility.completion import completed_estimate
    from sysid_bench.identification.identify import identify as solve
    from sysid_bench.naming import build
    from sysid_bench.tasks.task import named_task
    from sysid_bench.verbs.ft_summary import comparison_fields, excitation_fields
    from sysid_bench.verbs.option_parsing import refuse_ignored_terms
    from sysid_bench.verbs.result import (
        base_of,
        bodies_of,
        changed_parameters,
        joints_of,
        std_from,
        warnings_of,
    )
    from sysid_bench.verbs.write_model import check_estimate, check_target, write_model

    refuse_ignored_terms(task, terms)
    name = estimator or named_task(task).default_estimator
    method = build("estimator", name)
    spec = _spec(str(model), task, payload, terms, noise or {}, seed, sensor, free_base, contacts)
    folder = None if robots_dir is None else str(robots_dir)
    robot = cached_robot(spec.robot, spec.payload, folder, None, free_base)
    if model_out is not None:
        check_target(robot.robot, task, Path(model_out))
    if json_out is not None:
        check_estimate(robot.robot, Path(json_out), None if model_out is None else Path(model_out))
    if not robot.check.ok():
        raise ModelError(f"{robot.robot.name}: the engines disagree: {robot.check.reason()}.")
    ready = prepare(spec, robot)
    definition = ready.task.definition
    estimate = solve(method, ready.problem, ready.experiment)
    told = excitation_fields(ready) if definition.identifies_sub_tree else None
    missing = [told["warning"]] if told and told["warning"] else []
    if estimate.status != "ok":
        raise EstimationError(
            " ".join([f"{name} on {robot.robot.name}: {estimate.reason}", *missing])
        )
    if complete is not None:
        estimate = completed_estimate(estimate, ready.problem, complete)
    figures = score(estimate, ready.problem, ready.held_out, ready.truth, ready.extents)
    sure = standard_errors(ready.problem, estimate)
    bodies = bodies_of(estimate, ready.problem, sure)
    answer = {
        "model": robot.robot.name,
        "file": str(robot.robot.manifest.path),
        "task": task,
        "terms": list(identified_terms(spec, robot.robot, definition)),
        "rows": list(ready.problem.rows),
        "estimator": name,
        "rank": figures.rank,
        "data_rank": figures.data_rank,
        "parameters": figures.parameters,
        "condition": figures.condition,
        "condition_unit": figures.condition_unit,
        "rmse_train": figures.rmse_train,
        "rmse_test": figures.rmse_test,
        "torque_error": figures.torque_error,
        "left_out": ready.left_out,
        "gap": robot.check.gap,
        "std_from": std_from(sure),
        "base": base_of(estimate, ready.problem, sure),
        "bodies": bodies,
        "joints": joints_of(estimate, ready.problem, sure),
        "payload": next(iter(bodies.values())) if definition.identifies_payload else None,
        "completed": complete,
        "feasible": figures.feasible,
        "plausible": figures.plausible,
        "warnings": [
            *robot.robot.repairs,
            *warnings_of(estimate, ready.problem),
            *changed_parameters(estimate, ready.problem),
            *missing,
        ],
    }
    if told is not None:
        answer["sensor"] = told | {"estimation": comparison_fields(spec, ready, estimate)}
    if model_out is not None:
        whole = complete is not None
        write_model(robot.robot, task, estimate, ready.problem, Path(model_out), whole)
        answer["model_out"] = str(model_out)
    answer = dict(plain(answer))
    if json_out is not None:
        Path(json_out).write_text(json.dumps(answer, indent=2) + "\n", encoding="utf-8")
    return answer


def summary(answer: Mapping[str, Any]) -> list[str]:
    """What `identify` tells, in a few lines; a value that means nothing is not printed."""
    lines = [
        f"{answer['model']}, task {answer['task']}, {answer['estimator']}: "
        f"rank {answer['rank']} of {answer['parameters']}, "
        f"condition {_number(answer['condition'])}",
        f"  RMSE {_number(answer['rmse_train'])} in training, {_number(answer['rmse_test'])} on "
        f"other motions, torque error {_number(answer['torque_error'])}",
    ]
    if answer["left_out"]:
        lines.append(f"  {answer['left_out']:.1%} of the samples left out as contacts")
    if "sensor" in answer:
        lines += sensor_lines(answer["sensor"])
    for name, body in answer["bodies"].items():
        mass = _sure(body["mass"], body["std"]["m"], "not identifiable")
        lines.append(f"  {name}: mass {mass}")
        told = [
            f"{key} {_sure(body['parameters'][key], body['std'][key])}"
            for key, verdict in body["identifiable"].items()
            if verdict == "identifiable"
        ]
        lines.append(f"    {', '.join(told) or 'nothing is identifiable on its own'}")
    for name, terms in answer["joints"].items():
        told = [
            f"{term} {_sure(value['value'], value['std'])}"
            if value["identifiable"] == "identifiable"
            else f"{term} not identifiable"
            for term, value in terms.items()
        ]
        lines.append(f"  {name}: {', '.join(told)}")
    if answer["std_from"] is not None:
        lines.append(f"  ±: one standard deviation, {STD_FROM[answer['std_from']]}")
    lines += [f"  warning: {warning}" for warning in answer["warnings"]]
    if answer.get("model_out"):
        lines.append(f"  model: {answer['model_out']}")
    return lines


def _sure(value: float | None, std: float | None, absent: str = "-") -> str:
    told = value is not None and std is not None
    return _number(value, absent) + (f" ± {std:.2g}" if told else "")


def _number(value: float | None, absent: str = "-") -> str:
    return absent if value is None else f"{value:.4g}"


def _spec(
    model: str,
    task: str,
    payload: str | Mapping[str, Any],
    terms: Sequence[str] | None,
    noise: Mapping[str, str],
    seed: int,
    sensor: str | None,
    free_base: bool | None,
    contacts: Sequence[str] | str | None,
) -> "ExperimentSpec":
    """The experiment as a suite with nothing but defaults would have it."""
    from sysid_bench.experiments.spec import ExperimentSpec, normal_noise, normal_payload

    measured = normal_noise(noise)
    signals = ENCODERS if {"q", "quantum"} & set(measured) else IDEAL
    return ExperimentSpec(
        seed=seed,
        robot=model,
        payload=normal_payload(payload),
        task=task,
        terms=None if terms is None else tuple(terms),
        plant={"use": "matched"},
        prior={"mass": 0.2, "com": 0.015, "inertia": 0.3, "terms": 0.3},
        excitation={"use": "fourier"},
        held_out=HELD_OUT,
        simulation={"use": "inverse"},
        rate=200.0,
        noise=measured,
        signals=signals if contacts is None else signals | {"contacts": contacts},
        repeat=0,
        sensor=sensor,
        free_base=free_base,
    )
