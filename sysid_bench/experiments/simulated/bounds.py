"""Cramer-Rao bounds of a simulated experiment: of encoder and torque noise together, and pooled."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.evaluation.cramer_rao import encoder_bound
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.simulated.problem import ProblemBuilder, regressor_blocks
from sysid_bench.experiments.simulated.record import SampledRecording
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.types import Array, Trajectory

LONGEST: Final = 20_000
"""Samples up to which the bound is computed: W is dense here."""


SMALL: Final = 1e-6
"""Steps (rad, m, and per second) of the central differences of the torque."""


Torque = Callable[[Trajectory], Array]
"""Motion -> torque (N, rows) of the task's rows."""


def encoder_bound_std(
    spec: ExperimentSpec, builder: ProblemBuilder, sampled: SampledRecording
) -> Array | None:
    """The bound as standard deviations (r,); None where noise is not white and of both encoders and
    torques, where joints are coupled or not scalar, for several motions, and for repeats after the
    first, whose motions differ by noise alone."""
    noise, robot = spec.noise, builder.robot
    if spec.repeat > 0 or spec.motions > 1:
        return None
    # White noise of encoders and torques, without rounding.
    if noise.get("q", 0.0) <= 0 or {"quantum", "tau_correlation"} & set(noise):
        return None
    # Each degree of freedom is a scalar joint with an encoder.
    scalar = len(robot.scalar_dofs) == robot.nv == len(robot.torque_dofs)
    if robot.coupling is not None or not scalar:
        return None
    if not sampled.has_torque_noise(builder):
        return None
    motion = sampled_motion(sampled.oracle.motion, sampled.decimation)
    if not 3 <= len(motion) <= LONGEST:
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
    bound = encoder_bound(
        W, _torque_jacobians(torque, motion), step, q_std, sampled.torque_std[rows]
    )
    return None if bound is None else np.sqrt(np.diag(bound))


def _torque_jacobians(torque: Torque, motion: Trajectory) -> tuple[Array, Array, Array]:
    """Derivatives (N, rows, n) of the torque by q, v and a, by central differences. Where a step
    crosses a standstill the Coulomb torque jumps, and the sample counts for nothing."""
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


def pooled_bound(bounds: Sequence[Array | None]) -> Array | None:
    """Standard deviations (r,) of the Cramer-Rao bound of all motions together, from the bounds
    (r, r) of each: information adds up. None where a motion has none."""
    known = [bound for bound in bounds if bound is not None]
    if not known or len(known) < len(bounds):
        return None
    if len(known) == 1:
        return np.sqrt(np.diag(known[0]))
    information = sum(np.linalg.inv(bound) for bound in known)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))
