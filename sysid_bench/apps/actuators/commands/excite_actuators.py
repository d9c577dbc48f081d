"""Design of the recording that separates delay, armature, damping and gains of actuators."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.apps.actuators.command_design import GAINS as PAIRS
from sysid_bench.apps.actuators.command_design import (
    OTHERS,
    RESIDUAL,
    CommandCandidate,
    CommandProblem,
    command_information,
    default_drives,
    design_commands,
)
from sysid_bench.apps.actuators.delay_profile import RESOLVED
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS, joint_indices
from sysid_bench.apps.actuators.rollout import missing_simulation
from sysid_bench.apps.actuators.written_model import torque_limits
from sysid_bench.commands.excite import ACTUATORS, ExciteCommand
from sysid_bench.commands.request import OnValue
from sysid_bench.commands.result import Result, file_text
from sysid_bench.commands.values import check_seed, parse_words
from sysid_bench.csv_text import csv_text
from sysid_bench.errors import UnsupportedError, UsageError, first_names, unknown_name
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.motion_output import check_output
from sysid_bench.models.joint_terms import USUAL
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.mjcf import stated_actuators
from sysid_bench.models.motor_table import motor
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.position_control import Commands, largest_torque, of_motors
from sysid_bench.types import Array

GAINS: Final = ("kp", "kd")
REACH: Final = 0.5
"""rad, m: largest amplitude of a command about the middle of the joint's range."""

CLEARANCE: Final = 0.01
"""m between links."""

CROWDED: Final = 0.08
"""m, of distances that are looked at."""

THINNED: Final = 5
"""Samples per look at the distances."""

STIFF: Final = 0.01
"""rad, m: a servo whose file reaches its torque limit at a smaller error has other gains."""

SATURATED: Final = 0.2
"""rad, m: error of a servo of unknown gains at its torque limit."""

BANDWIDTH: Final = 25.0
"""rad/s, of one without a known torque limit."""

RATIO: Final = 0.7
"""Its damping ratio."""

OPEN: Final = 0.1
"""Relative deviation of an armature from which the answer says what length would do."""

LIMITS: Final = ("v", "tau")
SETTINGS: Final = ("period", "joints", "iterations", "starts")
"""Settings of a search of motions that the design of commands has, too."""

KINDS: Final = ("command", "position", "velocity", "torque")


@dataclass(frozen=True)
class CommandsRequest:
    """Commands to design for a position-commanded robot with known links.

    `gains`: kp (N m/rad, N/m) and kd of its controller, one number or one for each joint; those of
    the model's position actuators where they are absent, and assumed ones where these are none or
    none of a servo: then one set, since it cannot be changed. `limits`: v, tau, alike, in place of
    the robot's. `motors`: names of tables, one or one for each joint, whose torque, speed and
    armature count as well. `joints` that move (None: all); `period` (s) of the recording with both
    sets of gains, `rate` in Hz; `starts` and `iterations` of the search.
    """

    robot: str | Path
    gains: Mapping[str, Sequence[float]] = field(default_factory=dict)
    limits: Mapping[str, Sequence[float]] = field(default_factory=dict)
    motors: Sequence[str] = ()
    out: str | Path | None = None
    joints: Sequence[str] | None = None
    period: float = 20.0
    rate: float = 200.0
    starts: int = 6
    iterations: int = 12
    seed: int = 0
    robots_dir: Path | None = None

    def design(self, on_value: OnValue) -> "CommandsResult":
        """Design commands, and write them to `out`: CSV of t, JOINT.q_des, JOINT.kp, JOINT.kd.

        `on_value` is called during the search. Raises UsageError for unknown names and for one gain
        without the other, UnsupportedError for robots that are not simulated.
        """
        start = time.perf_counter()
        check_seed(self.seed)
        check_output(None, self.out)
        robot = _held_robot(self)
        problem = _problem(self, robot)
        evaluations = 0

        def count(done: int, value: float) -> None:
            nonlocal evaluations
            evaluations = done
            on_value(done, value)

        rng = np.random.default_rng(self.seed)
        candidate = design_commands(problem, rng, self.starts, self.iterations, count)
        if self.out is not None:
            Path(self.out).write_text(_csv(candidate.commands), encoding="utf-8")
        return CommandsResult(
            **_fields(problem, candidate),
            robot=robot.name,
            task=ACTUATORS,
            seed=self.seed,
            rate=self.rate,
            period=len(problem.whole) / self.rate,
            evaluations=evaluations,
            warnings=list(_warnings(self, problem, candidate)),
            file=file_text(self.out),
            seconds=time.perf_counter() - start,
        )


