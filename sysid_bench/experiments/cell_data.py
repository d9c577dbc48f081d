"""Cells executed again: data for pictures, and answers to data whose last bits differ."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from sysid_bench.canonical_json import plain
from sysid_bench.errors import UnsupportedError, reason_of, status_of
from sysid_bench.evaluation.score import base_parameters
from sysid_bench.evaluation.second_engine import wrench_reference
from sysid_bench.experiments.execute import estimator_of, load_experiment, prepare
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.paper_data import estimate_curves
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.simulated.problem import measured_signals
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.identification.identify import fit_fields, identify
from sysid_bench.identification.linear.least_squares import stacked_factor
from sysid_bench.models.random_states import random_states
from sysid_bench.models.shape import body_frames, body_shape
from sysid_bench.regressors.wrench import subtree_regressor
from sysid_bench.types import (
    Array,
    CellData,
    Estimate,
    Experiment,
    Problem,
    Recording,
    Row,
    RowBlock,
)


def cell_data(argument: Mapping[str, Any], row: Row) -> CellData:
    """The data of the first estimator of `argument` (see `job_of` in harness/run.py), with its row.

    Raises UnsupportedError for a cell of recordings, and the error that the cell itself ended with
    where it has no estimate.
    """
    spec, loaded = load_experiment(argument)
    if spec.log is not None:
        raise UnsupportedError(
            "A cell of real recordings has no simulation to show; [[paper]] show = 'torques' draws "
            "measured and predicted torques."
        )
    prepared = prepare_simulated(spec, loaded)
    problem, model, recording = prepared.problem, prepared.robot, prepared.experiment.recording
    try:
        method = estimator_of(argument["estimators"][0])
        estimate = identify(method, problem, prepared.experiment)
    except Exception as error:  # of a plug-in: the picture shows the data without an estimate
        estimate = Estimate(status="failed", reason=f"{type(error).__name__}: {error}")
    gap_map, gap_columns = _gap(loaded, prepared)
    positions, quaternions = body_frames(model, recording.motion.q)
    r, signals = problem.base.rank, (*model.torque_rows, *recording.wrench_rows)
    return CellData(
        row=row,
        motion=recording.motion,
        measured=measured_signals(recording)[:, [signals.index(name) for name in problem.rows]],
        predicted=_predicted(prepared, estimate),
        rows=problem.rows,
        singular_values=np.linalg.svd(stacked_factor(problem)[:r, :r], compute_uv=False),
        gap_map=gap_map,
        gap_columns=gap_columns,
        estimate=estimate,
        base=problem.base,
        bodies=model.body_names,
        # MuJoCo counts the world as body 0.
        parents=tuple(int(model.mj.body_parentid[b]) - 1 for b in range(1, model.mj.nbody)),
        positions=positions,
        quaternions=quaternions,
        shapes=body_shape(model),
        curves=estimate_curves(prepared),
        joints={j.dofs[0]: (j.qadr, j.vadr) for j in model.joints if len(j.dofs) == 1},
    )


def _predicted(prepared: ExperimentData[SimulatedSource], estimate: Estimate) -> Array | None:
    """Torque (N, rows) of the estimate and of the known parts; None without an estimate."""
    beta = base_parameters(estimate)
    if beta is None:
        return None
    blocks = prepared.experiment.regress(prepared.experiment.recording.motion)
    predicted: Array = np.concatenate([block @ beta for block in blocks]) + prepared.source.known
    return predicted


def _gap(
    loaded: LoadedRobot, prepared: ExperimentData[SimulatedSource]
) -> tuple[Array, tuple[str, ...]]:
    """Differences of our regressor from the second engine's on the measured rows, and columns."""
    robot, cuts, check = prepared.robot, prepared.source.task.cuts, loaded.check
    if not cuts:
        # The cross-check of the robot has all rows; with a sensor there are other ones.
        rows = [robot.rows.index(row) for row in prepared.problem.rows]
        return check.gap_map[rows], check.columns
    motion = random_states(robot, 5, np.random.default_rng(0))
    base = robot.body_names[cuts[0].body]
    ours = subtree_regressor(robot, cuts[0], motion).base_wrench(base)
    theirs = wrench_reference(robot, cuts[0], motion, base)
    return np.abs(ours - theirs.Y).max(axis=0), theirs.columns


SIZE: Final = 4.0 * float(np.finfo(float).eps)
"""Largest relative change of a value, four units of the last place of 1."""


def repeat_cells(
    argument: Mapping[str, Any], channel: JobChannel | None = None
) -> dict[str, list[Row]]:
    """Status, end of the iterations and scores of the estimators of `argument["job"]` (see
    `job_of` in harness/run.py) by cell: for the data of their experiment, then for
    `argument["repeats"]` copies with other last bits (seeds 0, 1, ...).

    Raises UnsupportedError or UsageError for an experiment that cannot be made.
    """
    data = prepare(*load_experiment(argument["job"]))
    copies = [data.experiment]
    copies += [near_experiment(data.experiment, seed) for seed in range(argument["repeats"])]

    def answer(entry: Mapping[str, Any], given: Experiment) -> Row:
        try:
            method = estimator_of(entry)
            estimate = identify(method, given.problem, given)
            scores = data.score(method, estimate)
        except Exception as error:  # of a plug-in, as in a run
            return {"status": status_of(error), "reason": reason_of(error)}
        row = {"status": estimate.status, **fit_fields(estimate)}
        return dict(plain(row | data.figures | scores))

    entries = argument["job"]["estimators"]
    return {entry["cell"]: [answer(entry, copy) for copy in copies] for entry in entries}


def near_experiment(experiment: Experiment, seed: int) -> Experiment:
    """A copy of the data in which each measured value, entry of W and b and entry of the R factors
    is multiplied by 1 + `SIZE` u, u uniform between -1 and 1; zeros stay."""
    rng = np.random.default_rng(seed)
    return replace(
        experiment,
        problem=_problem(experiment.problem, rng),
        recording=_recording(experiment.recording, rng),
        raw=_recording(experiment.raw, rng),
        runs=tuple(
            replace(run, recording=_recording(run.recording, rng)) for run in experiment.runs
        ),
    )


def _problem(problem: Problem, rng: np.random.Generator) -> Problem:
    factors = tuple(replace(factor, R=_changed(factor.R, rng)) for factor in problem.factors)
    blocks = partial(_blocks, problem.blocks, int(rng.integers(2**32)))
    motions = tuple(_problem(motion, rng) for motion in problem.motions)
    return replace(problem, factors=factors, blocks=blocks, motions=motions)


def _blocks(blocks: Callable[[], Iterator[RowBlock]], seed: int) -> Iterator[RowBlock]:
    """Yield the blocks with other last bits, the same ones at each reading."""
    rng = np.random.default_rng(seed)
    for W, b in blocks():
        yield _changed(W, rng), _changed(b, rng)


def _recording(recording: Recording, rng: np.random.Generator) -> Recording:
    given = {name: getattr(recording, name) for name in ("q", "v", "a", "tau", "wrench")}
    changed: dict[str, Any] = {k: _changed(x, rng) for k, x in given.items() if x is not None}
    return replace(recording, **changed)


def _changed(values: Array, rng: np.random.Generator) -> Array:
    return np.asarray(values * (1.0 + SIZE * rng.uniform(-1.0, 1.0, np.shape(values))))
