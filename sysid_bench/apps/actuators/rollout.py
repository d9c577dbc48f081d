"""Closed-loop simulation of a robot under recorded commands, and its error in position.

A general optimiser fits the same simulation, as other tools do it, with the parameters and their
split of the bounded linear fit."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import mujoco
import numpy as np

from sysid_bench.apps.actuators.drive_rows import (
    ACCURACY,
    base_motion,
    drive_filter,
    joint_indices,
    limited_commands,
)
from sysid_bench.errors import SimulationError, UnsupportedError
from sysid_bench.identification.optimisers import (
    BudgetUse,
    Optimiser,
    SearchResult,
    SimulatedCost,
    parse_budget,
    run_search,
)
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.position_control import Commands
from sysid_bench.simulation.plant import contact_free
from sysid_bench.types import Array

STEP: Final = 1e-3
"""s, of the simulation, with MuJoCo's `implicitfast`."""

LOST: Final = 1e3
"""rad, m, from the recorded position: a simulation this far off has diverged."""

MARGIN: Final = 60
"""Most samples at the end of a recording that are not judged: as in the figures that others have
published for the recordings of legs."""

HEAVY: Final = 1e9
"""kg, kg m^2 added to a base whose motion is given: what the links do to it is lost in this."""

FITTED: Final = 0.6
"""Share of a recording that is fitted where no test recording is given; the rest is judged."""

END: Final = 0.05
"""Largest share of a recording that is left out at its end."""


def test_end(count: int) -> int:
    """Return the end of the samples of a recording that are judged."""
    return count - min(MARGIN, int(END * count))


@dataclass(frozen=True, eq=False)
class Drives:
    """Actuators of `joints`: `values` (k, 4) in the order of UNKNOWNS, and the delay (s) of their
    commands; `more` (k,): values of MORE unknowns and of SERVO limits, by name."""

    joints: tuple[str, ...]
    values: Array
    delay: float
    more: Mapping[str, Array] = field(default_factory=dict)

    def apply(self, commands: Commands) -> Commands:
        """Return what acts on the joints: gains, torques and limits times the gain, and positions
        without the encoders' bias."""
        commands = limited_commands(commands, self.more)
        gain = self.more.get("gain", np.ones(len(commands.joints)))
        bias = self.more.get("bias", 0.0)
        return replace(
            commands,
            q=commands.q + bias,
            q_des=commands.q_des + bias,
            kp=commands.kp * gain,
            kd=commands.kd * gain,
            feedforward=commands.feedforward * gain,
            limit=commands.limit * gain,
            line=None if commands.line is None else commands.line * [gain, np.ones_like(gain)],
        )


def simulated_positions(
    robot: RobotModel, drives: Drives, commands: Commands, rows: slice
) -> Array:
    """Return q (n, k) at the samples `rows` of the commands, from the recorded state at the first.

    Raises UnsupportedError for robots of `missing_simulation`, SimulationError where it diverges.
    """
    acting = drives.apply(commands)
    mj = drive_model(robot, drives, acting)
    places = joint_indices(robot, drives.joints)
    q = positions_of(mj, places, drives.delay, acting, rows, drives.more.get("load"))
    return np.asarray(q - drives.more.get("bias", 0.0))


def missing_simulation(robot: RobotModel) -> str:
    """Return the reason for which the actuators of a robot are not simulated; empty if they are."""
    if robot.coupling is not None:
        return "the simulation of actuators does not close coupled joints"
    if robot.joint_terms.viscous_coupling.any():
        return "the simulation of actuators has no viscous friction between joints"
    return ""


