"""Commands of a recording that separates delay, armature, damping and gains: chirps with steps,
repeated under two sets of gains, with the information of the recording on the actuators."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import mujoco
import numpy as np

from sysid_bench.apps.actuators.delay_profile import delay_effect
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS, DriveRows, drive_rows, joint_indices
from sysid_bench.apps.actuators.rollout import Drives, drive_model, positions_of
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array

LOW: Final = np.array([0.2, 1.5, 0.0, 0.25, 0.0, 0.1])
HIGH: Final = np.array([0.6, 7.0, 6.3, 0.9, 6.3, 0.6])
"""Ranges of a wave: first and last frequency (Hz) and phase of its chirp, rate (Hz), phase and
share of its steps."""

RAMP: Final = 0.5
"""s in which curves grow and fade away."""


@dataclass(frozen=True, eq=False)
class CommandCurves:
    """Commands of k joints: `shapes` (k, 6) within LOW and HIGH, about `centre` (k,) with
    amplitudes `reach` (k,). Each of the `gains`, shares of kp and kd, acts for an equal part."""

    shapes: Array
    centre: Array
    reach: Array
    gains: tuple[tuple[float, float], ...]

    def positions(self, count: int, rate: float) -> Array:
        """Return the commanded positions (count, k) at a rate (Hz): all parts are alike."""
        part = -(-count // len(self.gains))
        t = np.arange(part)[:, None] / rate
        length = part / rate
        first, last, phase, steps, lag, share = self.shapes.T
        # The phase is the integral of the frequency: half of its slope.
        chirp = np.sin(2.0 * np.pi * (first + 0.5 * (last - first) * t / length) * t + phase)
        square = np.sign(np.sin(2.0 * np.pi * steps * t + lag))
        ramp = np.clip(np.minimum(t, length - t) / RAMP, 0.0, 1.0)
        # Chirps excite armature and damping, steps the delay, whose effect grows with q_des'.
        one = self.centre + self.reach * ramp * ((1.0 - share) * chirp + share * square)
        # The same positions under each set of gains: what differs between the parts is due to gains
        # alone. kp moves the trade of the delay against damping, kd that against armature.
        return np.tile(one, (len(self.gains), 1))[:count]

    def commands(self, whole: Commands) -> Commands:
        """Return commands with these positions and gains; `whole` holds the nominal gains."""
        count = len(whole)
        part = np.arange(count) * len(self.gains) // count
        share = np.array(self.gains)[part]
        q_des = self.positions(count, whole.rate)
        kp, kd = whole.kp * share[:, :1], whole.kd * share[:, 1:]
        return replace(whole, q=np.tile(q_des[0], (count, 1)), q_des=q_des, kp=kp, kd=kd)


def random_curves(
    rng: np.random.Generator, centre: Array, reach: Array, gains: tuple[tuple[float, float], ...]
) -> CommandCurves:
    """Return random curves about `centre` within `reach` (k,)."""
    shapes = rng.uniform(LOW, HIGH, (len(centre), len(LOW)))
    return CommandCurves(shapes, centre, reach, gains)


def random_near(curves: CommandCurves, rng: np.random.Generator, spread: float) -> CommandCurves:
    """Return curves whose shapes differ by `spread`, a share of their ranges (one sigma)."""
    moved = curves.shapes + spread * (HIGH - LOW) * rng.normal(size=curves.shapes.shape)
    return replace(curves, shapes=np.clip(moved, LOW, HIGH))


RESIDUAL: Final = 0.05
"""Share of the RMS torque of a joint that the model is expected to leave."""

FLOOR: Final = 0.005
"""rad, m: position error whose torque, kp times it, is left at rest as well."""

CORRELATION: Final = 0.05
"""s, correlation time of these residuals."""

SMALLEST: Final = 1e-12
"""Added to the scaled information, so that what a recording says nothing of has a deviation."""


@dataclass(frozen=True, eq=False)
class DriveInformation:
    """Information matrices (k, 5, 5) of the values of each joint, in the order of UNKNOWNS, and of
    the delay; its value (s) is common to the joints. `rest` (k,): share of the residuals' mean
    square that a second of delay adds beyond what the values of the joint take up."""

    blocks: Array
    rest: Array

    @cached_property
    def matrix(self) -> Array:
        """The whole information matrix (4 k + 1, 4 k + 1); the delay is last."""
        k, each = len(self.blocks), len(UNKNOWNS)
        whole = np.zeros((each * k + 1, each * k + 1))
        for j, block in enumerate(self.blocks):
            places = [*range(each * j, each * (j + 1)), each * k]
            whole[np.ix_(places, places)] += block
        return whole

    @property
    def std(self) -> Array:
        """Deviations (4 k + 1,) of an estimate, the delay's (s) last."""
        return np.sqrt(np.diag(_inverse(self.matrix)))

    @property
    def delay_open(self) -> float:
        """Error (s) of the delay whose effect is as large as the residuals."""
        mean = float(np.mean(self.rest))
        return 1.0 / np.sqrt(mean) if mean > 0.0 else np.inf

    def by_joint(self, armature: Array) -> Array:
        """Return ln det (k,) of the covariance of each joint's armature, over `armature` (k,), and
        of the delay (ms), from the rows of that joint alone."""
        found = []
        for block, nominal in zip(self.blocks, armature, strict=True):
            covariance = _inverse(block)[np.ix_([0, -1], [0, -1])]
            unit = np.array([nominal, 1e-3])
            found.append(np.linalg.slogdet(covariance / np.outer(unit, unit))[1])
        return np.array(found)


