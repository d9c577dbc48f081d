"""Closed-loop simulation: MuJoCo forward, under a joint controller that sees the noisy encoders."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.signal import lfilter

from sysid_bench.errors import SimulationError, UnsupportedError, UsageError
from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.robot import Joint, RobotModel
from sysid_bench.simulation.compiled_steps import simulate_steps
from sysid_bench.simulation.gravity import measured_gravity_rms
from sysid_bench.simulation.plant import Plant, check_finite
from sysid_bench.types import Array, Controller, Oracle, Trajectory

STIFF_FRICTION: Final = ([0.002, 1.0], [0.99, 0.9999, 0.001, 0.5, 2.0])
"""solref and solimp of friction loss: MuJoCo's default is soft and leaves 12 % of the torque of a
joint with Coulomb friction unexplained; with these settings a moving joint leaves 0.03 %."""

EXPLICIT_DECAY: Final = 1.0
"""Steps times the fastest decay up to which velocities are taken explicitly, as a digital
controller holds its torque. An implicit step moves the robot as if every joint had kd + viscous
friction times the step more inertia, and positions then tell another robot than the torques: 17 %
of the torque of a UR5 at 500 Hz. Beyond it an explicit step would ring."""
STIFF_EQUALITY: Final = ([0.002, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0])
"""solref and solimp of couplings, stiff from the start: the default leaves 1 % of the torque, these
less than 0.01 %."""


EXPLICIT_DAMPING: Final = 0.25
"""Share of a joint's velocity that dampers and controller of a coupled robot may take per step."""

MOST_STEPS: Final = 20
"""Steps of a coupled robot per period of its controller."""


