"""Signals of a simulation at times between its steps."""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.sensors import with_position_error
from sysid_bench.types import Array, Oracle, Trajectory


def sampled_with_delay(
    robot: RobotModel, oracle: Oracle, every: int, late_q: Array, late_tau: Array
) -> Oracle:
    """Return every `every`-th sample of motion and torque as they were `late_q` and `late_tau`
    (K, n) seconds before, under the present stamps.

    Positions and rates are cubic between steps, accelerations and torques linear. Before its first
    sample a periodic motion is taken to have run, and any other to have stood at it.
    """
    motion, dofs = oracle.motion, robot.torque_dofs
    stamps = motion.t[::every]
    times = np.repeat(stamps[:, None], robot.nv, axis=1)
    times[:, dofs] = _within(motion, stamps[:, None] - late_q)
    tau = _linear(motion.t, oracle.tau, _within(motion, stamps[:, None] - late_tau))
    return Oracle(_motion(robot, motion, stamps, times), tau)


def _motion(robot: RobotModel, motion: Trajectory, stamps: Array, times: Array) -> Trajectory:
    """The motion with each degree of freedom at times (K, nv) of its own."""
    before = np.clip(np.searchsorted(motion.t, times, side="right") - 1, 0, len(motion) - 1)
    columns = np.arange(robot.nv)
    since, v, a = times - motion.t[before], motion.v[before, columns], motion.a[before, columns]
    # Balls and free joints turn on with the rate and acceleration of the step before.
    turned = (v + 0.5 * a * since) * since
    turned[:, robot.scalar_dofs] = 0.0
    q = with_position_error(robot, _positions_before(robot, motion, before), turned)
    v = v + a * since
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            x, dof = motion.q[:, joint.qadr], joint.vadr
            rate, slope = motion.v[:, dof], motion.a[:, dof]
            q[:, joint.qadr] = CubicHermiteSpline(motion.t, x, rate)(times[:, dof])
            v[:, dof] = CubicHermiteSpline(motion.t, rate, slope)(times[:, dof])
    return replace(motion, t=stamps, q=q, v=v, a=_linear(motion.t, motion.a, times))


def _positions_before(robot: RobotModel, motion: Trajectory, before: Array) -> Array:
    """Configurations (K, nq), each joint of step `before` (K, nv)."""
    q: Array = motion.q[before[:, 0]]
    widths = {"hinge": 1, "slide": 1, "ball": 4, "free": 7}
    for joint in robot.joints:
        part = slice(joint.qadr, joint.qadr + widths[joint.kind])
        q[:, part] = motion.q[before[:, joint.vadr], part]
    return q


def _within(motion: Trajectory, times: Array) -> Array:
    """Times (K, n) within a motion: one period later, or its first or last sample."""
    first, last = motion.t[0], motion.t[-1]
    if motion.period is not None:
        times = np.where(times < first, times + motion.period, times)
    return np.asarray(np.clip(times, first, last))


def _linear(t: Array, x: Array, times: Array) -> Array:
    """Columns of x (N, n) at times (K, n) of their own."""
    columns = [np.interp(times[:, j], t, x[:, j]) for j in range(x.shape[1])]
    return np.stack(columns, axis=1)