def drive_information(rows: DriveRows, delay: float, kp: Array) -> DriveInformation:
    """Return the information of rows at a delay (s), for residuals of RESIDUAL of each joint and
    of FLOOR times its gain kp (k,)."""
    # The delay is a further column, its derivative: information is that of the linearised fit.
    effect = delay_effect(rows, delay)
    total = rows.torque(delay) + rows.links
    sigma = np.hypot(RESIDUAL * np.sqrt(np.mean(total**2, axis=0)), FLOOR * kp)
    # Residuals are correlated: one row per correlation time counts.
    weight = min(1.0, 1.0 / (CORRELATION * rows.rate))
    whole = np.concatenate([rows.features, effect[:, :, None]], axis=2) / sigma[:, None]
    blocks = weight * np.einsum("nkc,nkd->kcd", whole, whole)
    # Information on the delay that the values of the joint do not take up (Schur complement).
    scaled = [1.0 / max(_inverse(block)[-1, -1], SMALLEST) for block in blocks]
    return DriveInformation(blocks, np.array(scaled) / (weight * len(effect)))


def _inverse(matrix: Array) -> Array:
    scale = np.sqrt(np.maximum(np.diag(matrix), SMALLEST))
    # kg m^2, N m s/rad and s differ by decades: on a unit diagonal the small ridge is none.
    unit = matrix / np.outer(scale, scale) + SMALLEST * np.eye(len(matrix))
    return np.asarray(np.linalg.inv(unit) / np.outer(scale, scale))


GAINS: Final = (((1.0, 1.0), (1.0, 0.5)), ((1.0, 1.0), (0.5, 1.0)), ((1.0, 1.0), (0.5, 0.5)))
"""Pairs of sets of gains, as shares of kp and kd, of which the most informative is taken."""

DELAY: Final = 0.005
"""s, of the commands in the design."""

ARMATURE: Final = 0.3
"""Armature of a joint whose file states none, over the inertia of its links."""

DAMPING: Final = 0.1
"""Damping of such a joint, over kd."""

FRICTION: Final = 0.01
"""Coulomb friction of such a joint (N m, N), over kp."""

MARGIN: Final = 0.95
"""Share of the limits that amplitudes are scaled to."""

OTHERS: Final = (0.5, 2.0)
"""Factors of armature and friction under which the limits are kept as well."""

ROUNDS: Final = 12
"""Largest number of times that amplitudes are scaled for the limits."""

SPREAD: Final = 0.15
"""Share of the ranges of shapes by which the search varies them."""

LARGEST: Final = 4.0
"""Largest use of a torque limit that counts: a motor at its speed without load has none."""

BEYOND: Final = 10.0
"""Penalty of a relative excess over a limit."""


