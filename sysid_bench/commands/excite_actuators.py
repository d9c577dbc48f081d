"""Design of the recording that separates delay, armature, damping and gains of actuators."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.apps.actuators.command_design import (
    OTHERS,
    CommandCandidate,
    CommandProblem,
    command_information,
    default_drives,
    design_commands,
)
from sysid_bench.apps.actuators.delay_information import RESOLVED
from sysid_bench.apps.actuators.drive_information import RESIDUAL
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS, joint_indices
from sysid_bench.apps.actuators.rollout import Drives, missing_simulation
from sysid_bench.commands.result import Result, file_text
from sysid_bench.csv_text import csv_text
from sysid_bench.errors import UnsupportedError, UsageError, first_names, unknown_name
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.motion_output import check_output
from sysid_bench.models.joint_terms import USUAL
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.motor_table import Motor, motor
from sysid_bench.models.robot import Joint, RobotModel
from sysid_bench.signals.position_control import Commands, largest_torque, of_motors
from sysid_bench.types import Array
from sysid_bench.verbs.identify.identify_request import check_seed

GAINS: Final = ("kp", "kd")
REACH: Final = 0.5
"""rad, m: largest amplitude of a command about the middle of the joint's range."""

CLEARANCE: Final = 0.01
"""m between links."""

CROWDED: Final = 0.08
"""m, of distances that are looked at."""

THINNED: Final = 5
"""Samples per look at the distances."""

OPEN: Final = 0.1
"""Relative deviation of an armature from which the answer says what length would do."""

TASK: Final = "actuators"
LIMITS: Final = ("v", "tau")
KINDS: Final = ("command", "position", "velocity", "torque")


