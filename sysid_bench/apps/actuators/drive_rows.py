"""Rows of the actuators' regression, for robots with known links.

tau - tau_known(q, v, a) = Ia a + fv v + fc s(v) + offset, joint by joint, with both sides through
the same zero-phase filter (Swevers et al., IEEE Control Systems 27(5), 2007). Known is the torque
of the links, of springs and of viscous friction between joints. MORE unknowns add columns: with the
torque of the drive `gain` tau, links at q + `bias` and friction `load` abs(tau_known) s(v), all of
them stay linear once both sides are divided by `gain`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, UsageError, first_names
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.signals.filter import Filter, derivative, filter_of
from sysid_bench.signals.log import Log
from sysid_bench.signals.log_samples import RecordedBase
from sysid_bench.signals.position_control import Commands
from sysid_bench.signals.processing import Processing
from sysid_bench.simulation.inverse import joint_positions
from sysid_bench.spatial import (
    composed_rotation,
    inverse_quaternion,
    matrix_of_quaternion,
)
from sysid_bench.types import Array, Recording, Trajectory


@dataclass(frozen=True, eq=False)
class BaseMotion:
    """Motion of a free joint: q (N, 7), position and quaternion [w, x, y, z] in the world; v and a
    (N, 6), linear in axes of the world, angular in its own ones."""

    q: Array
    v: Array
    a: Array


def base_motion(
    base: RecordedBase, rate: float, gravity: Array, low_pass: Filter, accuracy: int
) -> BaseMotion:
    """Return the motion through a filter at a rate (Hz): rates as they are recorded, else by
    differences of the order `accuracy`. `gravity` (3,) is that of the model, for accelerometers.

    An origin whose velocity is not known is taken at rest: a uniform motion loads no joint.
    """

    def slope(x: Array) -> Array:
        return derivative(low_pass, x, rate, accuracy)

    signals = {name: low_pass.smooth(x, rate) for name, x in base.signals.items()}
    rotation = signals["orientation"]
    # A filtered unit quaternion is shorter than one.
    rotation = rotation / np.linalg.norm(rotation, axis=1, keepdims=True)
    at_rest = np.zeros((len(rotation), 3))
    position = signals.get("position", at_rest)
    velocity = signals["velocity"] if "velocity" in signals else slope(position)
    turning = signals.get("angular_velocity")
    if turning is None:
        # In the body's own axes the angular velocity is 2 q^-1 dq/dt.
        turning = 2.0 * composed_rotation(inverse_quaternion(rotation), slope(rotation))[:, 1:]
    acceleration = signals["acceleration"] if "acceleration" in signals else slope(velocity)
    if base.accelerometer is not None:
        R = matrix_of_quaternion(base.orientation)
        felt = np.einsum("nij,nj->ni", R, base.accelerometer)
        # An accelerometer feels a - g, in the axes of the body.
        acceleration = low_pass.smooth(felt, rate) + gravity
    return BaseMotion(
        q=np.hstack([position, rotation]),
        v=np.hstack([velocity, turning]),
        a=np.hstack([acceleration, slope(turning)]),
    )


def base_indices(robot: RobotModel) -> tuple[slice, slice]:
    """Return the indices of the free joint in positions q and in velocities v.

    Raises UsageError for a robot without one, or with several.
    """
    free = [joint for joint in robot.joints if joint.kind == "free"]
    if len(free) != 1:
        raise UsageError(
            f"The recording holds the motion of a base, but {robot.name} has {len(free)} free "
            "joints; give a model with one, or leave base out."
        )
    return slice(free[0].qadr, free[0].qadr + 7), slice(free[0].vadr, free[0].vadr + 6)


UNKNOWNS: Final = ("Ia", "fv", "fc", "offset")
"""Armature (kg m^2, kg), viscous friction (N m s/rad, N s/m), Coulomb friction (N m, N), constant
torque (N m, N)."""

MORE: Final = ("load", "gain", "bias")
"""Further unknowns: friction over the torque of the links, torque of the drive over that stated (1
where gains are as stated), and position (rad, m) less that of the encoder."""

TILT: Final = 1e-3
"""rad, m, by which positions are moved for the derivative of the links' torque."""

CUTOFF: Final = 15.0
"""Hz, of the low-pass of both sides; legs and arms under position control move below it."""

