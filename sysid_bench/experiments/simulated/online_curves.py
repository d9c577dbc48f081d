"""On-line curves of a task behind a force/torque sensor: torques and parameters over time.

Figures 3 and 4 of Traversaro et al. (2015): joint torques by the prior parameters (CAD) and by the
current estimate, and the convergence of the parameters.
"""

from typing import Final

import numpy as np

from sysid_bench.experiments.prepared import Prepared
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.simulated.wrench_score import subtree_parameters
from sysid_bench.identification.linear.normal_qr import residual_norm, spread
from sysid_bench.identification.linear.online_estimation import (
    ParameterTrack,
    RecursiveEstimator,
    rows_of,
)
from sysid_bench.regressors.wrench import subtree_regressor
from sysid_bench.types import Array, Curve, Problem, Trajectory

HISTORY: Final = 400
"""Points of a curve, about."""


def online_curves(prepared: Prepared[SimulatedSource]) -> tuple[Curve, ...]:
    """The curves of an experiment with the task `wrench` and a prior; of any other, none."""
    problem = prepared.problem
    shown = prepared.source.task.definition.identifies_sub_tree
    if not shown or problem.prior is None or problem.samples == 0:
        return ()
    track = _track_of(problem)
    motion = prepared.experiment.recording.motion
    kept = Trajectory(*(x[track.indices] for x in (motion.t, motion.q, motion.v, motion.a)))
    return (
        *_torques(prepared, track, kept),
        _convergence(problem, track, problem.base.K @ prepared.source.truth.theta, kept.t),
    )


def _track_of(problem: Problem) -> ParameterTrack:
    """Recursive least squares over the samples of a problem, from its prior."""
    assert problem.prior is not None
    W, f = rows_of(problem)
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
    prepared: Prepared[SimulatedSource], track: ParameterTrack, motion: Trajectory
) -> list[Curve]:
    tree = subtree_regressor(prepared.robot, prepared.source.task.cuts[0], motion)
    problem = prepared.problem
    assert problem.prior is not None
    sets = {
        "true": np.tile(prepared.source.truth.theta, (len(motion), 1)),
        "CAD": np.tile(problem.prior.theta, (len(motion), 1)),
        "on-line": np.array([problem.base.embed(beta) for beta in track.beta]),
    }
    torques = {
        name: np.einsum("nkp,np->nk", tree.Y_c, subtree_parameters(theta, problem, tree.columns))
        for name, theta in sets.items()
    }
    return [
        Curve(f"torque of {row}", motion.t, {name: tau[:, i] for name, tau in torques.items()})
        for i, row in enumerate(tree.rows)
    ]


def _convergence(problem: Problem, track: ParameterTrack, true: Array, t: Array) -> Curve:
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