def drive_model(robot: RobotModel, drives: Drives, commands: Commands) -> mujoco.MjModel:
    """Return the robot's model with the drives and the gains of the first sample: `implicitfast`,
    contacts and limits off, steps of STEP or the next shorter ones that divide a sample.

    Raises UnsupportedError for robots of `missing_simulation`, SimulationError for limits that
    leave no torque.
    """
    if reason := missing_simulation(robot):
        raise UnsupportedError(f"{robot.name}: {reason}.")
    spec = robot.spec.copy()
    for j, name in enumerate(drives.joints):
        joint = spec.joint(name)
        joint.armature, viscous, joint.frictionloss, offset = drives.values[j]
        # MuJoCo 4 has polynomial damping: terms of higher order are not fitted.
        joint.damping = [viscous, *np.zeros(np.size(joint.damping) - 1)]
        _add_motor(spec, name, (commands.kp[0, j], commands.kd[0, j], commands.limit[j]), offset)
    for name in drives.joints if commands.band is not None else ():
        # kp times the error within the band, taken off again: its gains follow in `_set_motors`.
        band = spec.add_actuator(name=BAND + name, target=name)
        band.trntype, band.biastype = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtBias.mjBIAS_AFFINE
        band.forcerange, band.forcelimited = [-1.0, 1.0], True
    mj = contact_free(spec.compile())
    mj.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    mj.opt.timestep = simulation_step(commands.rate)
    return mj


BAND: Final = "dead band of "
"""Name of the actuator that takes the torque within the dead band of a joint off."""


def simulation_step(rate: float) -> float:
    """Return the step (s) of the simulation of samples at a rate (Hz): STEP, or the next shorter
    one that divides a sample."""
    return 1.0 / rate / float(np.ceil(1.0 / (rate * STEP) - 1e-9))


def _add_motor(
    spec: mujoco.MjSpec, joint: str, gains: tuple[float, float, float], offset: float
) -> None:
    """Add a motor of kp, kd and a limit, with tau = clip(kp (u - q) - kd v) - offset; raise
    SimulationError where the limit leaves no torque."""
    kp, kd, limit = gains
    motor = spec.add_actuator(name=f"motor of {joint}", target=joint)
    motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
    motor.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    motor.gainprm[0], motor.biasprm[:3] = kp, [-offset, -kp, -kd]
    if np.isfinite(limit):
        # The bias is a part of the force that is limited, so the limits move with it.
        low, high = -limit - offset, limit - offset
        if not low < high:
            raise SimulationError(
                f"{joint}: a torque limit of {limit:.3g} beside an offset of {offset:.3g} leaves "
                "no torque; check tau.pd.limit and the gain."
            )
        motor.forcerange, motor.forcelimited = [low, high], True