WIDE: Final = 0.2
"""Cut-off over the sample rate of the low-pass before sign(v), whose steps the other one rounds
like those of the torque, and the highest one of both sides."""

SMOOTHING: Final = 0.02
"""v0 (rad/s, m/s) of Coulomb friction tanh(v / v0)."""

ACCURACY: Final = 4
"""Order of differences: those of order 2 raise the armature by 3 % for motion at 10 Hz."""

MOVING: Final = 0.9
"""Least size of the smooth sign(v) of a row that is used: a joint that sticks has any torque up to
its friction, which no row of this equation gives."""

FEWEST: Final = 100
"""Moving rows of a joint without which all of its rows are used."""

LEAST: Final = 0.1
"""Least armature and viscous friction, over those of the model file: no drive is without them, and
on recorded legs, where zero fits as well, a tenth costs no accuracy."""

SAME_RATE: Final = 0.01
"""Relative difference of rates that clocks may have."""


@dataclass(frozen=True, eq=False)
class DriveRows:
    """Features (N, k, 4 + e) of k joints in the order of UNKNOWNS and of e `more` unknowns, at a
    rate (Hz), and the torque of the `links` (N, k), at positions moved by `bias` (k,; None: zero).
    `commanded`: delay of the commands (s) and limits of the controllers -> torque without that of
    the links (N, k); a measured torque has neither. `armature` (2, k): that of tables of motors and
    its deviation, NaN where there is none; None for none at all. `gains` (k,): joints of one number
    have one stated kp. `low` (k, 3): least armature and friction. `servo` (k,): limits of the
    controllers by name, as in SERVO. Rows in which a joint sticks are zero."""

    joints: tuple[str, ...]
    rate: float
    features: Array
    links: Array
    commanded: Callable[[float, Mapping[str, Array]], Array]
    more: tuple[str, ...] = ()
    bias: Array | None = None
    armature: Array | None = None
    gains: tuple[int, ...] = ()
    low: Array | None = None
    servo: Mapping[str, Array] = field(default_factory=dict)

    def torque(self, delay: float) -> Array:
        """Return the torque (N, k) without that of the links at a delay (s) of the commands."""
        return self.commanded(delay, self.servo)


def drive_rows(
    robot: RobotModel,
    log: Log,
    joints: Sequence[str],
    rows: slice = slice(None),
    more: Sequence[str] = (),
    bias: Array | None = None,
) -> DriveRows:
    """Return the rows of a log, or of some of its samples `rows`, with the links of `robot` and
    `more` unknowns, in the order of MORE; `bias` (k,) is added to positions of links. Raises
    UsageError for recordings that are too short.
    """
    whole = log.recording
    recording = Recording(whole.t[rows], whole.q[rows], whole.tau[rows], whole.rate, whole.rows)
    # One zero-phase filter on both sides of the equation leaves it true, whatever it does to each
    # of them.
    low_pass = drive_filter(recording.rate)
    processing = Processing(low_pass, differentiate=True, accuracy=ACCURACY)
    filtered = processing.apply(recording, robot.joints)
    q, _ = joint_indices(robot, joints)
    used = used_rows(recording.rate, len(recording))
    motion = _with_base(robot, log, filtered.motion, rows, used)
    motion = _moved(robot, motion, q, np.zeros(len(q)) if bias is None else bias)
    rigid = _known_torque(robot, motion, joints)
    friction = _friction_direction(recording.q[:, q], recording.rate)[used]
    measured: Array = filtered.tau[:, list(map(recording.rows.index, joints))] - rigid
    commands, weights = _commands_of(robot, log, joints), _weights(friction)
    stated = np.zeros((1, len(joints)))
    if commands is not None:
        stated = commands.kp[:1]
        if "gain" in more:
            _check_direction(commands.select(rows))

    def commanded(delay: float, servo: Mapping[str, Array]) -> Array:
        if commands is None:  # a measured torque has no delay
            return np.asarray(weights * measured)
        acting = limited_commands(commands, servo).select(rows)
        tau = low_pass.smooth(acting.torque(delay), commands.rate)[used]
        return np.asarray(weights * (tau - rigid))

    return DriveRows(
        joints=tuple(joints),
        rate=recording.rate,
        features=weights[:, :, None] * _features(robot, motion, joints, friction, rigid, more),
        links=weights * rigid,
        commanded=commanded,
        more=tuple(more),
        bias=bias,
        armature=None if commands is None else commands.armature,
        gains=tuple(np.unique(stated, return_inverse=True)[1].ravel().tolist()),
        low=LEAST * model_values(robot, joints)[:, :3] * [1.0, 1.0, 0.0],
    )


