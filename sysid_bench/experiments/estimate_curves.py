"""On-line curves of a task behind a force/torque sensor: torques and parameters over time.

Figures 3 and 4 of Traversaro et al. (2015): joint torques by the prior parameters (CAD) and by the
current estimate, and the convergence of the parameters.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.source import RecordedSource
from sysid_bench.experiments.simulated.wrench_score import subtree_parameters
from sysid_bench.identification.estimators.recursive import (
    ParameterCurves,
    RecursiveEstimator,
)
from sysid_bench.identification.linear.least_squares import dense_rows, residual_norm, spread
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.regressors.wrench import subtree_regressor
from sysid_bench.types import Array, Curve, Problem, Trajectory

HISTORY: Final = 400
"""Points of a curve, about."""


def estimate_curves(prepared: ExperimentData[Any]) -> tuple[Curve, ...]:
    """The curves of an experiment with the task `wrench` and a prior; of any other, none.

    Beside the estimate stand the true parameters of a simulation, or the measured torque of the
    joints where a recording has it.
    """
    problem, source = prepared.problem, prepared.source
    if problem.prior is None or problem.samples == 0:
        return ()
    if isinstance(source, RecordedSource):
        sub_tree = source.builder.unknowns.sub_tree
        return () if sub_tree is None else _recorded_curves(prepared, sub_tree.cuts[0])
    if not source.task.definition.identifies_sub_tree:
        return ()
    track = _track_of(problem)
    kept = _samples(prepared.experiment.recording.motion, track.indices)
    true = source.truth.theta
    return (
        *_torques(prepared, source.task.cuts[0], track, kept, {"true": true}, {}),
        _convergence(problem, track, problem.base.K @ true, kept.t),
    )


def _recorded_curves(
    prepared: ExperimentData[RecordedSource], cut: SensorSubtree
) -> tuple[Curve, ...]:
    """Curves of a recording: the parameters converge to the last estimate, as no truth is known."""
    log = prepared.source.training[0]
    problem = prepared.problem.motions[0] if prepared.problem.motions else prepared.problem
    track = _track_of(problem)
    at = track.indices * log.rows.step
    kept = _samples(log.recording.motion, at)
    measured: dict[str, Array] = {}
    if log.log.description.has_torque:
        names, tau = log.robot.torque_rows, log.recording.tau[at]
        measured = {row: tau[:, names.index(row)] for row in log.log.joints}
    return (
        *_torques(prepared, cut, track, kept, {}, measured),
        _convergence(problem, track, track.beta[-1], kept.t),
    )


def _samples(motion: Trajectory, indices: Array) -> Trajectory:
    """Some samples of a motion."""
    return Trajectory(motion.t[indices], motion.q[indices], motion.v[indices], motion.a[indices])


def _track_of(problem: Problem) -> ParameterCurves:
    """Recursive least squares over the samples of a problem, from its prior."""
    assert problem.prior is not None
    W, f = dense_rows(problem)
    K, step = problem.base.K, max(len(f) // HISTORY, 1)
    # beta = K theta with independent theta: the covariance is K diag(std^2) K'.
    spread = (K * problem.prior.std**2) @ K.T
    return RecursiveEstimator(every=step).run(
        W, f, _noise(problem), K @ problem.prior.theta, spread
    )


def _noise(problem: Problem) -> Array:
    """Standard deviation (m,) of each row: RMS residual of the best fit."""
    r = problem.base.rank
    R = np.vstack([np.zeros((1, r + 1)), *(spread(factor, r) for factor in problem.factors)])
    beta = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=None)[0]
    size = np.array([np.linalg.norm(factor.R[:, -1]) for factor in problem.factors])
    left = residual_norm(problem, beta)
    # Exact data leave rounding errors, whose size is not a weight.
    return np.asarray(np.maximum(left, 1e-6 * max(size.max(), 1e-12)) / np.sqrt(problem.samples))


def _torques(
    prepared: ExperimentData[Any],
    cut: SensorSubtree,
    track: ParameterCurves,
    motion: Trajectory,
    known: Mapping[str, Array],
    measured: Mapping[str, Array],
) -> Iterator[Curve]:
    """Torques of the joints distal to the sensor by parameters `known` (p,), the prior (CAD), and
    the current estimate, beside those `measured` (K,) by row."""
    tree = subtree_regressor(prepared.robot, cut, motion)
    problem = prepared.problem
    assert problem.prior is not None
    constant = {**known, "CAD": problem.prior.theta}
    sets = {name: np.tile(theta, (len(motion), 1)) for name, theta in constant.items()}
    sets["on-line"] = np.array([problem.base.embed(beta) for beta in track.beta])
    torques = {
        name: np.einsum("nkp,np->nk", tree.Y_c, subtree_parameters(theta, problem, tree.columns))
        for name, theta in sets.items()
    }
    for i, row in enumerate(tree.rows):
        given = {"measured": measured[row]} if row in measured else {}
        found = {name: tau[:, i] for name, tau in torques.items()}
        yield Curve(f"torque of {row}", motion.t, {**given, **found})


def _convergence(problem: Problem, track: ParameterCurves, true: Array, t: Array) -> Curve:
    """Norms of the error and of its declared deviation, relative to that of the parameters."""
    assert problem.prior is not None
    size = float(np.linalg.norm(true)) or 1.0
    cad = np.linalg.norm(problem.base.K @ problem.prior.theta - true) / size
    series = {
        "CAD": np.full(len(t), cad),
        "on-line": np.linalg.norm(track.beta - true, axis=1) / size,
        "declared deviation": np.linalg.norm(track.std, axis=1) / size,
    }
    return Curve("relative parameter error", t, series)
