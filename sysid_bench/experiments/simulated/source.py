"""Simulated data as a source: the ground truth, and scores of estimates against it."""

from collections.abc import Iterator, Mapping, Sequence
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

_FROM_TRUTH: Final = ("base_error", "bound", "bound_encoders")
"""Fields of the table of parameters from which, with the estimate, the truth follows."""

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
    seeds = (other_motion_seed(spec, index) for index in range(MOTIONS_OF_LIMIT))
    for oracle in noise_free.simulated.along(spec.excitation, seeds):
        motion, measured = noise_free.simulated.noise_free(oracle)
        problems.append(builder.build(motion, measured, rows=builder.rows_along(motion, slow)))
    return scaled_fit(pooled(problems))[0]


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
        """Margins to the limits, ranks behind a sensor, steps of the plant and of candidate models,
        and sizes that were drawn for the plant, unless it is sealed."""
        row = limit_fields(self.noise_free.simulated.margins)
        if self.excitation is not None:
            row |= {
                "structural_rank": self.excitation.structural,
                "excited_rank": self.excitation.rank,
                "unpredictable": len(self.excitation.unpredictable),
                "unpredictable_names": ", ".join(self.excitation.unpredictable),
            }
        simulation = self.noise_free.simulated.simulation
        if self.step is not None and isinstance(simulation, TrackingControl):
            candidate = Candidate(**(self.spec.candidate or {}))
            row |= {
                "plant_step": self.step,
                "candidate_step": candidate.step or 1.0 / simulation.rate,
                "candidate_simulator": candidate.simulator(self.built.model),
                "same_simulator": candidate.has_steps_of(simulation, self.step),
            }
        if self.built.values and not self.spec.plant.get(SEALED):
            row["plant_values"] = [dict(values) for values in self.built.values]
        return row

    @property
    def built(self) -> BuiltPlant:
        """The plant, and the model that is identified."""
        return self.noise_free.simulated.built

    def score(
        self, prepared: ExperimentData["SimulatedSource"], method: Any, estimate: Estimate
    ) -> Row:
        """Scores of an estimate against the truth, and the table of its parameters."""
        problem, deviations = prepared.problem, standard_errors(prepared.problem, estimate)
        has_noise = bool(self.spec.noise) or not self.built.chain.is_exact
        scores = score(
            estimate,
            problem,
            prepared.held_out,
            self.truth,
            self.extents,
            about_data=prepared.figures,
            # Without noise an interval has no width, and its coverage no meaning.
            errors=deviations if has_noise else None,
            moving=prepared.held_out_moving,
        )
        row = dict(vars(scores))
        beta, targets = base_parameters(estimate), None
        if beta is not None and self.spec.noise and deviations:
            limit = pseudo_true(self.noise_free, self.rows)
            targets = true_values(problem, problem.base.K @ self.truth.theta, limit, HOW)
            row |= interval_fields(problem, beta, deviations, targets)
            row |= _prediction_fields(prepared, estimate, row["joints"])
        if self.contact_test is not None:
            row |= contact_fields(self.contact_test.errors(problem, self.truth, estimate))
        table = self._parameter_table(problem, estimate, deviations, targets)
        if self.spec.plant.get(SEALED):  # the next entrant may read these rows
            secret = ("true", *_FROM_TRUTH)
            table = [{k: None if k in secret else x for k, x in one.items()} for one in table]
        return row | {"parameters_table": table}

    def _parameter_table(
        self,
        problem: Problem,
        estimate: Estimate,
        deviations: Mapping[str, StandardError],
        targets: TrueValues | None,
    ) -> list[Row]:
        """True and estimated base parameters, named by their pivots; all parameters where the
        method claims all of them, each with its verdict, so that no claim passes for knowledge.

        `std` is the first of the deviations that exist, `std_from` its kind. The pivot of a base
        parameter has the error of that one as `base_error`, its deviation by Cramer and Rao as
        `bound` (torque noise) and `bound_encoders` (that of encoders as well), its `class`, and
        `held_<kind>`: 1 where the 95 % interval of a kind holds its target.
        """
        beta, base, theta = base_parameters(estimate), problem.base, self.truth.theta
        if beta is None:
            return []
        verdict, beta_true = parameter_verdict(base), base.K @ theta
        of_base = list(self._base_fields(beta, beta_true, deviations, targets))
        spreads = {f"std_{kind}": deviation.std for kind, deviation in deviations.items()}
        kind = next(iter(deviations), None)
        if kind is not None:
            spreads["std"] = deviations[kind].std
        claimed, true, found = list(range(len(verdict))), theta, estimate.theta
        if found is None:
            claimed, true, found = base.pivots.tolist(), base.embed(beta_true), base.embed(beta)
        base_index = {int(column): i for i, column in enumerate(base.pivots)}
        rows: list[Row] = []
        for j in claimed:
            body, _, name = problem.parameters[j].rpartition(".")
            row = {"body": body, "name": name, "true": float(true[j]), "estimate": float(found[j])}
            row |= {"std": None, "std_from": None, "identifiable": verdict[j]}
            rows.append(row)
            i = base_index.get(j)
            if i is None:
                continue
            row |= of_base[i]
            # A base parameter has the deviation of its pivot only where the pivot stands alone.
            if estimate.theta is None or verdict[j] == "identifiable":
                row |= {"std_from": kind, **{key: float(x[i]) for key, x in spreads.items()}}
        return rows

    def _base_fields(
        self,
        beta: Array,
        beta_true: Array,
        deviations: Mapping[str, StandardError],
        targets: TrueValues | None,
    ) -> Iterator[Row]:
        """Yield for each base parameter its error, bounds and class, and what holds its target."""
        errors = {"base_error": beta - beta_true}
        for name, bound in (("bound", self.bound), ("bound_encoders", self.encoder_bound)):
            if bound is not None:
                errors[name] = bound
        holds = {}
        if targets is not None:
            holds = {
                f"held_{kind}": held(x, beta, targets.values) for kind, x in deviations.items()
            }
        for i in range(len(beta)):
            row: Row = {key: float(x[i]) for key, x in errors.items()}
            if targets is not None:
                row |= {"class": str(targets.classes[i])}
                row |= {key: int(x[i]) for key, x in holds.items()}
            yield row


def _prediction_fields(
    prepared: ExperimentData[Any], estimate: Estimate, joints: Sequence[Mapping[str, Any]]
) -> Row:
    """The share of held-out torque inside of prediction intervals (`torque_inside`, and by joint
    `inside`), and the reason where several motions give no interval."""
    fits = motion_fit(prepared.problem, estimate)
    if isinstance(fits, str):
        return {"no_motions_interval": fits} if prepared.problem.motions else {}
    if not prepared.held_out:
        return {}
    inside = torque_coverage(fits, prepared.held_out)
    pairs = zip(joints, inside, strict=True)
    return {
        "torque_inside": float(np.mean(inside)),
        "joints": tuple({**joint, "inside": float(share)} for joint, share in pairs),
    }