def model_values(robot: RobotModel, joints: Sequence[str]) -> Array:
    """Return the values (k, 4) of the model file, in the order of UNKNOWNS."""
    terms, dofs = robot.joint_terms, [robot.rows.index(joint) for joint in joints]
    stated = [terms.armature, terms.viscous, terms.coulomb, terms.offset]
    return np.stack([x[dofs] for x in stated], axis=1)


def _check_direction(commands: Commands) -> None:
    """Raise EstimationError for joints that move against their commands, which no gain explains."""
    q, q_des = (x - x.mean(axis=0) for x in (commands.q, commands.q_des))
    size = np.sqrt((q**2).sum(axis=0) * (q_des**2).sum(axis=0))
    # Half of the motion: a joint that only sags, or hangs on a stop, says nothing of a sign.
    against = (q * q_des).sum(axis=0) < -0.5 * size
    if (against & (size > 0.0)).any():
        names = [name for name, x in zip(commands.joints, against, strict=True) if x]
        raise EstimationError(
            f"--also gain: no gains fit to {first_names(names)}, which moves against its commands. "
            "Check the signs of q and q_des (sysid-bench diagnose)."
        )


def _weights(friction: Array) -> Array:
    """Return the weights (N, k) of rows: zero where a joint sticks. The others have one that keeps
    the number of rows, so that a mean over all of them is one over those that move."""
    moving = np.abs(friction) > MOVING
    count = moving.sum(axis=0)
    # At rest alone, friction and offset are one number, which all rows give.
    moving[:, count < FEWEST] = True
    return np.asarray(moving * np.sqrt(len(moving) / np.maximum(moving.sum(axis=0), 1)))


def _features(
    robot: RobotModel,
    motion: Trajectory,
    joints: Sequence[str],
    friction: Array,
    rigid: Array,
    more: Sequence[str],
) -> Array:
    """Columns (N, k, 4 + e) of UNKNOWNS and of `more`."""
    q, v = joint_indices(robot, joints)
    columns = [motion.a[:, v], motion.v[:, v], friction, np.ones_like(friction)]
    further = {"load": np.abs(rigid) * friction, "gain": rigid}
    # kp times a bias looks like an offset: only gravity that changes with the posture separates
    # them.
    if "bias" in more:
        further["bias"] = _tilted(robot, motion, joints, q)
    return np.stack([*columns, *(further[name] for name in more)], axis=2)


def _friction_direction(q: Array, rate: float) -> Array:
    """Smooth sign of the rate (N, k) of positions, through the filter of the rows."""
    # Differences behind a wider filter than that of the rows: the steps of sign(v) stay steps until
    # the filter of the rows rounds them, as it rounds those of the torque.
    wide = filter_of(f"butter 4 {WIDE * rate:g} Hz zero-phase")
    rates = derivative(wide, wide.smooth(q, rate), rate, ACCURACY)
    return drive_filter(rate).smooth(np.tanh(rates / SMOOTHING), rate)


def _commands_of(robot: RobotModel, log: Log, joints: Sequence[str]) -> Commands | None:
    if log.commands is None:
        return None
    # With the state of the recording, in which held samples are replaced: a drive that repeats a
    # message knows its own state.
    (q, v), whole = joint_indices(robot, joints), log.recording
    own = None if whole.v is None else whole.v[:, v]
    return replace(log.commands.of(joints), q=whole.q[:, q], v=own)


SERVO: Final = ("torque-limit", "speed-limit", "dead-band")
"""Limits of position controllers: largest torque (N m, N) over the gain, largest rate of the
position that is followed (rad/s, m/s), and position error without torque (rad, m). Infinite, or
zero, where there is none."""