@dataclass(frozen=True, eq=False, repr=False)
class CommandsResult(Result):
    """Designed commands of a position controller. `gains`: kp and kd of each joint, first those
    given, then those of the second part, which are shares of them. Predicted for residuals of 5 %
    of each joint's torque: `delay_std` (s), `armature_std` (by joint, of the assumed armature), and
    `delay_open` (s), the error of the delay that such residuals allow; `one_gain_delay_open`: under
    the first gains alone. `limits` by kind: the largest share used, and its joint."""

    robot: str
    task: str
    joints: list[str]
    seed: int
    rate: float
    period: float
    gains: dict[str, list[list[float]]]
    delay_std: float
    delay_open: float
    one_gain_delay_open: float
    armature_std: dict[str, float]
    assumed: dict[str, dict[str, float]]
    limits: dict[str, dict[str, Any]]
    violations: list[dict[str, Any]]
    evaluations: int
    warnings: list[str]
    file: str | None
    seconds: float
    interrupted: bool = False

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Gains, what the recording tells, use of the limits and the file."""
        worst = max(self.armature_std, key=lambda name: self.armature_std[name])
        changes = []
        for name in GAINS:
            first, second = self.gains[name]
            if second[0] != first[0]:
                changes.append(f"{name} times {second[0] / first[0]:g}")
        half = f", the second half with {' and '.join(changes)}" if changes else ""
        alone = f"; under the first gains alone by {1e3 * self.one_gain_delay_open:.2g} ms"
        lines = [
            f"{self.robot}, task {self.task}: commands of {len(self.joints)} joints for "
            f"{self.period:g} s at {self.rate:g} Hz{half}",
            f"  with residuals of {100 * RESIDUAL:.0f} % of the torque the delay is open by "
            f"{1e3 * self.delay_open:.2g} ms{alone if changes else ''}",
            f"  deviations: delay {1e3 * self.delay_std:.2g} ms, armature up to "
            f"{100 * self.armature_std[worst]:.2g} % ({worst})",
            *(
                f"  {kind:<9} {100 * used['share']:5.1f} % of the limit ({used['at']})"
                for kind, used in self.limits.items()
            ),
        ]
        if not self.violations:
            few, many = OTHERS
            lines.append(
                f"  limits hold in simulation, also with {few:g} and {many:g} times the assumed "
                "armature and friction"
            )
        lines += [f"  warning: {warning}" for warning in self.warnings]
        if self.file:
            lines.append(
                f"  file: {self.file}; record q with it: in the log, q_des, kp and kd of tau.pd "
                "are its columns JOINT.q_des, JOINT.kp and JOINT.kd"
            )
        return "\n".join(lines)


def commands_request(command: ExciteCommand) -> CommandsRequest:
    """Return the commands to design of what stands on the line; raise UsageError for options that
    such a design does not have."""
    settings = command.settings_given()
    given = {
        "objective": command.objective != "cond", "payload": command.payload != "none",
        "sensor": bool(command.sensor), "terms": command.terms is not None,
        "box": bool(command.boxes), "after": bool(command.after), "export": bool(command.export),
        **{name: True for name in settings if name not in SETTINGS},
    }  # fmt: skip
    names = [
        f"--set {name}" if name in command.others else f"--{name}"
        for name, is_given in given.items()
        if is_given
    ]
    if names:
        raise UsageError(
            f"{', '.join(names)}: not for --task {ACTUATORS}, whose commands have "
            f"{', '.join(f'--{name}' for name in SETTINGS)}, --gain, --limit and --motors."
        )
    return CommandsRequest(
        command.robot,
        gains=command.gains,
        limits=command.limits,
        motors=[name for name in parse_words(command.motor_types or "") if name],
        out=command.out,
        rate=command.rate,
        seed=command.seed,
        robots_dir=command.robots_dir,
        **settings,
    )


def _held_robot(request: CommandsRequest) -> RobotModel:
    """The robot with its base and all joints held that do not move, by default none of its hinges
    and slides; raise UsageError for a moving joint that is neither."""
    manifest = find_manifest(str(request.robot), request.robots_dir)
    whole = load_robot(manifest)
    scalar = {joint.name: joint for joint in whole.joints if joint.kind in ("hinge", "slide")}
    for name in request.joints or ():
        if name not in scalar:
            raise unknown_name("joint", name, list(scalar))
    still = {
        joint.name: float(whole.mj.qpos0[joint.qadr]) if joint.name in scalar else 0.0
        for joint in whole.joints
        if joint.name not in (request.joints or scalar)
    }
    robot = load_robot(replace(manifest, locked={**manifest.locked, **still}))
    if reason := missing_simulation(robot):
        raise UnsupportedError(f"{robot.name}: {reason}.")
    return robot


def _problem(request: CommandsRequest, robot: RobotModel) -> CommandProblem:
    joints = tuple(joint.name for joint in robot.joints)
    q, v = joint_indices(robot, joints)
    count, k = round(request.period * request.rate), len(joints)
    zeros = np.zeros((count, k))
    tau = _limit(request, "tau", _torque_limits(robot, joints))
    gains, assumed = _gains(request, robot, joints, tau)
    kp, kd = (np.tile(gains[name], (count, 1)) for name in GAINS)
    names = list(request.motors) or [""]
    if len(names) not in (1, k):
        raise UsageError(
            f"--motors has {len(names)} names; give one, or one for each of {k} joints."
        )
    motors = [motor(name) if name else None for name in (names if len(names) == k else names * k)]
    values = of_motors(motors)
    whole = Commands(
        joints=joints, rate=request.rate, q=zeros, v=None, q_des=zeros, v_des=zeros,
        feedforward=zeros, kp=kp, kd=kd, limit=np.full(k, np.inf), delay=None,
        armature=values["armature"],
    )  # fmt: skip
    limits = robot.limits
    low, high = limits.q_low[v], limits.q_high[v]
    # Commands reach about the middle of a joint's range, at most to its ends.
    half = 0.5 * (high - low)
    return CommandProblem(
        robot=robot,
        whole=whole,
        drives=default_drives(robot, whole),
        low=low,
        high=high,
        v=np.minimum(_limit(request, "v", limits.v[v]), values["line"][1]),
        tau=np.minimum(tau, largest_torque(motors)),
        reach=np.minimum(np.where(np.isfinite(half), half, np.inf), REACH),
        crowding=_crowding(robot, q),
        line=values["line"],
        # The gains of a servo are not known to be changed by known shares.
        pairs=(((1.0, 1.0),),) if assumed else PAIRS,
    )


def _limit(request: CommandsRequest, name: str, usual: Array) -> Array:
    for key in request.limits:
        if key not in LIMITS:
            raise unknown_name("limit", key, LIMITS, "Positions come from the robot.")
    if name not in request.limits:
        return usual
    return _numbers(f"The limit {name}", request.limits[name], len(usual))


def _numbers(what: str, values: Sequence[float], count: int) -> Array:
    """One positive number for each joint."""
    numbers = np.array(values, dtype=float)
    if len(numbers) not in (1, count) or not (numbers > 0).all():
        raise UsageError(
            f"{what} needs one positive number, or one for each of {count} joints; got "
            f"{', '.join(map(str, values))}."
        )
    return np.broadcast_to(numbers, count).copy()


def _gains(
    request: CommandsRequest, robot: RobotModel, joints: Sequence[str], tau: Array
) -> tuple[dict[str, Array], bool]:
    """Return kp and kd (k,) of a request, else of the model's position actuators, else assumed
    ones, which the answer states."""
    if request.gains:
        if absent := set(GAINS) - set(request.gains):
            raise UsageError(f"--gain needs kp and kd; {' and '.join(absent)} is missing.")
        asked = request.gains.items()
        return {k: _numbers(f"The gain {k}", x, len(joints)) for k, x in asked}, False
    stated = stated_actuators(robot.manifest) if robot.format == "mjcf" else {}
    if all(name in stated and stated[name].kp > 0.0 for name in joints):
        own = {k: np.array([getattr(stated[name], k) for name in joints]) for k in GAINS}
        if (tau >= STIFF * own["kp"]).all():
            return own, False
    _, v = joint_indices(robot, joints)
    mj, data = robot.mj, mujoco.MjData(robot.mj)
    M = np.zeros((mj.nv, mj.nv))
    mujoco.mj_forward(mj, data)
    mujoco.mj_fullM(mj, data, M)
    inertia = np.diag(M)[v]
    kp = np.where(np.isfinite(tau), tau / SATURATED, inertia * BANDWIDTH**2)
    return {"kp": kp, "kd": 2.0 * RATIO * np.sqrt(kp * inertia)}, True


def _torque_limits(robot: RobotModel, joints: tuple[str, ...]) -> Array:
    """Return the torque limits (k,) of the joints or of the actuators of the model file."""
    zeros = np.zeros((1, len(joints)))
    return torque_limits(robot, Commands(
        joints=joints, rate=1.0, q=zeros, v=None, q_des=zeros, v_des=zeros, feedforward=zeros,
        kp=zeros, kd=zeros, limit=np.full(len(joints), np.inf), delay=None,
    ))  # fmt: skip


def _crowding(robot: RobotModel, places: Sequence[int]) -> Callable[[Array], float]:
    """Use of the clearance between links along positions (N, k); zero without shapes."""
    scene = collision_model(robot)

    def use(q: Array) -> float:
        whole = np.array(robot.mj.qpos0)
        nearest = CROWDED
        for one in q[::THINNED] if scene.shapes else ():
            whole[list(places)] = one
            nearest = min([nearest, *(distance for distance, _, _ in scene.contact_list(whole))])
        # 0 where no links are near, 1 at the clearance: a use like that of other limits.
        return (CROWDED - nearest) / (CROWDED - CLEARANCE)

    return use


def _fields(problem: CommandProblem, candidate: CommandCandidate) -> dict[str, Any]:
    """Information of the recording, beside one under the first gains alone, and use of limits."""
    joints, values, commands = problem.drives.joints, problem.drives.values, candidate.commands
    std, armature = candidate.information.std, _armature_std(problem, candidate)
    half = len(commands) // len(candidate.curves.gains)
    # What stays open is per sample and not per recording: the first half stands for a whole one
    # under the first gains alone.
    one = command_information(problem, commands.select(slice(0, half)))
    limits = _limit_fields(problem, candidate)
    return {
        "joints": list(joints),
        "delay_std": float(std[-1]),
        "delay_open": candidate.information.delay_open,
        "one_gain_delay_open": one.delay_open,
        "armature_std": dict(zip(joints, armature.tolist(), strict=True)),
        "assumed": {
            name: dict(zip(UNKNOWNS, row.tolist(), strict=True))
            for name, row in zip(joints, values, strict=True)
        },
        "gains": {
            name: [gains[0].tolist(), gains[-1].tolist()]
            for name in GAINS
            for gains in [getattr(commands, name)]
        },
        "limits": limits,
        "violations": [
            {"kind": kind, **row} for kind, row in limits.items() if not row["share"] <= 1.0
        ],
    }


def _armature_std(problem: CommandProblem, candidate: CommandCandidate) -> Array:
    """Deviation (k,) of each armature, over the assumed one."""
    std = candidate.information.std[:-1].reshape(-1, len(UNKNOWNS))[:, 0]
    return np.asarray(std / problem.drives.values[:, 0])


def _limit_fields(
    problem: CommandProblem, candidate: CommandCandidate
) -> dict[str, dict[str, Any]]:
    joints = problem.drives.joints
    return {
        kind: {"share": float(row.max()), "at": joints[int(row.argmax())]}
        for kind, row in zip(KINDS, candidate.uses, strict=True)
    }


def _warnings(
    request: CommandsRequest, problem: CommandProblem, candidate: CommandCandidate
) -> Iterator[str]:
    """Warnings: parameters that stay open, limits that the model does not state."""
    if candidate.information.delay_open > RESOLVED:
        # The limit that is used up is the one to raise.
        used = _limit_fields(problem, candidate)
        kind = max(used, key=lambda name: float(used[name]["share"]))
        yield (
            "within these limits delay and armature stay confounded: allow faster motions; the "
            f"{kind} of {used[kind]['at']} is at its limit"
        )
    if len(problem.pairs) == 1:
        kp = problem.whole.kp[0]
        yield (
            "the gains of the servo are not known, or its file's ask for more than the torque "
            f"limit at an error of {1e3 * STIFF:g} mrad: kp of {kp.min():.3g} to {kp.max():.3g} "
            "N m/rad is assumed, for which alone limits hold: watch the first run. A start for "
            "--task actuators --also gain; give --gain kp=... and kd=... where they are known"
        )
    armature = _armature_std(problem, candidate)
    worst = int(armature.argmax())
    if armature[worst] > OPEN:
        # Deviations fall with the root of the length.
        needed = len(problem.whole) / problem.whole.rate * float(armature[worst] / OPEN) ** 2
        yield (
            f"the recording is short for a light joint: the armature of "
            f"{problem.drives.joints[worst]} stays open by {100 * armature[worst]:.2g} % of the "
            f"assumed one; --period {needed:.0f} leaves {100 * OPEN:g} %, or allow faster motions"
        )
    yield from _model_warnings(request, problem)


def _model_warnings(request: CommandsRequest, problem: CommandProblem) -> Iterator[str]:
    """Warnings about limits and shapes that the model does not state."""
    robot = problem.robot
    whole = load_robot(find_manifest(str(request.robot), request.robots_dir))
    if any(joint.kind == "free" for joint in whole.joints):
        yield "the base is held fixed, on a stand or hung up: no foot may touch the ground"
    # Loading fills in a usual limit where the file states none: that is not a limit of a motor.
    usual = [
        joint.name
        for joint, v in zip(robot.joints, problem.v, strict=True)
        if v == robot.limits.v[joint.vadr] == USUAL[joint.kind][1]
    ]
    if usual and "v" not in request.limits:
        yield (
            f"the model states no velocity limit of {first_names(usual)}: "
            f"{USUAL['hinge'][1]:g} rad/s (slides {USUAL['slide'][1]:g} m/s) are assumed; give "
            "--limit v=..."
        )
    limits = {"position": problem.high, "torque": problem.tau}
    unlimited = [name for name, values in limits.items() if not np.isfinite(values).all()]
    if unlimited:
        yield (
            f"the model states no limits of {', '.join(unlimited)} for some joints: give --limit, "
            "and watch the first run"
        )
    if not collision_model(robot).shapes:
        yield "the model has no shapes: collisions were not checked"


def _csv(commands: Commands) -> str:
    names = ("q_des", "kp", "kd")
    head = ["t", *(f"{joint}.{name}" for name in names for joint in commands.joints)]
    t = np.arange(len(commands)) / commands.rate
    table = np.column_stack([t, *(getattr(commands, name) for name in names)])
    return csv_text([head, *table.tolist()])