@dataclass(frozen=True, eq=False)
class CommandProblem:
    """Robot and limits of a design: `whole` holds the gains in every sample, `drives` the assumed
    actuators; `low`, `high` (rad, m), `v` (/s) and `tau` (N m, N) are limits (k,), `reach` (k,) the
    largest amplitudes. `crowding`: positions (N, k) -> use of the clearance between links, above 1
    where it is not kept. `line`: that of the motors, as in Commands. `pairs`: sets of gains of the
    parts, as shares of kp and kd, of which the most informative are taken."""

    robot: RobotModel
    whole: Commands
    drives: Drives
    low: Array
    high: Array
    v: Array
    tau: Array
    reach: Array
    crowding: Callable[[Array], float] = lambda q: 0.0
    line: Array | None = None
    pairs: tuple[tuple[tuple[float, float], ...], ...] = GAINS

    @property
    def default_position(self) -> Array:
        """Middle of the ranges (k,), the reference position of joints without one."""
        q, _ = joint_indices(self.robot, self.drives.joints)
        middle = 0.5 * (self.low + self.high)
        return np.asarray(np.where(np.isfinite(middle), middle, self.robot.mj.qpos0[q]))


@dataclass(frozen=True, eq=False)
class CommandCandidate:
    """Curves with the simulated motion under them: its commands and positions, uses (4, k) of the
    limits of commanded and simulated position, velocity and torque, and information."""

    curves: CommandCurves
    commands: Commands
    uses: Array
    information: DriveInformation
    criterion: Array

    @property
    def use(self) -> Array:
        """Largest use (k,) of a limit."""
        return np.asarray(self.uses.max(axis=0))


def default_drives(robot: RobotModel, whole: Commands) -> Drives:
    """Return the actuators of the motors and of the model file; where they state none, shares of
    inertia and gains."""
    terms, joints = robot.joint_terms, whole.joints
    _, v = joint_indices(robot, joints)
    mj, data = robot.mj, mujoco.MjData(robot.mj)
    M = np.zeros((mj.nv, mj.nv))
    mujoco.mj_forward(mj, data)
    mujoco.mj_fullM(mj, data, M)
    # mj_fullM contains the armature of the file.
    links = (np.diag(M) - mj.dof_armature)[v]
    armature = _or(terms.armature[v], ARMATURE * links)
    if whole.armature is not None:
        armature = _or(np.nan_to_num(whole.armature[0]), armature)
    viscous = _or(terms.viscous[v], DAMPING * whole.kd[0])
    coulomb = _or(terms.coulomb[v], FRICTION * whole.kp[0])
    values = np.stack([armature, viscous, coulomb, np.zeros(len(joints))], axis=1)
    return Drives(joints, values, DELAY)


def _or(stated: Array, usual: Array) -> Array:
    return np.where(stated > 0.0, stated, usual)


def design_commands(
    brief: CommandProblem,
    rng: np.random.Generator,
    starts: int,
    iterations: int,
    on_value: Callable[[int, float], None] = lambda count, value: None,
) -> CommandCandidate:
    """Return the most informative commands of random curves and their variations.

    The criterion is the sum over the joints of ln det of the covariance of armature and delay,
    by the rows of the joint alone, so that each takes the wave that says most of it. The answer
    keeps the limits where the robot can, also with OTHERS of armature and friction.
    """
    count = 0

    def seen(candidate: CommandCandidate) -> CommandCandidate:
        nonlocal count
        count += 1
        on_value(count, float(candidate.criterion.sum()))
        return candidate

    draws = [
        seen(
            _candidate(
                brief, random_curves(rng, brief.default_position, brief.reach, brief.pairs[0])
            )
        )
        for _ in range(starts)
    ]
    best = draws[0]
    for other in draws[1:]:
        # Joints move each other's links: joined waves are simulated anew, and need not be better.
        best = _better(best, seen(_candidate(brief, _joined(best, other))), other)
    for gains in brief.pairs[1:]:
        best = _better(best, seen(_candidate(brief, replace(best.curves, gains=gains))))
    for _ in range(iterations):
        other = seen(_candidate(brief, random_near(best.curves, rng, SPREAD)))
        best = _better(best, other, seen(_candidate(brief, _joined(best, other))))
    return _within_limits(brief, best)


