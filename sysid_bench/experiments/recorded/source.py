"""Recordings as a source: training and test logs, and scores against the measured torque."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.score import base_parameters, data_figures, score_recorded
from sysid_bench.evaluation.torque_errors import known_rms, loaded_joints, row_rms
from sysid_bench.excitation.limit_margins import Margins, limit_fields, limit_margins
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.left_out_parts import TermSelection
from sysid_bench.experiments.recorded.model_prior import ModelPrior
from sysid_bench.experiments.recorded.payload import payload_mass
from sysid_bench.experiments.recorded.problem import LogProblemBuilder, predict_torque
from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.identifiability.base_expressions import (
    base_expressions,
    expression,
    parameter_verdict,
)
from sysid_bench.types import Array, Estimate, Problem, Row

REPEATS: Final = 0.05
"""Largest median distance of test states from training states (q, v in units of their standard
deviation) for the same motion (measured: 0.02 for the same, 0.3 and more for others)."""


def repetition_error(
    training: Sequence[ProcessedLog], test: ProcessedLog, rows: Sequence[str]
) -> dict[str, float] | None:
    """{joint: relative error} of predicting the test torque by the training torque at the nearest
    state: no model of a state can be much better.

    None where the test motion is another one, or has another payload.
    """
    repeated = repetition_torque(training, test, rows)
    if repeated is None:
        return None
    measured = test.recording.tau[:, [test.robot.torque_rows.index(row) for row in rows]]
    errors = np.linalg.norm(repeated - measured, axis=0)
    sizes = np.linalg.norm(measured, axis=0)
    return {row: float(e / s) for row, e, s in zip(rows, errors, sizes, strict=True) if s > 0}


def floor_error(
    training: Sequence[ProcessedLog],
    tests: Mapping[str, ProcessedLog],
    held_out: Mapping[str, Problem],
) -> float | None:
    """Return the `torque_error` of the training torque, played again, on those tests that repeat
    its motion; None where none does."""
    errors = []
    for name, test in tests.items():
        rows = held_out[name].rows
        shares = repetition_error(training, test, rows)
        if shares is not None:
            loaded = loaded_joints(row_rms([held_out[name]]), held_out[name].kinds)
            judged = [x for row, x in shares.items() if loaded[rows.index(row)]]
            errors.append(known_rms(judged))
    return known_rms(errors)


def repetition_torque(
    training: Sequence[ProcessedLog], test: ProcessedLog, rows: Sequence[str]
) -> Array | None:
    """Return the training torque (N, rows) at the state nearest to each test sample; None where the
    test motion is another one, or has another payload."""
    matches = [_nearest(log, test) for log in training if log.payload == test.payload]
    distance, tau = min(matches, key=itemgetter(0), default=(np.inf, None))
    # Rows may be those of the wrench of a sensor.
    if tau is None or distance >= REPEATS or not set(rows) <= set(test.robot.torque_rows):
        return None
    return np.asarray(tau[:, [test.robot.torque_rows.index(row) for row in rows]])


def _nearest(one: ProcessedLog, other: ProcessedLog) -> tuple[float, Array]:
    """Median distance of the states (q, v) of another log from the nearest ones of a log, and the
    torque (N, n) of the latter."""
    from scipy.spatial import cKDTree

    # rad, m and rad/s have no common norm: each coordinate is in units of its deviation.
    spread = np.concatenate([one.recording.q.std(axis=0), one.recording.motion.v.std(axis=0)])
    moves = spread > 0  # a joint that stands still has no unit

    def states(log: ProcessedLog) -> Any:
        motion = log.recording.motion
        x = np.concatenate([motion.q, motion.v], axis=1)
        return x[:, moves] / spread[moves]

    tree: cKDTree = cKDTree(states(one))
    distance, near = tree.query(states(other))
    # Per coordinate, so that the threshold does not depend on the number of joints.
    return float(np.median(distance / np.sqrt(moves.sum()))), one.recording.tau[near]


@dataclass(frozen=True, eq=False)
class RecordedSource:
    """The logs of a recorded experiment. No ground truth but the payload's mass on a scale."""

    builder: LogProblemBuilder
    training: tuple[ProcessedLog, ...]
    tests: Mapping[str, ProcessedLog]
    terms: tuple[str, ...]
    selection: TermSelection | None = None
    true_mass: float | None = None  # kg
    prior: ModelPrior = field(default_factory=ModelPrior)

    @property
    def recordings(self) -> tuple[ProcessedLog, ...]:
        """Training logs, then tests."""
        return (*self.training, *self.tests.values())

    @property
    def warning(self) -> str:
        """Empty: recordings have no structure to compare their excitation with."""
        return ""

    def figures(self, problem: Problem, held_out: Mapping[str, Problem]) -> dict[str, Any]:
        """Rank and conditioning of the training data, and the share of rows left out."""
        return data_figures(problem, {}) | {"standstill": self.builder.left_out(self.training)}

    def fields(self) -> Row:
        """Margins to the limits along all logs; preprocessing, findings and selected terms as the
        field `log`."""
        preprocessing, margins = self.builder.preprocessing, Margins()
        findings = []  # contradictions in the data that were accepted
        for log in self.recordings:
            margins = margins.with_motion(limit_margins(log.recording.motion, log.robot))
            name = log.log.description.source.name
            findings += [f"{name}: {finding.text}" for finding in log.log.findings]
        selection: Row = {"chosen": "", "error_before": None, "error_after": None}
        if self.selection is not None:
            selection = {
                "chosen": " ".join(name for name, _ in self.selection.added),
                "error_before": self.selection.error_before,
                "error_after": self.selection.error_after,
            }
        return limit_fields(margins) | {
            "log": {
                "filter": preprocessing.filter,
                "derivatives": preprocessing.derivatives,
                "pipeline": preprocessing.name,
                "seconds": sum(float(np.ptp(log.recording.t)) for log in self.training),
                "prior": self.prior.text,
                "findings": "; ".join(dict.fromkeys(findings)),
                **selection,
            }
        }

    def score(
        self, prepared: ExperimentData["RecordedSource"], method: Any, estimate: Estimate
    ) -> Row:
        """Scores of an estimate against the measured torque, with the mass of an unknown payload,
        and the table of its parameters."""
        problem = prepared.problem
        scores = score_recorded(
            estimate, problem, prepared.held_out, prepared.figures, prepared.held_out_moving
        )
        # The error of the training torque itself, on the first test log.
        replayed: Mapping[str, float] = {}
        for test in list(self.tests.values())[:1]:
            replayed = repetition_error(self.training, test, problem.rows) or {}
        joints = [{**joint, "replayed": replayed.get(joint["name"])} for joint in scores.joints]
        scores = replace(scores, joints=tuple(joints))
        beta = base_parameters(estimate)
        if beta is not None:
            fields = self._mass_fields(method, beta, problem)
            if fields and self.true_mass is not None:
                error = abs(fields["mass"] - self.true_mass)
                fields["mass_error"] = fields["payload_mass_error"] = error
                fields["payload_mass_error_relative"] = error / self.true_mass
            scores = replace(scores, **fields)
        return vars(scores) | {"parameters_table": _parameter_table(estimate, problem)}

    def _mass_fields(self, method: Any, beta: Array, problem: Problem) -> dict[str, Any]:
        """The mass with its interval where the position is given; alone where all ten parameters
        are unknown and the mass is identifiable."""
        unknowns = self.builder.unknowns
        if unknowns.given:
            found = payload_mass(method, problem, self.builder, self.training, beta)
            low, high = found.interval
            return {"mass": found.mass, "mass_low": low, "mass_high": high}
        if not unknowns.payload_parameters:
            return {}
        index = problem.base.parameters.index(unknowns.payload_parameters[0])
        if parameter_verdict(problem.base)[index] != "identifiable":
            return {}
        return {"mass": float(problem.base.embed(beta)[index])}


