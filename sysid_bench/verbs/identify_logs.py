"""One robot, one method, recordings of the real thing."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import EstimationError, UsageError

if TYPE_CHECKING:
    from sysid_bench.harness.experiment.recorded import Posed, Processed, Selection, Treatment
    from sysid_bench.signals.log_description import LogDescription

FILTER: Final = "butter 4 10 Hz zero-phase"
"""Robots move below it: on a UR10e, cut-offs of 3 to 20 Hz changed the error by less than 0.3 of
7.5 % (measured)."""

SLOW: Final = 30.0
"""Hz; at lower rates that filter would touch the motion itself, and is left out."""

TERMS: Final = ("viscous", "coulomb", "offset")
"""What real joints have, where the robot's manifest says nothing."""

DENOMINATOR: Final = "RMS of the measured torque, filtered as told, over the same samples"

REPEATS: Final = 0.05
"""A test motion whose states (q, v in units of their spread) lie nearer than this to training
states, in the median, is the training motion again (measured: 0.02 against 0.3 and more)."""


def identify_logs(
    model: str | Path,
    logs: Sequence[str | Path],
    tests: Sequence[str | Path] = (),
    task: str = "robot",
    terms: Sequence[str] | None = None,
    estimator: str | None = None,
    filter: str | None = None,
    derivatives: str | None = None,
    moving: float = 0.0,
    candidates: Sequence[str] = (),
    position_given: bool = False,
    accept: Sequence[str] = (),
    model_out: str | Path | None = None,
    figure: str | Path | None = None,
    robots_dir: Path | None = None,
) -> dict[str, Any]:
    """Identifies a robot from recordings; the answer as `identify --log --json` prints it.

    `candidates`: joint terms and features ("play", "tanh", "poly", or one of your own) of which
    cross-validation inside of the training recordings takes what helps. `position_given`: with the
    task `payload`, its mass is the only unknown of it.
    `derivatives`: "from q", or "from v" (the default where every log has v). Raises UsageError for
    descriptions, files or words that cannot be, and for contradictions in the data that `accept`
    does not name; EstimationError where the method fails.
    """
    from sysid_bench.evaluation.covariance import spreads
    from sysid_bench.evaluation.recorded import overall, torque_error
    from sysid_bench.harness.canonical import plain
    from sysid_bench.harness.experiment.recorded import locked_manifest, pose_logs, processed
    from sysid_bench.identification.identify import identify as solve
    from sysid_bench.models.load import load_robot
    from sysid_bench.models.manifest import find_manifest
    from sysid_bench.naming import build
    from sysid_bench.signals.log_checks import refuse
    from sysid_bench.signals.log_description import read_description
    from sysid_bench.verbs.answer import base_of, bodies_of, joints_of, std_from, warnings_of
    from sysid_bench.verbs.model_out import check_target, write_model

    descriptions = [read_description(Path(log)) for log in (*logs, *tests)]
    name = estimator or "wls"
    method = build("estimator", name)
    manifest = find_manifest(str(model), robots_dir)
    whole = load_robot(manifest)
    if model_out is not None:
        check_target(whole, task, Path(model_out))
    manifest = locked_manifest(manifest, whole, descriptions)
    treatment = _treatment(descriptions, filter, derivatives, moving)
    read = [processed(description, manifest, treatment) for description in descriptions]
    for one in read:
        refuse(one.log.findings, accept, str(one.log.description.source))
    robot = read[0].robot
    chosen = _terms(robot.manifest.terms, robot.rows) if terms is None else tuple(terms)
    training = read[: len(logs)]
    testing = dict(zip(_labels(tests), read[len(logs) :], strict=True))
    if position_given and task != "payload":
        raise UsageError("A given position is one of the task 'payload'.")
    posed = pose_logs(task, chosen, training, testing, treatment, tuple(candidates), position_given)
    estimate = solve(method, posed.problem, posed.experiment)
    if estimate.status != "ok" or estimate.beta is None:
        raise EstimationError(f"{name} on {manifest.name}: {estimate.reason}")
    beta = estimate.beta
    sure = spreads(posed.problem, estimate)
    bodies = bodies_of(estimate, posed.problem, sure)
    answer = {
        "model": manifest.name,
        "file": str(manifest.path),
        "task": task,
        "terms": list(chosen),
        "rows": list(posed.problem.rows),
        "locked": dict(manifest.locked),
        "estimator": name,
        "signals": _told(treatment),
        "denominator": DENOMINATOR,
        "selection": None if posed.selection is None else _selection(posed.selection),
        **_data_figures(posed.problem),
        "rmse_train": overall(posed.problem, beta),
        "rmse_test": _mean([overall(test, beta) for test in posed.tests.values()]),
        "torque_error": torque_error(posed.tests, beta),
        "training": _joint_table(posed.problem, beta),
        "tests": {label: _joint_table(test, beta) for label, test in posed.tests.items()},
        "logs": [_segment(one, one in training) for one in read],
        "std_from": std_from(sure),
        "base": base_of(estimate, posed.problem, sure),
        "bodies": bodies,
        "joints": joints_of(estimate, posed.problem, sure),
        "payload": None
        if task != "payload"
        else _mass(method, posed, beta)
        if position_given
        else list(bodies.values())[-1],
        "feasible": _feasible(estimate.theta, posed.problem),
        "warnings": [
            *robot.repairs,
            *_findings(read),
            *_repeated(training, testing),
            *warnings_of(estimate, posed.problem),
        ],
    }
    if figure is not None:
        _draw(Path(figure), posed, next(iter(testing.values()), training[0]), beta)
        answer["figure"] = str(figure)
    if model_out is not None:
        write_model(robot, task, estimate, posed.problem, Path(model_out))
        answer["model_out"] = str(model_out)
    return dict(plain(answer))