def _better(*candidates: CommandCandidate) -> CommandCandidate:
    return min(candidates, key=lambda candidate: float(candidate.criterion.sum()))


def _joined(best: CommandCandidate, other: CommandCandidate) -> CommandCurves:
    """Return curves in which each joint has the one that says more of it."""
    wins = (other.criterion < best.criterion)[:, None]
    return replace(best.curves, shapes=np.where(wins, other.curves.shapes, best.curves.shapes))


def _candidate(brief: CommandProblem, curves: CommandCurves) -> CommandCandidate:
    """Simulate curves, once more with smaller amplitudes where a limit is exceeded."""
    commands, uses = _moved(brief, curves, brief.drives)
    if uses.max() > 1.0:
        curves = _scaled(curves, uses)
        commands, uses = _moved(brief, curves, brief.drives)
    return _informed(brief, curves, commands, uses)


def _informed(
    brief: CommandProblem, curves: CommandCurves, commands: Commands, uses: Array
) -> CommandCandidate:
    information = command_information(brief, commands)
    excess = np.maximum(uses.max(axis=0) - 1.0, 0.0)
    # Excess is a penalty and no refusal: amplitudes are scaled to the limits at the end.
    own = information.by_joint(brief.drives.values[:, 0]) + BEYOND * excess
    return CommandCandidate(curves, commands, uses, information, own)


def _scaled(curves: CommandCurves, uses: Array) -> CommandCurves:
    return replace(curves, reach=curves.reach * np.minimum(1.0, MARGIN / uses.max(axis=0)))


def _within_limits(brief: CommandProblem, candidate: CommandCandidate) -> CommandCandidate:
    # The search knows one set of actuators; real ones may move farther under the same commands.
    # The worst of three plants therefore sets the amplitudes, which all of them share.
    values = brief.drives.values
    plants = [brief.drives] + [
        replace(brief.drives, values=values * [factor, factor, factor, 1.0]) for factor in OTHERS
    ]
    curves = candidate.curves
    for _ in range(ROUNDS):
        moved = [_moved(brief, curves, drives) for drives in plants]
        uses = np.max([uses for _, uses in moved], axis=0)
        if uses.max() <= 1.0:
            break
        curves = _scaled(curves, uses)
    return _informed(brief, curves, moved[0][0], uses)


def command_information(brief: CommandProblem, commands: Commands) -> DriveInformation:
    """Return the information of a recording of these commands and positions."""
    controller = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile"}
    data = {name: getattr(commands, name) for name in ("q", "q_des", "kp", "kd")}
    keys = {"joints": list(commands.joints), "rate": commands.rate, "tau": {"pd": controller}}
    log = read_log(log_of(data, keys), brief.robot)
    rows = drive_rows(brief.robot, log, commands.joints)
    return drive_information(rows, brief.drives.delay, brief.whole.kp[0])


def _moved(brief: CommandProblem, curves: CommandCurves, drives: Drives) -> tuple[Commands, Array]:
    """Return commands with the simulated positions, and the uses (4, k) of the limits."""
    commands = curves.commands(brief.whole)
    mj = drive_model(brief.robot, drives, commands)
    places = joint_indices(brief.robot, drives.joints)
    q = positions_of(mj, places, drives.delay, commands, slice(0, len(commands)))
    found = replace(commands, q=q)
    crowding = brief.crowding(q)
    # Use of the torque that robot and motors have at a velocity.
    tau = found.torque(drives.delay)
    low, high = replace(found, limit=brief.tau, line=brief.line).torque_limits(found.velocity)
    available = np.where(tau < 0.0, -low, high)
    share = np.abs(tau) / np.maximum(available, np.abs(tau) / LARGEST + np.finfo(float).tiny)
    uses = np.array([
        _range_use(brief, commands.q_des),
        np.maximum(_range_use(brief, q), crowding),
        np.abs(found.velocity).max(axis=0) / brief.v,
        share.max(axis=0),
    ])  # fmt: skip
    return found, uses


def _range_use(brief: CommandProblem, q: Array) -> Array:
    half = 0.5 * (brief.high - brief.low)
    return np.asarray(np.abs(q - brief.default_position).max(axis=0) / half)