LEAD_IN: Final = 50
"""Control periods before the motion of a coupled robot, which are not recorded: constraints that
give way by a hair need a moment to find their place, and torques jump meanwhile."""


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
        """What happens when the robot tracks the motion; `encoder` (N, n): error of each reading.

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
        lead = 0 if robot.coupling is None else LEAD_IN
        whole = _with_lead_in(robot, commanded, lead)
        encoder = np.pad(encoder, ((lead, 0), (0, 0)), "edge")
        control = commands(controller, whole, encoder, robot)
        steps = _steps_with_laws if plant.laws else _rollout
        q, v, a, tau = (signal[lead:] for signal in steps(plant, mj, whole, control))
        motion = Trajectory(commanded.t, q, v, a, "closed loop", commanded.period)
        for name, array in (("position", q), ("acceleration", a)):
            check_finite(robot.name, array, f"{name} in closed loop")
        _check_tracking(robot, commanded, motion, tau)
        return Oracle(motion, tau[:, robot.torque_dofs])

    def controller(self, plant: Plant) -> Controller:
        """The declared controller of a plant, with gains (n,), one per motor."""
        kp, kd = self._declared(plant.robot) or self._designed(plant)
        return Controller(kp, kd, self.rate, self.velocity_cutoff, self._holds(plant, kd))

    def _holds(self, plant: Plant, kd: Array) -> bool:
        """Whether the torque can be held from sample to sample: a coupled robot takes many steps
        between, and its dampers act in each."""
        if plant.robot.coupling is not None:
            return False
        return (
            _fastest_decay(plant.fixed_contact_free_model, kd + plant.terms.viscous)
            <= EXPLICIT_DECAY * self.rate
        )

    def _declared(self, robot: RobotModel) -> tuple[Array, Array] | None:
        if self.kp is None or self.kd is None:
            return None
        return _per_motor(self.kp, robot), _per_motor(self.kd, robot)

    def _designed(self, plant: Plant) -> tuple[Array, Array]:
        """Gains (n,) from the bandwidth, the damping and the load."""
        J, load = _own_inertia(plant), _typical_load(plant)
        reach = np.minimum(_range(plant.robot), 2 * np.pi)
        kp = np.maximum((2 * np.pi * self.bandwidth) ** 2 * J, load / (self.droop * reach))
        viscous = _on_motors(plant.robot, plant.terms.viscous, 2)
        # Beyond this the sampled loop rings: half a radian per sample of the inertia, or of the lag
        # that the joint's own viscous friction makes.
        kp = np.minimum(kp, np.maximum(J * (0.5 * self.rate) ** 2, viscous * 0.5 * self.rate))
        kp = _one_digit(kp)
        return kp, _one_digit(2 * self.damping * np.sqrt(kp * J))


def _positive(gains: object) -> bool:
    values = gains if isinstance(gains, (list, tuple)) else [gains]
    return bool(values) and all(
        isinstance(x, (int, float)) and not isinstance(x, bool) and 0 < x < np.inf for x in values
    )


def _per_motor(gains: float | Sequence[float], robot: RobotModel) -> Array:
    """Declared gains (n,); raises UsageError where their number is not that of the motors."""
    values, n = np.atleast_1d(np.asarray(gains, dtype=float)), len(robot.torque_dofs)
    if len(values) not in (1, n):
        raise UsageError(
            f"{robot.name} has {n} motors, and the controller {len(values)} gains; write one for "
            "all, or one each."
        )
    return np.broadcast_to(values, (n,)).copy()


def _one_digit(gains: Array) -> Array:
    """Gains (n,) to one significant digit, as one tunes them: more would tell methods the true
    inertia, since the controller is declared."""
    size = 10.0 ** np.floor(np.log10(gains))
    return np.round(gains / size) * size


def _on_motors(robot: RobotModel, values: Array, power: int) -> Array:
    """Figures (nv,) of single joints as the motors (n,) feel them at the reference posture, through
    |G| (power 1: forces) or its square (2: what times a rate or acceleration makes a force)."""
    if robot.coupling is None:
        return values
    q = robot.coupling.reference(np.array(robot.mj.qpos0))
    return values @ np.abs(robot.coupling.G(q[None])[0]) ** power


def _range(robot: RobotModel) -> Array:
    """How far each motor (n,) can go."""
    if robot.coupling is not None:
        return robot.coupling.high - robot.coupling.low
    return robot.limits.q_high - robot.limits.q_low


def _own_inertia(plant: Plant) -> Array:
    """Diagonal of M (n,) at the reference posture, kg m^2 or kg."""
    return np.diag(_mass_matrix(plant.fixed_contact_free_model, plant.robot.coupling)).copy()


def _mass_matrix(mj: mujoco.MjModel, coupling: Coupling | None = None) -> Array:
    """M (n, n) at the reference posture."""
    data = mujoco.MjData(mj)
    if coupling is not None:
        data.qpos[:] = coupling.reference(np.array(mj.qpos0))
    mujoco.mj_forward(mj, data)
    M = np.zeros((mj.nv, mj.nv))
    mujoco.mj_fullM(mj, data, M)
    if coupling is None:
        return M
    G = coupling.G(data.qpos[None])[0]
    return G.T @ M @ G


def _typical_load(plant: Plant) -> Array:
    """RMS gravity torque plus friction at half the velocity limit (n,)."""
    robot, terms = plant.robot, plant.terms
    load = measured_gravity_rms(robot, plant.fixed_contact_free_model)
    moving = terms.viscous * 0.5 * robot.limits.v
    for force in (moving, terms.coulomb, np.abs(terms.offset)):
        load = load + _on_motors(robot, force, 1)
    return load


def controlled_model(plant: Plant, controller: Controller) -> mujoco.MjModel:
    """The plant's model with one motor per joint whose bias law is the controller's feedback."""
    spec = plant.robot.spec.copy()
    motors = _motors(plant.robot)
    for joint, kp, kd in zip(motors, controller.kp, controller.kd, strict=True):
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
    for equality in spec.equalities:
        equality.solref, equality.solimp = STIFF_EQUALITY
    mj = plant.compiled(spec)
    mj.opt.timestep = 1.0 / controller.rate
    mj.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    if plant.robot.coupling is not None:
        _enable_couplings(mj, plant, controller)
    elif controller.held:
        mj.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
        mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    return mj


def _fastest_decay(mj: mujoco.MjModel, damping: Array) -> float:
    """Largest rate (1/s) at which damping (nv,) alone brings a velocity to rest, at the reference
    posture."""
    root = np.sqrt(damping)
    return float(np.linalg.eigvalsh(root[:, None] * np.linalg.inv(_mass_matrix(mj)) * root)[-1])


def _enable_couplings(mj: mujoco.MjModel, plant: Plant, controller: Controller) -> None:
    """Lets the couplings of a model act. An implicit integrator moves joints in spite of their
    constraints: of a gripper's torque it leaves 7 % unexplained, an explicit one 0.01 %."""
    bits = mujoco.mjtDisableBit
    mj.opt.disableflags &= ~int(bits.mjDSBL_EQUALITY)
    mj.opt.disableflags |= int(bits.mjDSBL_EULERDAMP)
    mj.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
    # Explicit dampers are stable up to 2 per step, and smooth far below.
    damping = _on_motors(plant.robot, plant.terms.viscous, 2) + controller.kd
    fastest = float((damping / _own_inertia(plant)).max()) / controller.rate
    mj.opt.timestep /= max(1, min(MOST_STEPS, int(np.ceil(fastest / EXPLICIT_DAMPING))))