def summary(answer: Mapping[str, Any]) -> list[str]:
    """What `identify --log` tells: a table of the joints, then what to know about it."""
    test = next(iter(answer["tests"].values()), None)
    lines = [
        f"{answer['model']}, task {answer['task']}, {answer['estimator']}: rank {answer['rank']} "
        f"of {answer['parameters']}, condition {_number(answer['condition'])}",
        f"  {_signals_line(answer)}",
        *_selection_lines(answer["selection"]),
        "  joint                  RMS     train          test" if test else
        "  joint                  RMS     train",
    ]  # fmt: skip
    for joint, train in answer["training"].items():
        line = f"  {joint:18} {train['rms']:8.4g}  {_error(train)}"
        lines.append(line + (f"  {_error(test[joint])}" if test else ""))
    for label, table in list(answer["tests"].items())[1:]:
        lines.append(f"  {label}: " + ", ".join(_error(told).strip() for told in table.values()))
    if answer["payload"] is not None:
        lines.append(f"  payload: {_payload_line(answer['payload'])}")
    lines += [f"  warning: {warning}" for warning in answer["warnings"]]
    if answer.get("figure"):
        lines.append(f"  figure: {answer['figure']}")
    if answer.get("model_out"):
        lines.append(f"  model: {answer['model_out']}")
    return lines


def _selection(selection: "Selection") -> dict[str, Any]:
    return {
        "added": [{"parameter": name, "error": error} for name, error in selection.added],
        "error_before": selection.error_before,
        "error_after": selection.error_after,
        "left_out": selection.parts,
    }


def _selection_lines(told: Mapping[str, Any] | None) -> list[str]:
    if told is None:
        return []
    names = ", ".join(step["parameter"] for step in told["added"]) or "nothing"
    return [
        f"  chosen on {told['left_out']}: {names} (mean error there "
        f"{100 * told['error_before']:.1f} -> {100 * told['error_after']:.1f} %)"
    ]


def _draw(path: Path, posed: "Posed", log: "Processed", beta: Any) -> None:
    """Measured and predicted torque of the first test log, or of the training one."""
    from sysid_bench.harness.experiment.recorded import predicted
    from sysid_bench.reporting.torques import torque_figure

    problem = next(iter(posed.tests.values()), posed.problem)
    measured, found = predicted(problem, beta)
    N = len(log.recording)
    units = [kind.removeprefix("joint ") for kind in problem.kinds]
    torque_figure(path, log.recording.t, problem.rows, measured[:N], found[:N], units)


CONFIDENCE: Final = 0.95


def _mass(method: Any, posed: "Posed", beta: Any) -> dict[str, Any]:
    """{mass, std, interval, parts}: what the mass varies by when parts of the motion are left out
    (jackknife; Tukey 1958): residuals are no white noise, and a formal deviation would be too small
    by an order."""
    from scipy.stats import t

    from sysid_bench.harness.experiment.recorded import MASS, without_parts
    from sysid_bench.identification.identify import identify as solve

    place = posed.problem.base.names.index(MASS)
    found = []
    for problem in without_parts(posed):
        estimate = solve(method, problem)
        if estimate.status != "ok" or estimate.beta is None:
            raise EstimationError(f"With a part of the motion left out: {estimate.reason}")
        found.append(float(estimate.beta[place]))
    n = len(found)
    std = float(np.sqrt((n - 1) / n * np.sum((np.array(found) - np.mean(found)) ** 2)))
    mass = float(beta[place])
    reach = float(t.ppf(0.5 + CONFIDENCE / 2, n - 1)) * std
    return {
        "mass": mass,
        "std": std,
        "interval": [mass - reach, mass + reach],
        "confidence": CONFIDENCE,
        "parts": found,
    }


def _signals_line(answer: Mapping[str, Any]) -> str:
    told = answer["signals"]
    seconds = sum(log["seconds"] for log in answer["logs"] if log["use"] == "train")
    return (
        f"{seconds:.1f} s of training, filter {told['filter']!r}, derivatives "
        f"{told['derivatives']!r}; errors in % of the {answer['denominator']}"
    )


