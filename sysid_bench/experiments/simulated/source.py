"""Simulated data as a source: the ground truth, and scores of estimates against it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, Final

import numpy as np

from sysid_bench.evaluation.covariance import motion_fit, standard_errors
from sysid_bench.evaluation.interval_figures import (
    TrueValues,
    interval_fields,
    torque_coverage,
    true_values,
)
from sysid_bench.evaluation.intervals import StandardError, held
from sysid_bench.evaluation.score import base_parameters, data_figures, score
from sysid_bench.excitation.limit_margins import limit_fields
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.processed_rows import pooled
from sysid_bench.experiments.simulated.built_plant import BuiltPlant
from sysid_bench.experiments.simulated.noise_free import NoiseFreePart
from sysid_bench.experiments.simulated.wrench_score import (
    ContactTest,
    contact_fields,
    contact_test,
    rank_fields,
    sensor_excitation,
)
from sysid_bench.experiments.spec import SEALED, ExperimentSpec, other_motion_seed
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.identifiability.base_expressions import parameter_verdict
from sysid_bench.identifiability.subspaces import Excitation
from sysid_bench.identification.linear.least_squares import scaled_fit
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.simulation.candidate import Candidate
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Array, BodyExtents, Estimate, Problem, Row, Trajectory, Truth

MOTIONS_OF_LIMIT: Final = 20
"""Further motions: many in comparison with those of the training."""

HOW: Final = f"pseudo-true: weighted least squares on exact data of {MOTIONS_OF_LIMIT} motions"


@lru_cache(maxsize=2)
def pseudo_true(noise_free: NoiseFreePart, rows: RowProcessing) -> Array | None:
    """beta (r,) that weighted least squares finds on exact data of many further motions of the
    training's excitation; None where the model contains the plant.

    `rows`: slow rows count as in the training. Neither noise nor a filter of signals is involved.
    """
    if noise_free.simulated.built.is_matched:
        return None
    spec, builder, problems = noise_free.spec, noise_free.builder, list[Problem]()
    slow = RowProcessing(standstill=rows.standstill, weight=rows.weight)
    for index in range(MOTIONS_OF_LIMIT):
        seed = other_motion_seed(spec, index)
        motion, measured = noise_free.exact(noise_free.simulated.along(spec.excitation, seed))
        problems.append(builder.build(motion, measured, rows=builder.rows_along(motion, slow)))
    return scaled_fit(pooled(problems))[0]


@dataclass(frozen=True, eq=False)
class IntervalScore:
    """Confidence intervals of `beta` (r,) by kind, and the values that they should hold."""

    beta: Array
    errors: Mapping[str, StandardError]
    targets: TrueValues

    def of_parameter(self, index: int) -> Row:
        """Class of one parameter, and for each kind 1 where its interval holds the value."""
        hits = {
            f"held_{kind}": int(held(error, self.beta, self.targets.values)[index])
            for kind, error in self.errors.items()
        }
        return {"class": str(self.targets.classes[index]), **hits}


def interval_rows(
    intervals: IntervalScore | None, prepared: ExperimentData[Any], estimate: Estimate
) -> Row:
    """Coverage, width and score of the intervals by class of parameters, the share of held-out
    torque inside of prediction intervals (`torque_inside`, and by row `inside`), and the reason
    where several motions give no interval."""
    if intervals is None:
        return {}
    problem = prepared.problem
    row: Row = interval_fields(problem, intervals.beta, intervals.errors, intervals.targets)
    fits = motion_fit(problem, estimate)
    if isinstance(fits, str):
        return row | ({"no_motions_interval": fits} if problem.motions else {})
    if prepared.held_out:
        inside = torque_coverage(fits, prepared.held_out)
        row |= {"torque_inside": float(np.mean(inside)), "inside": inside}
    return row


def with_joints(scores: Mapping[str, Any], fields: Row) -> Row:
    """The scores and further fields, `inside` (rows,) of them among those of the joints."""
    inside = fields.pop("inside", None)
    if inside is None:
        return {**scores, **fields}
    pairs = zip(scores["joints"], inside, strict=True)
    joints = tuple({**joint, "inside": float(share)} for joint, share in pairs)
    return {**scores, **fields, "joints": joints}


@dataclass(frozen=True, eq=False)
class SimulatedSource:
    """Ground truth of a simulated experiment."""

    spec: ExperimentSpec
    noise_free: NoiseFreePart
    motion: Trajectory  # as measured, without contact periods
    known: Array  # (N, rows) torque of the parts that the task declares known, along `motion`
    bound: Array | None  # (r,) Cramer-Rao, as standard deviations, where torque alone is noisy
    step: float | None  # s, of the plant in a closed loop
    left_out: float  # share of the samples that were removed as contacts
    encoder_bound: Array | None = None  # (r,), where encoders are noisy as well; first repeat
    standstill: float = 0.0  # share of the rows that were left out as standstill
    rows: RowProcessing = field(default_factory=RowProcessing)  # of the training

    @property
    def task(self) -> Task:
        """The unknowns, with their true values."""
        return self.noise_free.task

    @property
    def truth(self) -> Truth:
        """True values of the unknowns."""
        return self.task.truth

    @property
    def extents(self) -> Mapping[str, BodyExtents]:
        """Extent of each body, by name."""
        return self.noise_free.extents

    @cached_property
    def excitation(self) -> Excitation | None:
        """Excited part of the sub-tree behind the sensor; None for other tasks."""
        if not self.task.definition.identifies_sub_tree:
            return None
        return sensor_excitation(self.noise_free.builder.robot, self.task.cuts[0], self.motion)

    @cached_property
    def contact_test(self) -> ContactTest | None:
        """Wrench estimation on a motion of its own; None but for a task that identifies one."""
        if not self.task.definition.identifies_sub_tree:
            return None
        return contact_test(self.spec, self.built, self.task)

    @property
    def warning(self) -> str:
        """Degrees of freedom whose torque the data of a sensor cannot predict."""
        return "" if self.excitation is None else self.excitation.warning

    def figures(self, problem: Problem, held_out: Mapping[str, Problem]) -> dict[str, Any]:
        """Rank, conditioning and information of the data, and the shares left out."""
        return data_figures(problem, held_out) | {
            "left_out": self.left_out,
            "standstill": self.standstill,
        }

    def fields(self) -> Row:
        """Margins to the limits, ranks behind a sensor, and sizes that were drawn for the plant,
        unless it is sealed."""
        ranks = {} if self.excitation is None else rank_fields(self.excitation)
        drawn = [dict(values) for values in self.built.values]
        margins = limit_fields(self.noise_free.simulated.margins)
        is_shown = drawn and not self.spec.plant.get(SEALED)
        return margins | ranks | self._simulators() | ({"plant_values": drawn} if is_shown else {})

    def _simulators(self) -> Row:
        """Steps of the plant and of candidate models, and whether they are one simulator."""
        simulation = self.noise_free.simulated.simulation
        if self.step is None or not isinstance(simulation, TrackingControl):
            return {}
        candidate = Candidate(**(self.spec.candidate or {}))
        return {
            "plant_step": self.step,
            "candidate_step": candidate.step or 1.0 / simulation.rate,
            "same_simulator": candidate.has_steps_of(simulation, self.step),
        }

    @property
    def _has_noise(self) -> bool:
        return bool(self.spec.noise) or not self.built.chain.is_exact

    @property
    def built(self) -> BuiltPlant:
        """The plant, and the model that is identified."""
        return self.noise_free.simulated.built

    def score(
        self, prepared: ExperimentData["SimulatedSource"], method: Any, estimate: Estimate
    ) -> Row:
        """Scores of an estimate against the truth, and the table of its parameters."""
        problem, deviations = prepared.problem, standard_errors(prepared.problem, estimate)
        scores = score(
            estimate,
            problem,
            prepared.held_out,
            self.truth,
            self.extents,
            about_data=prepared.figures,
            # Without noise an interval has no width, and its coverage no meaning.
            errors=deviations if self._has_noise else None,
            moving=prepared.held_out_moving,
        )
        intervals = self._intervals(prepared, estimate, deviations)
        contact = {}
        if self.contact_test is not None:
            contact = contact_fields(self.contact_test.errors(problem, self.truth, estimate))
        bounds = {"bound": self.bound, "bound_encoders": self.encoder_bound}
        known = {name: bound for name, bound in bounds.items() if bound is not None}
        compared = _Compared(self.truth, known, deviations, intervals)
        table = _parameter_table(estimate, problem, compared)
        fields = interval_rows(intervals, prepared, estimate)
        return with_joints(vars(scores), fields) | contact | {"parameters_table": table}

    def _intervals(
        self,
        prepared: ExperimentData["SimulatedSource"],
        estimate: Estimate,
        deviations: Mapping[str, StandardError],
    ) -> "IntervalScore | None":
        """The confidence intervals and what they should hold; None without noise, where an
        interval has no width, or without an estimate."""
        beta, problem = base_parameters(estimate), prepared.problem
        if beta is None or not self.spec.noise or not deviations:
            return None
        limit = pseudo_true(self.noise_free, self.rows)
        targets = true_values(problem, problem.base.K @ self.truth.theta, limit, HOW)
        return IntervalScore(beta, deviations, targets)


@dataclass(frozen=True, eq=False)
class _Compared:
    """References of estimated parameters: true values, the Cramer-Rao bounds (r,) by row field, the
    deviations by kind, and the intervals where they are judged."""

    truth: Truth
    bounds: Mapping[str, Array]
    deviations: Mapping[str, StandardError]
    intervals: IntervalScore | None


def _parameter_table(estimate: Estimate, problem: Problem, compared: _Compared) -> list[Row]:
    """True and estimated base parameters, named by their pivots; all parameters where the method
    claims all of them, each with its verdict, so that no claim passes for knowledge.

    `std` is the first of the deviations that exist, `std_from` its kind. The pivot of a base
    parameter has the error of that one as `base_error`, its deviation by Cramer and Rao as `bound`
    (torque noise) and `bound_encoders` (that of encoders as well), its `class`, and `held_<kind>`:
    1 where the 95 % interval of a kind holds its target.
    """
    beta = base_parameters(estimate)
    if beta is None:
        return []
    base, verdict = problem.base, parameter_verdict(problem.base)
    truth, deviations = compared.truth, compared.deviations
    beta_true = base.K @ truth.theta
    errors = {"base_error": beta - beta_true, **compared.bounds}
    intervals = compared.intervals
    if estimate.theta is None:
        claimed, true, found = base.pivots.tolist(), base.embed(beta_true), base.embed(beta)
    else:
        claimed, true, found = list(range(len(verdict))), truth.theta, estimate.theta
    spreads = {f"std_{kind}": deviation.std for kind, deviation in deviations.items()}
    kind = next(iter(deviations), None)
    if kind is not None:
        spreads["std"] = deviations[kind].std
    base_index = {int(column): i for i, column in enumerate(base.pivots)}
    rows: list[Row] = []
    for j in claimed:
        row = _parameter_row(problem.parameters[j], float(true[j]), float(found[j]), verdict[j])
        row |= _entry(errors, base_index.get(j))
        if intervals is not None and j in base_index:
            row |= intervals.of_parameter(base_index[j])
        # A deviation of a base parameter is that of its pivot only where the pivot stands alone.
        if estimate.theta is None or verdict[j] == "identifiable":
            row |= {"std_from": kind, **_entry(spreads, base_index[j])}
        rows.append(row)
    return rows


def _entry(arrays: Mapping[str, Array], i: int | None) -> dict[str, float]:
    """Entry i of each array; {} for a parameter that is not a pivot."""
    return {} if i is None else {key: float(x[i]) for key, x in arrays.items()}


def _parameter_row(name: str, true: float, estimate: float, verdict: str) -> Row:
    body, _, parameter = name.rpartition(".")
    return {
        "body": body,
        "name": parameter,
        "true": true,
        "estimate": estimate,
        "std": None,
        "std_from": None,
        "identifiable": verdict,
    }