@dataclass(frozen=True)
class CommandsRequest:
    """Commands to design for a position-commanded robot with known links.

    `gains`: kp (N m/rad, N/m) and kd of its controller, one number or one for each joint; those of
    the model's position actuators where they are absent. `limits`: v, tau, alike, in place of the
    robot's. `motors`: names of tables, one or one for each joint, whose torque, speed and armature
    count as well. `joints` that move (None: all); `period` (s) of the recording with both sets of
    gains, `rate` in Hz; `starts` and `iterations` of the search.
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
        lines = [
            f"{self.robot}, task {self.task}: commands of {len(self.joints)} joints for "
            f"{self.period:g} s at {self.rate:g} Hz, {self._gains_text()}",
            f"  with residuals of {100 * RESIDUAL:.0f} % of the torque the delay is open by "
            f"{1e3 * self.delay_open:.2g} ms; under the first gains alone by "
            f"{1e3 * self.one_gain_delay_open:.2g} ms",
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

    def _gains_text(self) -> str:
        first, second = ([self.gains[name][k] for name in GAINS] for k in range(2))
        shares = [b[0] / a[0] for a, b in zip(first, second, strict=True)]
        words = [
            f"{name} times {share:g}"
            for name, share in zip(GAINS, shares, strict=True)
            if share != 1.0
        ]
        return f"the second half with {' and '.join(words)}"


def excite_actuators(
    request: CommandsRequest, on_value: Callable[[int, float], None]
) -> CommandsResult:
    """Design commands, and write them to `request.out`: CSV of t, JOINT.q_des, JOINT.kp, JOINT.kd.

    Raises UsageError for unknown names and absent gains, UnsupportedError for robots that are not
    simulated.
    """
    start = time.perf_counter()
    check_seed(request.seed)
    check_output(None, request.out)
    robot = _held_robot(request)
    brief = _brief(request, robot)
    evaluations = 0

    def count(done: int, value: float) -> None:
        nonlocal evaluations
        evaluations = done
        on_value(done, value)

    rng = np.random.default_rng(request.seed)
    candidate = design_commands(brief, rng, request.starts, request.iterations, count)
    if request.out is not None:
        Path(request.out).write_text(_csv(candidate.commands), encoding="utf-8")
    return CommandsResult(
        **_predicted(brief, candidate),
        robot=robot.name,
        task=TASK,
        joints=list(brief.drives.joints),
        seed=request.seed,
        rate=request.rate,
        period=len(brief.whole) / request.rate,
        gains={name: _both(getattr(candidate.commands, name)) for name in GAINS},
        limits=_limit_fields(brief, candidate),
        violations=_violations(brief, candidate),
        evaluations=evaluations,
        warnings=_warnings(request, brief, candidate),
        file=file_text(request.out),
        seconds=time.perf_counter() - start,
    )


def _held_robot(request: CommandsRequest) -> RobotModel:
    """The robot with its base and all joints held that do not move."""
    manifest = find_manifest(str(request.robot), request.robots_dir)
    whole = load_robot(manifest)
    wanted = _moved_joints(request, whole)
    still = {
        joint.name: float(whole.mj.qpos0[joint.qadr]) if _is_scalar(joint) else 0.0
        for joint in whole.joints
        if joint.name not in wanted
    }
    robot = load_robot(replace(manifest, locked={**manifest.locked, **still}))
    if reason := missing_simulation(robot):
        raise UnsupportedError(f"{robot.name}: {reason}.")
    return robot


def _moved_joints(request: CommandsRequest, robot: RobotModel) -> Sequence[str]:
    """Joints asked for, by default all hinges and slides; UsageError for one that is neither."""
    scalar = [joint.name for joint in robot.joints if _is_scalar(joint)]
    for name in request.joints or ():
        if name not in scalar:
            raise unknown_name("joint", name, scalar)
    return request.joints or scalar


def _is_scalar(joint: Joint) -> bool:
    return joint.kind in ("hinge", "slide")


def _brief(request: CommandsRequest, robot: RobotModel) -> CommandProblem:
    joints = tuple(joint.name for joint in robot.joints)
    q, v = joint_indices(robot, joints)
    count = round(request.period * request.rate)
    k = len(joints)
    zeros = np.zeros((count, k))
    kp, kd = (np.tile(_gain(request, robot, name, joints), (count, 1)) for name in GAINS)
    limits = robot.limits
    motors = _motors(request, k)
    values = of_motors(motors)
    whole = Commands(
        joints=joints, rate=request.rate, q=zeros, v=None, q_des=zeros, v_des=zeros,
        feedforward=zeros, kp=kp, kd=kd, limit=np.full(k, np.inf), delay=None,
        armature=values["armature"],
    )  # fmt: skip
    low, high = limits.q_low[v], limits.q_high[v]
    half = 0.5 * (high - low)
    return CommandProblem(
        robot=robot,
        whole=whole,
        drives=default_drives(robot, whole),
        low=low,
        high=high,
        v=np.minimum(_limit(request, "v", limits.v[v]), values["line"][1]),
        tau=np.minimum(_limit(request, "tau", limits.tau[v]), largest_torque(motors)),
        reach=np.minimum(np.where(np.isfinite(half), half, np.inf), REACH),
        crowding=_crowding(robot, q),
        line=values["line"],
    )


def _motors(request: CommandsRequest, count: int) -> list[Motor | None]:
    """The motor of each joint, None where none is named."""
    names = list(request.motors) or [""]
    if len(names) not in (1, count):
        raise UsageError(
            f"--motors has {len(names)} names; give one, or one for each of {count} joints."
        )
    found = [motor(name) if name else None for name in names]
    return found if len(found) == count else found * count


def _limit(request: CommandsRequest, name: str, usual: Array) -> Array:
    wrong = next((key for key in request.limits if key not in LIMITS), None)
    if wrong is not None:
        raise unknown_name("limit", wrong, LIMITS, "Positions come from the robot.")
    return _numbers(f"The limit {name}", request.limits[name], len(usual)) if (
        name in request.limits
    ) else usual  # fmt: skip


def _numbers(what: str, values: Sequence[float], count: int) -> Array:
    """One positive number for each joint."""
    numbers = np.array(values, dtype=float)
    if len(numbers) not in (1, count) or not (numbers > 0).all():
        raise UsageError(
            f"{what} needs one positive number, or one for each of {count} joints; got "
            f"{', '.join(map(str, values))}."
        )
    return np.broadcast_to(numbers, count).copy()


def _gain(request: CommandsRequest, robot: RobotModel, name: str, joints: Sequence[str]) -> Array:
    """Gains (k,) of a request, else those of the model's position actuators."""
    if name in request.gains:
        return _numbers(f"The gain {name}", request.gains[name], len(joints))
    mj = robot.mj
    of_joint = mj.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    found = -mj.actuator_biasprm[:, 1 + GAINS.index(name)]
    by_joint = {
        mj.joint(int(mj.actuator_trnid[i, 0])).name: float(found[i])
        for i in np.flatnonzero(of_joint & (found > 0.0))
    }
    if not set(joints) <= set(by_joint):
        raise UsageError(
            f"Which gains has the controller? {robot.name} has no position actuators that state "
            f"them: give --gain kp=20 --gain kd=1, or one for each of {', '.join(joints)}."
        )
    return np.array([by_joint[joint] for joint in joints])


def _crowding(robot: RobotModel, places: Sequence[int]) -> Callable[[Array], float]:
    """Use of the clearance between links along positions (N, k); zero without shapes."""
    scene = collision_model(robot)

    def use(q: Array) -> float:
        whole = np.array(robot.mj.qpos0)
        nearest = CROWDED
        for one in q[::THINNED] if scene.shapes else ():
            whole[list(places)] = one
            nearest = min([nearest, *(distance for distance, _, _ in scene.contact_list(whole))])
        return (CROWDED - nearest) / (CROWDED - CLEARANCE)

    return use


