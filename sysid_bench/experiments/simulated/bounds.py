"""Cramer-Rao bounds of a simulated experiment: of torque noise, and of encoder noise as well."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np

from sysid_bench.evaluation.cramer_rao import encoder_bound, torque_bound, white_bound
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.simulated.problem import ProblemBuilder, regressor_blocks
from sysid_bench.experiments.simulated.record import SampledRecording
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.types import Array, Oracle, Trajectory

LONGEST: Final = 20_000
"""Samples up to which the bound with encoder noise is computed: W is dense here."""

SMALL: Final = 1e-6
"""Steps (rad, m, and per second) of the central differences of the torque."""


def pooled_bound(builder: ProblemBuilder, sampled: Sequence[SampledRecording]) -> Array | None:
    """Standard deviations (r,) of the Cramer-Rao bound of all motions together, where torque alone
    is noisy: information adds up.

    None where a motion has no bound: a row has no noise of that kind, the model or the sensors have
    other errors, or the motion does not excite every direction.
    """
    bounds = []
    for one in sampled:
        bound = None
        if _has_torque_noise(one, builder):
            bound = _bound(
                builder, one.oracle, one.decimation, tuple(one.torque_std), one.correlation
            )
        if bound is None:
            return None
        bounds.append(bound)
    if len(bounds) == 1:
        return np.sqrt(np.diag(bounds[0]))
    information = sum(np.linalg.inv(bound) for bound in bounds)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))


def _has_torque_noise(sampled: SampledRecording, builder: ProblemBuilder) -> bool:
    """True where each row is a torque with noise, and nothing else has errors."""
    if builder.task.cuts or not sampled.has_exact_model:
        return False
    return bool((sampled.torque_std[list(builder.row_indices)] > 0).all())


@lru_cache(maxsize=2)
def _bound(
    builder: ProblemBuilder,
    oracle: Oracle,
    decimation: int,
    std: tuple[float, ...],
    correlation: float,
) -> Array | None:
    """The bound (r, r) of the covariance; repeats of a played-back motion share it."""
    motion, rows = sampled_motion(oracle.motion, decimation), builder.row_indices
    row_std = np.array(std)[list(rows)]
    if correlation == 0.0:
        return white_bound(builder.build(motion, oracle.tau[::decimation]), row_std)
    # Whitening in time mixes samples: the blocks have to be dense.
    blocks = regressor_blocks(builder.regression, rows, builder.instruments, motion)
    return torque_bound(blocks, np.diag(row_std**2), correlation)


def encoder_bound_std(
    spec: ExperimentSpec, builder: ProblemBuilder, sampled: SampledRecording
) -> Array | None:
    """The bound as standard deviations (r,); None where noise is not white and of both encoders and
    torques, where joints are coupled or not scalar, for several motions, and for repeats after the
    first, whose motions differ by noise alone."""
    noise, robot = spec.noise, builder.robot
    # White noise of encoders and torques, without rounding.
    white = noise.get("q", 0.0) > 0 and not {"quantum", "tau_correlation"} & set(noise)
    # Each degree of freedom is a scalar joint with an encoder.
    scalar = len(robot.scalar_dofs) == robot.nv == len(robot.torque_dofs)
    one_motion = spec.repeat == 0 and spec.motions == 1
    if not (one_motion and white and scalar and robot.coupling is None):
        return None
    motion = sampled_motion(sampled.oracle.motion, sampled.decimation)
    if not _has_torque_noise(sampled, builder) or not 3 <= len(motion) <= LONGEST:
        return None
    rows = list(builder.row_indices)
    instruments, regression = builder.instruments, builder.regression
    W = np.concatenate(list(regressor_blocks(regression, builder.row_indices, instruments, motion)))
    beta = builder.base.K @ builder.task.truth.theta

    def torque(moved: Trajectory) -> Array:
        own = regression.torque(instruments.motion(moved), beta)
        return np.asarray((own + builder.known(moved))[:, rows])

    q_std = np.full(robot.nv, float(noise["q"]))
    step = float(motion.t[1] - motion.t[0])
    slopes = _torque_jacobians(torque, motion)
    bound = encoder_bound(W, slopes, step, q_std, sampled.torque_std[rows])
    return None if bound is None else np.sqrt(np.diag(bound))


def _torque_jacobians(
    torque: Callable[[Trajectory], Array], motion: Trajectory
) -> tuple[Array, Array, Array]:
    """Derivatives (N, rows, n) of the torque (N, rows) by q, v and a, by central differences. Where
    a step crosses a standstill the Coulomb torque jumps, and the sample counts for nothing."""
    slopes = []
    for name in ("q", "v", "a"):
        values, columns = getattr(motion, name), []
        for j in range(values.shape[1]):
            step = np.zeros(values.shape[1])
            step[j] = SMALL
            ahead, behind = (
                torque(replace(motion, **{name: values + sign * step})) for sign in (1.0, -1.0)
            )
            columns.append((ahead - behind) / (2 * SMALL))
        slopes.append(np.stack(columns, axis=-1))
    return slopes[0], slopes[1], slopes[2]
