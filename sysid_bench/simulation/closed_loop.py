"""Closed-loop simulation: MuJoCo forward, under a joint controller that sees the noisy encoders."""

from dataclasses import dataclass, field
from typing import Final

import mujoco
import numpy as np
from mujoco.batch import Batch

from sysid_bench.errors import SimulationError, UnsupportedError, UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.plant import Plant, bench_flags, check_finite
from sysid_bench.types import Array, Controller, Oracle, Trajectory

STIFF_FRICTION: Final = ([0.002, 1.0], [0.99, 0.9999, 0.001, 0.5, 2.0])
"""solref and solimp of friction loss: MuJoCo's default is soft and leaves 12 % of the torque of a
joint with Coulomb friction unexplained; with these settings a moving joint leaves 0.03 %."""


@dataclass(frozen=True)
class ClosedLoop:
    """PD control of every joint at `rate`; gains place each joint's own inertia, taken at the
    reference posture, at `bandwidth` with `damping`."""

    rate: float = field(default=1000.0, metadata={"unit": "Hz"})
    bandwidth: float = field(default=10.0, metadata={"unit": "Hz"})
    damping: float = 0.7

    def design_rate(self, recording: float) -> float:
        """The control rate (Hz); the recording rate must divide it."""
        ratio = self.rate / recording
        if abs(ratio - round(ratio)) > 1e-9 or ratio < 1:
            raise UsageError(f"The rate {recording} Hz does not divide the control rate {self.rate} Hz.")
        return self.rate

    def run(self, plant: Plant, commanded: Trajectory, encoder: Array) -> tuple[Oracle, Controller | None]:
        """What happens when the robot tracks the motion; `encoder` (N, nv): error of each reading.

        Raises UnsupportedError for a floating robot, SimulationError where the loop diverges.
        """
        robot = plant.robot
        if robot.floating or any(joint.kind == "ball" for joint in robot.joints):
            raise UnsupportedError(f"{robot.name}: closed-loop needs a fixed base with hinges and slides.")
        controller = self.controller(robot)
        mj = controlled_model(plant, controller)
        control = commands(controller, commanded, encoder, robot)
        steps = _steps_with_laws if plant.laws else _rollout
        q, v, a, tau = steps(plant, mj, commanded, control)
        motion = Trajectory(commanded.t, q, v, a, "closed loop", commanded.period)
        for name, array in (("position", q), ("acceleration", a)):
            check_finite(robot.name, array, f"{name} in closed loop")
        _check_tracking(robot, commanded, motion)
        return Oracle(motion, tau), controller

    def controller(self, robot: RobotModel) -> Controller:
        """The gains (nv,) of a robot."""
        data = mujoco.MjData(robot.mj)
        mujoco.mj_forward(robot.mj, data)
        M = np.zeros((robot.nv, robot.nv))
        mujoco.mj_fullM(robot.mj, data, M)
        w = 2 * np.pi * self.bandwidth
        return Controller(w**2 * np.diag(M), 2 * self.damping * w * np.diag(M), self.rate)


def controlled_model(plant: Plant, controller: Controller) -> mujoco.MjModel:
    """The plant's model with one motor per joint whose bias law is the controller's feedback."""
    spec = plant.robot.spec.copy()
    for joint, kp, kd in zip(plant.robot.joints, controller.kp, controller.kd, strict=True):
        motor = spec.add_actuator(name=f"motor of {joint.name}", target=joint.name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[:3] = [kp, 0.0, 0.0]
        motor.biasprm[:3] = [0.0, -kp, -kd]
        limit = plant.robot.limits.tau[joint.vadr]
        if np.isfinite(limit):
            motor.forcerange = [-limit, limit]
            motor.forcelimited = True
    for joint in spec.joints:
        joint.solref_friction, joint.solimp_friction = STIFF_FRICTION
    mj = bench_flags(spec.compile())
    mj.opt.timestep = 1.0 / controller.rate
    mj.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    return mj


def commands(controller: Controller, commanded: Trajectory, encoder: Array, robot: RobotModel) -> Array:
    """Motor inputs u (N, nv) such that kp (u - q) - kd v is the law on what the encoders read:
    kp (q_ref - q - n) + kd (v_ref - v - dn/dt), with dn/dt the backward difference of the error."""
    slope = np.diff(encoder, axis=0, prepend=encoder[:1]) * controller.rate
    places = [joint.qadr for joint in robot.joints]
    ratio = controller.kd / controller.kp
    return commanded.q[:, places] - encoder + ratio * (commanded.v - slope)


def _rollout(
    plant: Plant, mj: mujoco.MjModel, commanded: Trajectory, control: Array
) -> tuple[Array, Array, Array, Array]:
    """q, v, a and motor torque (N, nv) of every step, in one call of the engine."""
    batch = Batch(mj, 1, nthread=1)
    batch.bind("qpos")[0], batch.bind("qvel")[0] = commanded.q[0], commanded.v[0]
    applied = np.broadcast_to(-plant.terms.offset, control.shape)
    state = mujoco.mjtState
    record = batch.rollout(
        len(control),
        control=np.concatenate([control, applied], axis=1)[None],
        control_spec=int(state.mjSTATE_CTRL) | int(state.mjSTATE_QFRC_APPLIED),
        record=["qpos", "qvel", "qacc", "qfrc_actuator"],
    )
    q, v, a, tau = (record[name][0] for name in ("qpos", "qvel", "qacc", "qfrc_actuator"))
    # A record is taken after its step; accelerations and torques belong to the state before it.
    before_q = np.concatenate([commanded.q[:1], q[:-1]])
    before_v = np.concatenate([commanded.v[:1], v[:-1]])
    return before_q, before_v, a, tau


def _steps_with_laws(
    plant: Plant, mj: mujoco.MjModel, commanded: Trajectory, control: Array
) -> tuple[Array, Array, Array, Array]:
    """The same, step by step, since the force laws of effects look at each state."""
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:] = commanded.q[0], commanded.v[0]
    out = tuple(np.empty((len(control), size)) for size in (mj.nq, mj.nv, mj.nv, mj.nv))
    for k, t in enumerate(commanded.t):
        extra = plant.extra(t, data.qpos, data.qvel)
        data.qfrc_applied[:] = -plant.terms.offset - extra
        data.ctrl[:] = control[k]
        out[0][k], out[1][k] = data.qpos, data.qvel
        mujoco.mj_step(mj, data)
        out[2][k], out[3][k] = data.qacc, data.qfrc_actuator
    return out  # type: ignore[return-value]


def _check_tracking(robot: RobotModel, commanded: Trajectory, motion: Trajectory) -> None:
    lost = np.abs(motion.q - commanded.q).max(axis=0)
    bad = [joint for joint in robot.joints if lost[joint.qadr] > 1.0]
    if bad:
        worst = max(bad, key=lambda joint: float(lost[joint.qadr]))
        raise SimulationError(
            f"{robot.name}: {worst.name} loses its motion by {lost[worst.qadr]:.3g} rad or m; lower the "
            "motion's limits or change the controller's bandwidth (now the loop does not track)."
        )
