"""Closed-loop simulation: MuJoCo forward, under a joint controller that sees the noisy encoders."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.signal import lfilter

from sysid_bench.errors import SimulationError, UnsupportedError, UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.gravity import gravity_rms
from sysid_bench.simulation.plant import Plant, check_finite
from sysid_bench.types import Array, Controller, Oracle, Trajectory

STIFF_FRICTION: Final = ([0.002, 1.0], [0.99, 0.9999, 0.001, 0.5, 2.0])
"""solref and solimp of friction loss: MuJoCo's default is soft and leaves 12 % of the torque of a
joint with Coulomb friction unexplained; with these settings a moving joint leaves 0.03 %."""

EXPLICIT: Final = 1.0
"""Steps times the fastest decay up to which velocities are taken explicitly, as a digital
controller holds its torque. An implicit step moves the robot as if every joint had kd + viscous
friction times the step more inertia, and positions then tell another robot than the torques: 17 %
of the torque of a UR5 at 500 Hz. Beyond it an explicit step would ring."""


@dataclass(frozen=True)
class ClosedLoop:
    """PD control of every joint at `rate`, on encoders with noise.

    Gains place each joint's own inertia, at the reference posture, at `bandwidth` with `damping`,
    and are raised where the joint's load (gravity, friction) would leave it more than `droop` of
    its range behind; `kp` and `kd` (N m/rad and N m s/rad, or N/m and N s/m), one number for all
    joints or one each, replace that design. The velocity that the controller feeds back carries
    the encoder error's slope through a first-order low-pass at `velocity_cutoff`; far above the
    control rate it is the plain backward difference.
    """

    rate: float = field(default=1000.0, metadata={"unit": "Hz"})
    bandwidth: float = field(default=10.0, metadata={"unit": "Hz"})
    damping: float = 0.7
    droop: float = field(default=0.005, metadata={"unit": "1"})
    velocity_cutoff: float = field(default=30.0, metadata={"unit": "Hz"})
    kp: float | Sequence[float] | None = None
    kd: float | Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Raises UsageError for gains that are no positive numbers, or given by halves."""
        if (self.kp is None) != (self.kd is None):
            raise UsageError("A controller is declared with both kp and kd, or with neither.")
        for name, gains in (("kp", self.kp), ("kd", self.kd)):
            if gains is not None and not _positive(gains):
                raise UsageError(f"{name} = {gains!r}: gains are positive numbers, one or a list.")

    def design_rate(self, recording: float) -> float:
        """The control rate (Hz); the recording rate must divide it."""
        ratio = self.rate / recording
        if abs(ratio - round(ratio)) > 1e-9 or ratio < 1:
            raise UsageError(
                f"The rate {recording} Hz does not divide the control rate {self.rate} Hz."
            )
        return self.rate

    def run(
        self, plant: Plant, commanded: Trajectory, encoder: Array
    ) -> tuple[Oracle, Controller | None]:
        """What happens when the robot tracks the motion; `encoder` (N, nv): error of each reading.

        Raises UnsupportedError for a floating robot, SimulationError where the loop diverges.
        """
        robot = plant.robot
        if robot.floating or any(joint.kind == "ball" for joint in robot.joints):
            raise UnsupportedError(
                f"{robot.name}: closed-loop needs a fixed base with hinges and slides."
            )
        controller = self.controller(plant)
        return self.track(plant, controller, commanded, encoder), controller

    def track(
        self, plant: Plant, controller: Controller, commanded: Trajectory, encoder: Array
    ) -> Oracle:
        """The motion and torques of a plant under a given controller."""
        robot = plant.robot
        # The engine takes an input that is not a number for zero, with a warning alone.
        check_finite(robot.name, encoder, "encoder error")
        mj = controlled_model(plant, controller)
        control = commands(controller, commanded, encoder, robot)
        steps = _steps_with_laws if plant.laws else _rollout
        q, v, a, tau = steps(plant, mj, commanded, control)
        motion = Trajectory(commanded.t, q, v, a, "closed loop", commanded.period)
        for name, array in (("position", q), ("acceleration", a)):
            check_finite(robot.name, array, f"{name} in closed loop")
        _check_tracking(robot, commanded, motion, tau)
        return Oracle(motion, tau)

    def controller(self, plant: Plant) -> Controller:
        """The declared controller of a plant."""
        kp, kd = self._declared(plant.robot) or self._designed(plant)
        decay = fastest_decay(plant.bench, kd + plant.terms.viscous)
        return Controller(kp, kd, self.rate, self.velocity_cutoff, decay <= EXPLICIT * self.rate)

    def _declared(self, robot: RobotModel) -> tuple[Array, Array] | None:
        if self.kp is None or self.kd is None:
            return None
        return _per_joint(self.kp, robot), _per_joint(self.kd, robot)

    def _designed(self, plant: Plant) -> tuple[Array, Array]:
        """Gains (nv,) from the bandwidth, the damping and the load."""
        J, load = _own_inertia(plant), typical_load(plant)
        reach = np.minimum(plant.robot.limits.q_high - plant.robot.limits.q_low, 2 * np.pi)
        kp = np.maximum((2 * np.pi * self.bandwidth) ** 2 * J, load / (self.droop * reach))
        # Beyond this the sampled loop rings: half a radian per sample of the inertia, or of the lag
        # that the joint's own viscous friction makes.
        kp = np.minimum(
            kp, np.maximum(J * (0.5 * self.rate) ** 2, plant.terms.viscous * 0.5 * self.rate)
        )
        kp = _one_digit(kp)
        return kp, _one_digit(2 * self.damping * np.sqrt(kp * J))