def _with_lead_in(robot: RobotModel, commanded: Trajectory, count: int) -> Trajectory:
    """The motion with `count` samples before it, at its first acceleration."""
    if robot.coupling is None or count == 0:
        return commanded
    step = commanded.t[1] - commanded.t[0]
    dt = -step * np.arange(count, 0, -1.0)[:, None]
    q0, v0, a0 = commanded.q[:1], commanded.v[:1], commanded.a[:1]
    v, a = v0 + a0 * dt, np.repeat(a0, count, axis=0)
    # Hinges and slides alone: q and v have the same places.
    q, v, a = robot.coupling.completed(q0 + v0 * dt + 0.5 * a0 * dt**2, v, a)
    return Trajectory(
        np.concatenate([commanded.t[0] + dt[:, 0], commanded.t]),
        np.concatenate([q, commanded.q]),
        np.concatenate([v, commanded.v]),
        np.concatenate([a, commanded.a]),
        commanded.name,
    )


def _motors(robot: RobotModel) -> list[Joint]:
    """The joints that carry motors: those that move on their own."""
    moving = set(robot.torque_dofs.tolist())
    return [joint for joint in robot.joints if joint.vadr in moving]


def commands(
    controller: Controller, commanded: Trajectory, encoder: Array, robot: RobotModel
) -> Array:
    """Motor inputs u (N, n) such that kp (u - q) - kd v is the law on what the encoders read:
    kp (q_ref - q - n) + kd (v_ref - v - s), s the low-passed backward difference of the error n."""
    difference = np.diff(encoder, axis=0, prepend=encoder[:1]) * controller.rate
    keep = float(np.exp(-2 * np.pi * controller.velocity_cutoff / controller.rate))
    slope = lfilter([1 - keep], [1, -keep], difference, axis=0)
    places = [joint.qadr for joint in _motors(robot)]
    ratio = controller.kd / controller.kp
    rates = commanded.v[:, robot.torque_dofs]
    return commanded.q[:, places] - encoder + ratio * (rates - slope)


def _rollout(
    plant: Plant, mj: mujoco.MjModel, commanded: Trajectory, control: Array
) -> tuple[Array, Array, Array, Array]:
    """q, v, a and joint torque (N, nv) of every step, in one call of the engine."""
    batch = Batch(mj, 1, nthread=1)
    batch.bind("qpos")[0], batch.bind("qvel")[0] = commanded.q[0], commanded.v[0]
    steps = _steps_per_sample(mj, commanded)
    control = np.repeat(control, steps, axis=0)
    applied = np.broadcast_to(-plant.terms.offset, (len(control), mj.nv))
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
    return before_q[::steps], before_v[::steps], a[::steps], tau[::steps]


def _steps_per_sample(mj: mujoco.MjModel, commanded: Trajectory) -> int:
    return round((commanded.t[1] - commanded.t[0]) / mj.opt.timestep)


def _steps_with_laws(
    plant: Plant, mj: mujoco.MjModel, commanded: Trajectory, control: Array
) -> tuple[Array, Array, Array, Array]:
    """The same, step by step, since the force laws of effects look at each state."""
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:] = commanded.q[0], commanded.v[0]
    return simulate_steps(plant, mj, data, commanded.t, control, _steps_per_sample(mj, commanded))


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
    bad = [joint for joint in _motors(robot) if lost[joint.qadr] > 1.0]
    if bad:
        worst = max(bad, key=lambda joint: float(lost[joint.qadr]))
        _check_saturation(robot, worst.vadr, worst.name, tau)
        raise SimulationError(
            f"{robot.name}: {worst.name} loses its motion by {lost[worst.qadr]:.3g} rad or m; "
            "lower the motion's limits or change the controller's bandwidth, until the loop tracks."
        )