@dataclass(frozen=True, eq=False)
class LogTorque:
    """Times (N,), measured and predicted torque (N, rows) of a log at the rows of its problem."""

    t: Array
    measured: Array
    predicted: Array
    problem: Problem


def predict_log(
    prepared: ExperimentData[RecordedSource], beta: Array, test: str | None = None
) -> LogTorque:
    """Predicted torque of a test log; None: of the first one, else of the first training log.

    Raises UsageError for the name of another log.
    """
    if test is not None and test not in prepared.held_out:
        known = ", ".join(prepared.held_out) or "none"
        raise UsageError(f"Unknown test log {test!r} in this cell; there are: {known}.")
    label = test or next(iter(prepared.held_out), None)
    problem, log = prepared.problem, prepared.source.training[0]
    if label is not None:
        problem, log = prepared.held_out[label], prepared.source.tests[label]
    measured, predicted = predict_torque(problem, beta)
    t = log.recording.t[:: log.rows.step]
    return LogTorque(t, measured[: len(t)], predicted[: len(t)], problem)


def _parameter_table(estimate: Estimate, problem: Problem) -> list[Row]:
    """The estimated base parameters, each with the sum of parameters that it stands for."""
    beta, base = base_parameters(estimate), problem.base
    if beta is None:
        return []
    verdict, rows = parameter_verdict(base), []
    for j, value, terms in zip(base.pivots.tolist(), beta, base_expressions(base), strict=True):
        body, _, name = problem.parameters[j].rpartition(".")
        row = {"body": body, "name": name, "true": None, "estimate": float(value), "std": None}
        rows.append(row | {"identifiable": verdict[j], "expression": expression(terms)})
    return rows