def _predicted(brief: CommandProblem, candidate: CommandCandidate) -> dict[str, Any]:
    """Information of the recording, beside one under the first gains alone."""
    joints, values = brief.drives.joints, brief.drives.values
    std = candidate.information.std
    armature = std[:-1].reshape(-1, len(UNKNOWNS))[:, 0] / values[:, 0]
    half = len(candidate.commands) // len(candidate.curves.gains)
    one = command_information(brief, candidate.commands.select(slice(0, half)))
    return {
        "delay_std": float(std[-1]),
        "delay_open": candidate.information.delay_open,
        "one_gain_delay_open": one.delay_open,
        "armature_std": dict(zip(joints, armature.tolist(), strict=True)),
        "assumed": _assumed(brief.drives),
    }


def _assumed(drives: Drives) -> dict[str, dict[str, float]]:
    return {
        name: dict(zip(UNKNOWNS, row.tolist(), strict=True))
        for name, row in zip(drives.joints, drives.values, strict=True)
    }


def _both(gains: Array) -> list[list[float]]:
    return [gains[0].tolist(), gains[-1].tolist()]


def _limit_fields(brief: CommandProblem, candidate: CommandCandidate) -> dict[str, dict[str, Any]]:
    joints = brief.drives.joints
    return {
        kind: {"share": float(row.max()), "at": joints[int(row.argmax())]}
        for kind, row in zip(KINDS, candidate.uses, strict=True)
    }


def _violations(brief: CommandProblem, candidate: CommandCandidate) -> list[dict[str, Any]]:
    used = _limit_fields(brief, candidate)
    return [{"kind": kind, **row} for kind, row in used.items() if not row["share"] <= 1.0]


def _warnings(
    request: CommandsRequest, brief: CommandProblem, candidate: CommandCandidate
) -> list[str]:
    robot = load_robot(find_manifest(str(request.robot), request.robots_dir))
    found = [*_confounded(brief, candidate), *_too_short(brief, candidate)]
    if any(joint.kind == "free" for joint in robot.joints):
        found.append("the base is held fixed, on a stand or hung up: no foot may touch the ground")
    found += _assumed_velocity(request, brief)
    found += _without_limits(brief)
    if not collision_model(brief.robot).shapes:
        found.append("the model has no shapes: collisions were not checked")
    return found


def _confounded(brief: CommandProblem, candidate: CommandCandidate) -> list[str]:
    if candidate.information.delay_open <= RESOLVED:
        return []
    used = _limit_fields(brief, candidate)
    kind = max(used, key=lambda name: float(used[name]["share"]))
    return [
        "within these limits delay and armature stay confounded: allow faster motions; the "
        f"{kind} of {used[kind]['at']} is at its limit"
    ]


def _assumed_velocity(request: CommandsRequest, brief: CommandProblem) -> list[str]:
    robot = brief.robot
    usual = [
        joint.name
        for joint, v in zip(robot.joints, brief.v, strict=True)
        if v == robot.limits.v[joint.vadr] == USUAL[joint.kind][1]
    ]
    if not usual or "v" in request.limits:
        return []
    return [
        f"the model states no velocity limit of {first_names(usual)}: "
        f"{USUAL['hinge'][1]:g} rad/s (slides {USUAL['slide'][1]:g} m/s) are assumed; give "
        "--limit v=..."
    ]


def _without_limits(brief: CommandProblem) -> list[str]:
    limits = {"position": brief.high, "torque": brief.tau}
    unlimited = [name for name, values in limits.items() if not np.isfinite(values).all()]
    if not unlimited:
        return []
    return [
        f"the model states no limits of {', '.join(unlimited)} for some joints: give --limit, "
        "and watch the first run"
    ]


def _too_short(brief: CommandProblem, candidate: CommandCandidate) -> list[str]:
    """Sentence about armatures that a recording of this length leaves open; deviations fall with
    the root of the length."""
    open_by = _predicted(brief, candidate)["armature_std"]
    worst = max(open_by, key=lambda name: float(open_by[name]))
    if open_by[worst] <= OPEN:
        return []
    needed = len(brief.whole) / brief.whole.rate * (open_by[worst] / OPEN) ** 2
    return [
        f"the recording is short for a light joint: the armature of {worst} stays open by "
        f"{100 * open_by[worst]:.2g} % of the assumed one; --period {needed:.0f} leaves "
        f"{100 * OPEN:g} %, or allow faster motions"
    ]


def _csv(commands: Commands) -> str:
    names = ("q_des", "kp", "kd")
    head = ["t", *(f"{joint}.{name}" for name in names for joint in commands.joints)]
    t = np.arange(len(commands)) / commands.rate
    table = np.column_stack([t, *(getattr(commands, name) for name in names)])
    return csv_text([head, *table.tolist()])