def limited_commands(commands: Commands, servo: Mapping[str, Array]) -> Commands:
    """Return the commands that act with the limits of position controllers."""
    if "torque-limit" in servo:
        commands = replace(commands, limit=np.minimum(commands.limit, servo["torque-limit"]))
    if "dead-band" in servo:
        commands = replace(commands, band=servo["dead-band"])
    steps = servo.get("speed-limit", np.full(len(commands.joints), np.inf)) / commands.rate
    limited = np.flatnonzero(np.isfinite(steps))
    if not len(limited):
        return commands
    q_des = commands.q_des.copy()
    followed, step = q_des[0, limited], steps[limited]
    for k, wanted in enumerate(q_des[:, limited]):
        followed = followed + np.clip(wanted - followed, -step, step)
        q_des[k, limited] = followed
    return replace(commands, q_des=q_des)


def drive_filter(rate: float) -> Filter:
    """Return the filter of both sides, and of the motion of a base, at a rate (Hz)."""
    return filter_of(f"butter 4 {min(CUTOFF, WIDE * rate):g} Hz zero-phase")


def used_rows(rate: float, count: int) -> slice:
    """Return the samples of a recording that have rows: those that neither the filter nor the
    differences spoil at its ends."""
    edge = drive_filter(rate).edge(rate) + ACCURACY
    return slice(edge, count - edge)


def _with_base(
    robot: RobotModel, log: Log, motion: Trajectory, rows: slice, used: slice
) -> Trajectory:
    """Return the motion with the recorded one of the base, which is filtered as a whole."""
    if log.base is None:
        return motion
    rate = log.recording.rate
    found = base_motion(log.base, rate, robot.mj.opt.gravity, drive_filter(rate), ACCURACY)
    of_q, of_v = base_indices(robot)
    q, v, a = motion.q.copy(), motion.v.copy(), motion.a.copy()
    q[:, of_q], v[:, of_v], a[:, of_v] = (x[rows][used] for x in (found.q, found.v, found.a))
    return replace(motion, q=q, v=v, a=a)


def _moved(robot: RobotModel, motion: Trajectory, q: Sequence[int], by: Array) -> Trajectory:
    """Return the motion with positions moved by constants (k,)."""
    positions = motion.q.copy()
    positions[:, q] += by
    return robot.completed(replace(motion, q=positions))


def _known_torque(robot: RobotModel, motion: Trajectory, joints: Sequence[str]) -> Array:
    links = torque_regression(robot, robot.inertial_columns).torque(motion, robot.phi.ravel())
    # The springs of the model, and its friction between joints.
    terms = robot.joint_terms
    springs = terms.spring * (joint_positions(robot, motion) - terms.spring_reference)
    known = links + robot.reduced(motion.q, springs + motion.v @ terms.viscous_coupling.T)
    return np.asarray(known[:, [robot.torque_rows.index(joint) for joint in joints]])


def _tilted(
    robot: RobotModel, motion: Trajectory, joints: Sequence[str], q: Sequence[int]
) -> Array:
    """Return the derivative (N, k) of each joint's known torque by its own position."""
    columns = []
    for j, name in enumerate(joints):
        # Central difference: TILT is small against the postures, and its error is of second order.
        ends = (
            _known_torque(robot, _moved(robot, motion, [q[j]], np.array([by])), [name])
            for by in (TILT, -TILT)
        )
        columns.append((next(ends) - next(ends)) / (2.0 * TILT))
    return np.hstack(columns)


def pooled_rows(parts: Sequence[DriveRows]) -> DriveRows:
    """Return the rows of several recordings one after another.

    Raises UsageError where their rates differ.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    rates = sorted({round(part.rate, 6) for part in parts})
    if rates[-1] - rates[0] > SAME_RATE * rates[0]:
        raise UsageError(
            f"The recordings have rates of {', '.join(f'{rate:g}' for rate in rates)} Hz; identify "
            "them one by one, or bring them to one rate."
        )
    return replace(
        first,
        features=np.concatenate([part.features for part in parts]),
        links=np.concatenate([part.links for part in parts]),
        commanded=lambda *x: np.concatenate([part.commanded(*x) for part in parts]),
    )


def joint_indices(robot: RobotModel, joints: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the indices of joints in positions q and in velocities v."""
    found = {dof: (joint.qadr, joint.vadr) for joint in robot.joints for dof in joint.dofs}
    places = [found[name] for name in joints]
    return [q for q, _ in places], [v for _, v in places]