def positions_of(
    mj: mujoco.MjModel,
    places: tuple[list[int], list[int]],
    delay: float,
    commands: Commands,
    rows: slice,
    load: Array | None = None,
) -> Array:
    """Return the positions (n, k) of a driven model under commands, which act a delay (s) after
    they were recorded, rounded to steps; `places`: indices of the joints in q and in v; `load`
    (k,): friction over the torque of the links, set at every sample.

    Raises SimulationError where the robot diverges.
    """
    # One start for the whole section: errors add up, as they do where the model is used.
    first, last, _ = rows.indices(len(commands))
    at_q, at_v = places
    # The first index of a transmission is that of a tendon, site or body in other kinds.
    of_joint = np.flatnonzero(mj.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
    moved = mj.jnt_dofadr[mj.actuator_trnid[of_joint, 0]].tolist()
    motors = [int(of_joint[moved.index(dof)]) for dof in at_v]
    each = round(1.0 / (commands.rate * mj.opt.timestep))
    controls = np.zeros((last - first, each, mj.nu))
    acting = np.arange(first * each, last * each) - round(delay * commands.rate * each)
    bands = [] if commands.band is None else [mj.actuator(BAND + x).id for x in commands.joints]
    acting_controls = _controls(commands, acting, each).reshape(last - first, each, -1)
    for of in (motors, bands) if bands else (motors,):
        controls[:, :, of] = acting_controls
    data = mujoco.MjData(mj)
    data.qpos[at_q], data.qvel[at_v] = commands.q[first], commands.velocity[first]
    _fill_buffers(mj, data, motors, commands, first * each)
    found, friction = np.empty((last - first, len(at_q))), mj.dof_frictionloss[at_v].copy()
    place_base, known = _base_placer(mj, data, commands), np.empty(mj.nv)
    for k, steps in enumerate(controls):
        place_base(first + k)
        found[k] = data.qpos[at_q]
        _set_motors(mj, (motors, bands), commands, first + k, data.qvel[at_v])
        if load is not None:
            # The size of the torque that moves the links, without that of armature.
            mujoco.mj_mulM(mj, data, known, data.qacc)
            moving = np.abs(known - mj.dof_armature * data.qacc + data.qfrc_bias)
            mj.dof_frictionloss[at_v] = friction + load * moving[at_v]
        _take_steps(mj, data, steps)
    if not np.isfinite(found).all() or np.abs(found - commands.q[rows]).max() > LOST:
        raise SimulationError(
            "The simulation under the recorded commands diverges; check gains, units and signs of "
            "the recording."
        )
    return found


def _base_placer(
    mj: mujoco.MjModel, data: mujoco.MjData, commands: Commands
) -> Callable[[int], None]:
    """Return what puts the base where it was recorded at a sample, with its acceleration until the
    next one; the base becomes too heavy for the links to move. Without a recorded base, nothing."""
    if commands.base is None:
        return lambda sample: None
    rate = commands.rate
    moved = base_motion(commands.base, rate, mj.opt.gravity, drive_filter(rate), ACCURACY)
    joint = int(np.flatnonzero(mj.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))[0])
    q, v = int(mj.jnt_qposadr[joint]), int(mj.jnt_dofadr[joint])
    of_q, of_v = slice(q, q + 7), slice(v, v + 6)
    mj.dof_armature[of_v], mj.dof_damping[of_v], mj.dof_frictionloss[of_v] = HEAVY, 0.0, 0.0
    # The acceleration that holds until the next sample is the mean of both ends.
    held = 0.5 * (moved.a + np.concatenate([moved.a[1:], moved.a[-1:]]))

    def place(sample: int) -> None:
        data.qpos[of_q], data.qvel[of_v] = moved.q[sample], moved.v[sample]
        data.qfrc_applied[of_v] = HEAVY * held[sample]

    return place


