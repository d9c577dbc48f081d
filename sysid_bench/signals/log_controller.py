"""Controller that a log declares, and the commanded motion that it tracks."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import scipy

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.log_samples import Samples
from sysid_bench.types import Array, Controller, Recording, Trajectory
from sysid_bench.units import quantity

CONTROL_RATE: Final = 1000.0
"""Hz; without a stated rate the controller runs at the least multiple of the log's above it."""

OFF: Final = 0.02
"""Relative deviation of a stated rate from a multiple of the log's that passes: clocks differ."""


def with_controller(
    recording: Recording,
    log: LogDescription,
    robot: RobotModel,
    joints: Sequence[str],
    samples: Samples,
) -> Recording:
    """Return a recording with the controller of its description and the commanded motion at the
    controller's rate: cubic splines through `q_ref` and, where it is recorded, `v_ref`.

    `samples`: of the `joints`, on the recording's grid. Raises UsageError for a controller without
    a commanded motion, for gains that are not positive, and for a rate that does not fit.
    """
    if log.controller is None:
        return recording
    if samples.q_ref is None:
        raise UsageError(
            f"{log.source}: the controller tracks q_ref, which is missing; write q_ref = "
            "{ columns = [...] } for the commanded positions."
        )
    # Whole number of control periods in a sample of the log.
    each = least = control_steps(recording.rate)
    if log.controller.rate is not None:
        stated = quantity(log.controller.rate, "Hz")
        each = round(stated / recording.rate)
        if each < 1 or abs(stated / recording.rate - each) > OFF * each:
            raise UsageError(
                f"{log.source}: controller.rate must be a multiple of the log's "
                f"{recording.rate:.6g} Hz; got {stated:g} Hz. Leave it out for "
                f"{least * recording.rate:.6g} Hz."
            )
    rate = each * recording.rate
    kp, kd = (_gains(log, robot, joints, name) for name in ("kp", "kd"))
    t = np.arange((len(recording) - 1) * each + 1) / rate
    motion = _commanded(robot, joints, samples, recording.t, t)
    controller = Controller(kp, kd, rate, 0.5 * rate, log.controller.held)
    return replace(recording, commanded=motion, controller=controller)


def control_steps(rate: float) -> int:
    """Return the least whole number of control periods in a sample, so that the controller runs at
    CONTROL_RATE or more; a rate (Hz) from time stamps is known to OFF, not to its last digit."""
    return max(1, int(np.ceil(CONTROL_RATE / rate - OFF)))


def _gains(log: LogDescription, robot: RobotModel, joints: Sequence[str], name: str) -> Array:
    """Return the gains (n,) of all motors; zero for those that are not in the log."""
    written = log.joint_values(f"controller.{name}", getattr(log.controller, name))
    if not (np.isfinite(written) & (written > 0)).all():
        raise UsageError(
            f"{log.source}: controller.{name} must be positive; got {written.tolist()}."
        )
    by_joint = dict(zip(log.joints, written.tolist(), strict=True))
    return np.array([by_joint[row] if row in joints else 0.0 for row in robot.torque_rows])


def _commanded(
    robot: RobotModel, joints: Sequence[str], samples: Samples, at: Array, t: Array
) -> Trajectory:
    """Return the commanded motion at times t (M,) from samples at `at` (N,)."""
    assert samples.q_ref is not None
    position = scipy.interpolate.CubicSpline(at, samples.q_ref)
    rate = position.derivative()
    if samples.v_ref is not None:
        rate = scipy.interpolate.CubicSpline(at, samples.v_ref)
    q = np.tile(robot.mj.qpos0, (len(t), 1))
    v, a = np.zeros((len(t), robot.nv)), np.zeros((len(t), robot.nv))
    joint_of = {dof: joint for joint in robot.joints for dof in joint.dofs}
    at_q, at_v = ([getattr(joint_of[name], key) for name in joints] for key in ("qadr", "vadr"))
    q[:, at_q], v[:, at_v], a[:, at_v] = position(t), rate(t), rate.derivative()(t)
    return robot.completed(Trajectory(t, q, v, a, "commanded"))