def _error(told: Mapping[str, Any]) -> str:
    relative = told["relative"]
    share = "     -" if relative is None else f"{100 * relative:5.1f}%"
    return f"{told['rmse']:8.3g} {share}"


def _payload_line(payload: Mapping[str, Any]) -> str:
    if "interval" in payload:
        low, high = payload["interval"]
        return (
            f"mass {payload['mass']:.4g} kg, {100 * payload['confidence']:.0f} % in [{low:.4g}, "
            f"{high:.4g}] by leaving parts of the motion out"
        )
    sure = [key for key, verdict in payload["identifiable"].items() if verdict == "identifiable"]
    told = [f"{key} {_number(payload['parameters'][key])}" for key in sure]
    return ", ".join(told) or "nothing of it is identifiable on its own"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _treatment(
    logs: "Sequence[LogDescription]", filter: str | None, derivatives: str | None, moving: float
) -> "Treatment":
    from sysid_bench.harness.experiment.recorded import Treatment
    from sysid_bench.signals.process import processing_of

    slowest = min((log.rate for log in logs if log.rate is not None), default=np.inf)
    spec = {
        "filter": filter or (FILTER if slowest > SLOW else "none"),
        "derivatives": derivatives
        or ("from v" if all(log.v is not None for log in logs) else "from q"),
    }
    return Treatment(processing_of(spec), moving, spec["filter"], spec["derivatives"])


def _told(treatment: "Treatment") -> dict[str, Any]:
    return {
        "filter": treatment.filter,
        "derivatives": treatment.derivatives,
        "torque": "filtered",
        "moving": treatment.moving,
    }


def _terms(own: tuple[str, ...], rows: tuple[str, ...]) -> tuple[str, ...]:
    """The manifest's terms, those of joints that stand still left out."""
    kept = tuple(
        term for term in own if "." not in term or any(term.startswith(f"{row}.") for row in rows)
    )
    return kept or TERMS


def _labels(tests: Sequence[str | Path]) -> list[str]:
    """A test recording is known by its file, by its whole path where two are called the same."""
    stems = [Path(test).stem for test in tests]
    return [
        stem if stems.count(stem) == 1 else str(test)
        for stem, test in zip(stems, tests, strict=True)
    ]


def _data_figures(problem: Any) -> dict[str, Any]:
    from sysid_bench.evaluation.score import data_figures

    return data_figures(problem, {})


def _joint_table(problem: Any, beta: Any) -> dict[str, Any]:
    from sysid_bench.evaluation.recorded import joint_errors

    return joint_errors(problem, beta)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _feasible(theta: Any, problem: Any) -> bool | None:
    from sysid_bench.spatial.inertia import smallest_eigenvalue

    if theta is None:
        return None
    places = {name: i for i, name in enumerate(problem.parameters)}
    phi = np.array([[theta[places[c]] for c in body.columns] for body in problem.bodies])
    return bool((smallest_eigenvalue(phi) >= -1e-9 * np.abs(phi).max(axis=1)).all())


def _segment(one: "Processed", trains: bool) -> dict[str, Any]:
    """Which part of which file was used, and what was found in it."""
    log, used = one.log, one.recording
    return {
        "use": "train" if trains else "test",
        "log": str(log.description.source),
        "samples": log.samples,
        "rows": None if log.description.rows is None else list(log.description.rows),
        "rate": used.rate,
        "measured_rate": log.measured_rate,
        "used_samples": len(used),
        "used_from": float(used.t[0]),
        "seconds": float(used.t[-1] - used.t[0]),
        "payload": one.payload.name,
        "findings": [
            {"name": f.name, "count": f.count, "text": f.text, "contradiction": f.contradiction}
            for f in log.findings
        ],
    }


def _findings(read: "Sequence[Processed]") -> list[str]:
    return [
        f"{one.log.description.source.name}: {finding.text}"
        for one in read
        for finding in one.log.findings
    ]


def _repeated(training: "Sequence[Processed]", tests: "Mapping[str, Processed]") -> list[str]:
    """Tests that go where the training went tell nothing about other motions."""
    told = []
    for label, test in tests.items():
        distance = min(_distance(one, test) for one in training)
        if distance < REPEATS:
            told.append(
                f"{label} repeats the training motion: its errors tell how well the same motion is "
                "predicted again, and nothing about other motions"
            )
    return told


def _distance(one: "Processed", other: "Processed") -> float:
    """Median distance of states (q, v) of another log from the nearest of this one."""
    from scipy.spatial import cKDTree

    spread = np.concatenate([one.recording.q.std(axis=0), one.recording.motion.v.std(axis=0)])
    moves = spread > 0

    def states(log: "Processed") -> Any:
        motion = log.recording.motion
        every = max(1, len(motion) // 2000)
        x = np.concatenate([motion.q, motion.v], axis=1)
        return (x[:, moves] / spread[moves])[:: every if log is other else 1]

    found = cKDTree(states(one)).query(states(other))[0] / np.sqrt(moves.sum())
    return float(np.median(found))