def _positive(gains: object) -> bool:
    values = gains if isinstance(gains, (list, tuple)) else [gains]
    return bool(values) and all(
        isinstance(x, (int, float)) and not isinstance(x, bool) and 0 < x < np.inf for x in values
    )


def _per_joint(gains: float | Sequence[float], robot: RobotModel) -> Array:
    """Declared gains (nv,); raises UsageError where their number is not that of the joints."""
    values = np.atleast_1d(np.asarray(gains, dtype=float))
    if len(values) not in (1, robot.nv):
        raise UsageError(
            f"{robot.name} has {robot.nv} joints, and the controller {len(values)} gains; write "
            "one for all, or one each."
        )
    return np.broadcast_to(values, (robot.nv,)).copy()


def _one_digit(gains: Array) -> Array:
    """Gains (nv,) to one significant digit, as one tunes them: more would tell methods the true
    inertia, since the controller is declared."""
    size = 10.0 ** np.floor(np.log10(gains))
    return np.round(gains / size) * size


def _own_inertia(plant: Plant) -> Array:
    """Diagonal of M (nv,) at the reference posture, kg m^2 or kg."""
    return np.diag(_mass_matrix(plant.bench)).copy()


def _mass_matrix(mj: mujoco.MjModel) -> Array:
    """M (nv, nv) at the reference posture."""
    data = mujoco.MjData(mj)
    mujoco.mj_forward(mj, data)
    M = np.zeros((mj.nv, mj.nv))
    mujoco.mj_fullM(mj, data, M)
    return M


def typical_load(plant: Plant) -> Array:
    """RMS gravity torque plus friction at half the velocity limit (nv,)."""
    gravity = gravity_rms(plant.robot, plant.bench)
    moving = plant.terms.viscous * 0.5 * plant.robot.limits.v
    return gravity + moving + plant.terms.coulomb + np.abs(plant.terms.offset)


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
    mj = plant.compiled(spec)
    mj.opt.timestep = 1.0 / controller.rate
    if controller.held:
        mj.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
        mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    else:
        mj.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    return mj


def fastest_decay(mj: mujoco.MjModel, damping: Array) -> float:
    """Largest rate (1/s) at which damping (nv,) alone brings a velocity to rest, at the reference
    posture."""
    root = np.sqrt(damping)
    return float(np.linalg.eigvalsh(root[:, None] * np.linalg.inv(_mass_matrix(mj)) * root)[-1])


def commands(
    controller: Controller, commanded: Trajectory, encoder: Array, robot: RobotModel
) -> Array:
    """Motor inputs u (N, nv) such that kp (u - q) - kd v is the law on what the encoders read:
    kp (q_ref - q - n) + kd (v_ref - v - s), s the low-passed backward difference of the error n."""
    difference = np.diff(encoder, axis=0, prepend=encoder[:1]) * controller.rate
    keep = float(np.exp(-2 * np.pi * controller.velocity_cutoff / controller.rate))
    slope = lfilter([1 - keep], [1, -keep], difference, axis=0)
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


def _check_saturation(robot: RobotModel, dof: int, name: str, tau: Array) -> None:
    limit = robot.limits.tau[dof]
    share = float((np.abs(tau[:, dof]) >= 0.999 * limit).mean())
    if share > 0.01:
        raise SimulationError(
            f"{robot.name}: {name} loses its motion, its motor at the limit of {limit:.3g} N m or "
            f"N in {100 * share:.0f} % of the samples; lower limits.{name}.a in the robot's "
            "manifest, or the payload."
        )


def _check_tracking(
    robot: RobotModel, commanded: Trajectory, motion: Trajectory, tau: Array
) -> None:
    lost = np.abs(motion.q - commanded.q).max(axis=0)
    bad = [joint for joint in robot.joints if lost[joint.qadr] > 1.0]
    if bad:
        worst = max(bad, key=lambda joint: float(lost[joint.qadr]))
        _check_saturation(robot, worst.vadr, worst.name, tau)
        raise SimulationError(
            f"{robot.name}: {worst.name} loses its motion by {lost[worst.qadr]:.3g} rad or m; "
            "lower the motion's limits or change the controller's bandwidth, until the loop tracks."
        )