def _controls(commands: Commands, steps: Array, each: int) -> Array:
    """Return the controls (n, k) of steps counted from the first sample, `each` in a sample."""
    at = np.maximum(steps // each, 0)
    kp, kd = commands.kp[at], commands.kd[at]
    more = kd * commands.v_des[at] + commands.feedforward[at]
    # Desired velocity and feed-forward torque act through the same input as the position.
    more = np.divide(more, kp, out=np.zeros_like(more), where=kp > 0.0)
    return np.asarray(commands.q_des[at] + more)


def _fill_buffers(
    mj: mujoco.MjModel, data: mujoco.MjData, motors: Sequence[int], commands: Commands, first: int
) -> None:
    """Fill the buffers of past inputs, of actuators that have one, before the step `first`."""
    each = round(1.0 / (commands.rate * mj.opt.timestep))
    for j, motor in enumerate(motors):
        past = int(mj.actuator_history[motor, 0])
        if past:
            before = np.arange(-past, 0)
            values = _controls(commands, first + before, each)[:, [j]]
            times = before * mj.opt.timestep
            mujoco.mj_initCtrlHistory(mj, data, motor, times, np.ascontiguousarray(values))


def _take_steps(mj: mujoco.MjModel, data: mujoco.MjData, controls: Array) -> None:
    """Take one step for each row of the controls, together where they are equal."""
    # One call for held commands: the loop over steps then runs in MuJoCo.
    if (controls == controls[0]).all():
        data.ctrl[:] = controls[0]
        mujoco.mj_step(mj, data, len(controls))
        return
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(mj, data)


def _set_motors(
    mj: mujoco.MjModel,
    actuators: tuple[Sequence[int], Sequence[int]],
    commands: Commands,
    sample: int,
    v: Array,
) -> None:
    """Set the gains of a sample, of motors and dead bands, and the limits at velocities (k,) where
    they fall with them."""
    motors, bands = actuators
    kp, kd = commands.kp[sample], commands.kd[sample]
    mj.actuator_gainprm[motors, 0] = kp
    mj.actuator_biasprm[motors, 1], mj.actuator_biasprm[motors, 2] = -kp, -kd
    if commands.band is not None:
        mj.actuator_gainprm[bands, 0], mj.actuator_biasprm[bands, 1] = -kp, kp
        within = np.maximum(kp * commands.band, 1e-9)  # a range of zero is none
        mj.actuator_forcerange[bands] = np.stack([-within, within], axis=1)
    if commands.line is not None:
        # The bias of `_add_motor` is a part of the force that is limited.
        offset = -mj.actuator_biasprm[motors, 0]
        limits = np.stack(commands.torque_limits(v), axis=1)
        mj.actuator_forcerange[motors] = limits - offset[:, None]


def rollout_error(robot: RobotModel, drives: Drives, commands: Commands, rows: slice) -> Array:
    """Return the RMS error (k,) of the simulated positions, in rad or m."""
    q = simulated_positions(robot, drives, commands, rows)
    return np.asarray(np.sqrt(np.mean((q - commands.q[rows]) ** 2, axis=0)))


UNIT: Final = np.array([0.01, 0.1, 0.1, 0.5])
"""Coordinate 1 of armature, viscous and Coulomb friction and offset (SI units)."""

LOW: Final = np.array([0.0, 0.0, 0.0, -20.0])
HIGH: Final = np.array([20.0, 20.0, 50.0, 20.0])
"""Bounds of the coordinates: no negative armature or friction, and far beyond those of legs."""


@dataclass(frozen=True, eq=False)
class SimulatedDrives:
    """The best drives that a search has simulated, the indices of the values on a bound (k, 4),
    and how the search ended."""

    drives: Drives
    at_bound: Array
    optimum: SearchResult


@dataclass(frozen=True, eq=False)
class SimulatedPart:
    """A section `rows` of recorded commands that is simulated from its first state."""

    robot: RobotModel
    commands: Commands
    rows: slice

    def fit(self, optimiser: Optimiser, start: Drives, budget: str | None) -> SimulatedDrives:
        """Return the drives of least squared position error, from a `start` whose delay is kept,
        within a budget, "10 s" of CPU time or "500 simulations" (None: no limit).

        Raises SimulationError where the start cannot be simulated, UsageError for another budget.
        """
        k = len(start.joints)
        low, high = (np.tile(x, k) for x in (LOW, HIGH))
        # The start of a free fit may lie beyond the bounds, where optimisers refuse it.
        first = np.clip((start.values / UNIT).ravel(), low, high)

        def drives(x: Array) -> Drives:
            return Drives(start.joints, x.reshape(k, 4) * UNIT, start.delay)

        def residuals(x: Array) -> Array:
            # Position errors, over the root of their number: the cost is their mean square.
            simulated = simulated_positions(self.robot, drives(x), self.commands, self.rows)
            error = simulated - self.commands.q[self.rows]
            return np.asarray(error.ravel() / np.sqrt(error.size))

        found = run_search(
            optimiser, SimulatedCost(residuals, first, low, high), BudgetUse(parse_budget(budget))
        )
        # Within a thousandth of the range an optimiser has stopped at the bound: no estimate.
        near = 1e-3 * (high - low)
        at_bound = (found.x <= low + near) | (found.x >= high - near)
        return SimulatedDrives(drives(found.x), at_bound.reshape(k, 4), found)
