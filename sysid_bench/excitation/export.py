"""Commands along a motion, and their export: CSV, ROS 2 messages, CAN frames of Damiao motors.

Damiao motors in MIT mode: *scaling* (PMAX, VMAX, TMAX: registers of the drive) maps numbers to
bits; a wrong value commands a wrong motion. *Physical limits* are those of the motor; commands are
clamped to a share of them. Where the manufacturer has published none, the user gives them, or
nothing is exported.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, Final

import numpy as np

from sysid_bench.csv_text import csv_text
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands of k joints over time: t (N,), q, v, a, tau (N, k), SI."""

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array
    a: Array
    tau: Array

    def __len__(self) -> int:
        return len(self.t)

    @property
    def is_at_standstill(self) -> bool:
        """True if the motion starts and ends below 0.001 rad/s (m/s)."""
        return bool(np.abs(self.v[[0, -1]]).max() < 1e-3)


def commands_csv(commands: Commands) -> str:
    """Return CSV text `t, <joint>.q ..., <joint>.v ..., <joint>.a ..., <joint>.tau ...`, a line per
    sample, whose numbers read back exactly."""
    parts = {"q": commands.q, "v": commands.v, "a": commands.a, "tau": commands.tau}
    head = ["t", *(f"{joint}.{key}" for key in parts for joint in commands.joints)]
    table = np.column_stack([commands.t, *parts.values()])
    return csv_text([head, *table.tolist()])


def _message(commands: Commands) -> dict[str, Any]:
    """Return the message as nested values; `effort` is the feed-forward torque (N m, N)."""
    points = []
    for k, t in enumerate(commands.t):
        sec, nanosec = divmod(round(float(t) * 1e9), 10**9)
        points.append(
            {
                "positions": commands.q[k].tolist(),
                "velocities": commands.v[k].tolist(),
                "accelerations": commands.a[k].tolist(),
                "effort": commands.tau[k].tolist(),
                "time_from_start": {"sec": sec, "nanosec": nanosec},
            }
        )
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "joint_names": list(commands.joints), "points": points}


def json_text(commands: Commands) -> str:
    """Return the message as JSON."""
    return json.dumps(_message(commands)) + "\n"


def ros2_text(commands: Commands) -> str:
    """Return the message as YAML, one line per point in the JSON subset of YAML."""
    whole = _message(commands)
    points = whole.pop("points")
    lines = [f"{key}: {json.dumps(value)}" for key, value in whole.items()]
    lines += ["points:", *(f"- {json.dumps(point)}" for point in points)]
    return "\n".join(lines) + "\n"


_SHARE: Final = 0.9
"""Share of the physical limits that commands may use."""

_GAINS: Final = (500.0, 5.0)
"""Largest kp (N m / rad) and kd (N m s / rad) of a MIT frame."""


@dataclass(frozen=True)
class MotorScale:
    """Ranges that the bits of a frame span: positions +-p (rad), velocities +-v (rad/s), torques
    +-tau (N m)."""

    p: float
    v: float
    tau: float


@dataclass(frozen=True)
class Motor:
    """Motor type: factory scaling, and published physical limits: no-load speed (rad/s), peak and
    rated torque (N m)."""

    scaling: MotorScale
    speed: float | None = None
    torque: float | None = None
    rated: float | None = None


def _motor(
    p: float, v: float, tau: float, rpm: float = 0.0, peak: float = 0.0, rated: float = 0.0
) -> Motor:
    """Return a motor of scaling p, v, tau; without `rpm` nothing else is published."""
    if not rpm:
        return Motor(MotorScale(p, v, tau))
    return Motor(MotorScale(p, v, tau), rpm * 2 * np.pi / 60, peak, rated)


MOTORS: Final[Mapping[str, Motor]] = {
    # PMAX, VMAX, TMAX of the tool of seed 000; no-load rpm, peak and rated torque (N m) of the
    # manufacturer.
    "DM3507": _motor(12.566, 50, 5, 460, 3, 0.8),
    "DM4310": _motor(12.5, 30, 10, 200, 7, 3),
    "DM4310_48V": _motor(12.5, 50, 10, 400, 7, 3),
    "DM4340": _motor(12.5, 10, 28, 52.5, 27, 9),
    "DM4340_48V": _motor(12.5, 20, 28, 100, 27, 9),
    "DM6006": _motor(12.5, 45, 12, 226, 11, 4),
    "DM6248": _motor(12.566, 20, 120),
    "DM8006": _motor(12.5, 45, 20, 194, 20, 8),
    "DM8009": _motor(12.5, 45, 54, 168, 40, 20),
    "DM10010L": _motor(12.5, 25, 200, 100, 120, 40),
    "DM10010": _motor(12.5, 20, 200, 75, 150, 40),
    "DMH3510": _motor(12.5, 280, 1),
    "DMH6215": _motor(12.5, 45, 10),
    "DMS3519": _motor(12.5, 2000, 2),
    "DMG6220": _motor(12.5, 45, 10),
}


@dataclass(frozen=True)
class DamiaoDrive:
    """Motor of one joint: CAN id, gains, scaling, and limits that commands are clamped to: position
    (low, high) in rad, speed in rad/s, torque in N m."""

    joint: str
    motor: str
    id: int
    kp: float
    kd: float
    scaling: MotorScale
    position: tuple[float, float]
    speed: float
    torque: float
    rated: float | None = None  # N m

    def to_json(self) -> dict[str, Any]:
        """Return the settings that an exported file states."""
        return {
            "joint": self.joint, "motor": self.motor, "id": self.id, "kp": self.kp, "kd": self.kd,
            "scaling": {"p": self.scaling.p, "v": self.scaling.v, "tau": self.scaling.tau},
            "limits": {"q": list(self.position), "v": self.speed, "tau": self.torque},
        }  # fmt: skip


_KEYS: Final = ("motor", "id", "kp", "kd", "pmax", "vmax", "tmax", "q", "v", "tau", "share")


def _drive(joint: str, number: int, settings: Mapping[str, Any]) -> DamiaoDrive:
    """Return the drive of a joint from the user's table.

    Keys: `motor` (a type), `id` (default: the joint's number), gains `kp`, `kd`, scaling `pmax`,
    `vmax`, `tmax`, physical limits `q` (two numbers), `v`, `tau`, and the `share` of them that
    commands may use. Raises UsageError with what is missing or out of range.
    """
    for key in settings:
        if key not in _KEYS:
            raise unknown_name(f"key of the motor of {joint!r}", key, _KEYS)
    name = str(settings.get("motor", ""))
    if name not in MOTORS:
        raise unknown_name("Damiao motor", name, MOTORS)
    motor = MOTORS[name]
    known = _known_limits(joint, name, settings)
    p, v, tau = (float(known[key]) for key in ("pmax", "vmax", "tmax"))
    kp, kd = (float(settings.get(key, default)) for key, default in (("kp", 20.0), ("kd", 1.0)))
    _check_address(joint, kp, kd, settings.get("id", number))
    low, high = (float(edge) for edge in settings.get("q", (-p, p)))
    return DamiaoDrive(
        joint=joint,
        motor=name,
        id=settings.get("id", number),
        kp=kp,
        kd=kd,
        scaling=MotorScale(p, v, tau),
        position=(max(low, -p), min(high, p)),
        speed=min(known["share"] * float(known["v"]), v),
        torque=min(known["share"] * float(known["tau"]), tau),
        rated=motor.rated,
    )


def _known_limits(joint: str, name: str, settings: Mapping[str, Any]) -> dict[str, float]:
    """Return limits, their share and scaling of a motor as given by the user, else as published."""
    motor = MOTORS[name]
    usual = {"v": motor.speed, "tau": motor.torque, "share": _SHARE}
    usual |= {"pmax": motor.scaling.p, "vmax": motor.scaling.v, "tmax": motor.scaling.tau}
    known = {key: settings.get(key, value) for key, value in usual.items()}
    if known["v"] is None or known["tau"] is None:
        raise UsageError(
            f"The manufacturer publishes no physical limits of {name} (joint {joint!r}); give "
            "them: v = rad/s and tau = N m. The scaling of its frames is not a limit."
        )
    for key, value in known.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise UsageError(f"{joint!r}: {key} must be a positive number; got {value!r}.")
    return known


def _check_address(joint: str, kp: float, kd: float, identifier: Any) -> None:
    """Raise UsageError for gains and a CAN id that a frame cannot hold, and for gains that make a
    motor oscillate."""
    if not (0 <= kp <= _GAINS[0] and 0 <= kd <= _GAINS[1]):
        raise UsageError(f"{joint!r}: kp lies between 0 and 500, kd between 0 and 5.")
    if kp > 0 and kd == 0:
        raise UsageError(f"{joint!r}: kp > 0 with kd = 0 makes a motor oscillate; give kd.")
    whole = isinstance(identifier, int) and not isinstance(identifier, bool)
    if not (whole and 0 < identifier < 2048):
        raise UsageError(f"{joint!r}: a CAN id lies between 1 and 2047; got {identifier!r}.")


def damiao_motors(
    joints: tuple[str, ...], settings: Mapping[str, Mapping[str, Any]]
) -> tuple[DamiaoDrive, ...]:
    """Return the drives of all joints from tables by joint name; "all" applies to each joint.

    Raises UsageError for unknown joints, and for two motors of one id.
    """
    for name in settings:
        if name not in (*joints, "all"):
            raise unknown_name("joint of this motion", name, (*joints, "all"))
    common = settings.get("all", {})
    drives = tuple(
        _drive(joint, number, {**common, **settings.get(joint, {})})
        for number, joint in enumerate(joints, 1)
    )
    ids = [drive.id for drive in drives]
    if len(set(ids)) < len(ids):
        raise UsageError(f"Two motors have the same CAN id: {ids}; give each its own.")
    return drives


def limit_commands(
    commands: Commands, drives: tuple[DamiaoDrive, ...], most: float
) -> tuple[Commands, list[dict[str, Any]]]:
    """Return the commands clamped to the limits of their motors, and a report per joint.

    The report has the shares of samples at which position, velocity and torque were clamped, and
    the rms torque (N m); `hot`: it exceeds the rated one. Raises UsageError where a share is above
    `most`.
    """
    low, high = np.array([drive.position for drive in drives]).T
    speed, torque = (np.array([getattr(d, key) for d in drives]) for key in ("speed", "torque"))
    inside = replace(
        commands,
        q=np.clip(commands.q, low, high),
        v=np.clip(commands.v, -speed, speed),
        tau=np.clip(commands.tau, -torque, torque),
    )
    report: list[dict[str, Any]] = []
    for j, drive in enumerate(drives):
        shares = {
            key: float(np.mean(getattr(inside, key)[:, j] != getattr(commands, key)[:, j]))
            for key in ("q", "v", "tau")
        }
        # Windings heat with the square of the current, so the rms over the motion is what counts.
        rms = float(np.sqrt(np.mean(commands.tau[:, j] ** 2)))
        report.append(
            {
                "joint": drive.joint,
                "clamped": shares,
                "rms_torque": rms,
                "rated_torque": drive.rated,
                "hot": drive.rated is not None and rms > drive.rated,
            }
        )
    # Refuse commands of which a joint has a larger share clamped than `most`
    worst = max(report, key=lambda entry: max(entry["clamped"].values()))
    signal, share = max(worst["clamped"].items(), key=itemgetter(1))
    if share > most:
        word = {"q": "position", "v": "velocity", "tau": "torque"}[signal]
        raise UsageError(
            f"{share:.1%} of the samples of {worst['joint']!r} break the {word} limit of "
            f"its motor, more than {most:.1%}. Clamping changes the motion: design it within these "
            "limits (--limit), or allow a larger share (--clamp)."
        )
    return inside, report


def _frames(drive: DamiaoDrive, q: Array, v: Array, tau: Array) -> Array:
    """Return MIT frames (N, 8), bytes, of commands (N,) within the scaling.

    Position has 16 bits, velocity, kp, kd and torque 12 bits each, the most significant first.
    """
    s = drive.scaling
    p_code = _code(q, -s.p, s.p, 16)
    v_code, tau_code = _code(v, -s.v, s.v, 12), _code(tau, -s.tau, s.tau, 12)
    kp_code = _code(np.full(len(q), drive.kp), 0.0, _GAINS[0], 12)
    kd_code = _code(np.full(len(q), drive.kd), 0.0, _GAINS[1], 12)
    return np.stack(
        [
            p_code >> 8, p_code & 0xFF, v_code >> 4, (v_code & 0xF) << 4 | kp_code >> 8,
            kp_code & 0xFF, kd_code >> 4, (kd_code & 0xF) << 4 | tau_code >> 8, tau_code & 0xFF,
        ],
        axis=1,
    ).astype(np.uint8)  # fmt: skip


def log_text(commands: Commands, drives: tuple[DamiaoDrive, ...], channel: str = "can0") -> str:
    """Return a log in the format of `candump -l` for `canplayer`: one frame per motor and sample,
    in the order of the drives."""
    frames = np.stack(
        [
            _frames(d, commands.q[:, j], commands.v[:, j], commands.tau[:, j])
            for j, d in enumerate(drives)
        ],
        axis=1,
    )
    return "".join(
        f"({t:.6f}) {channel} {drive.id:03X}#{frames[k, j].tobytes().hex().upper()}\n"
        for k, t in enumerate(commands.t)
        for j, drive in enumerate(drives)
    )


def table_text(
    commands: Commands, drives: tuple[DamiaoDrive, ...], report: list[dict[str, Any]]
) -> str:
    """Return a text table for a motor controller: scaling and limits in comments, then time and
    position, velocity and torque of each motor."""
    lines = ["# Damiao MIT mode; t in s, then for each motor q (rad), v (rad/s), tau (N m)"]
    for drive, entry in zip(drives, report, strict=True):
        s, (low, high) = drive.scaling, drive.position
        shares = ", ".join(f"{signal} {share:.2%}" for signal, share in entry["clamped"].items())
        lines += [
            f"# {drive.joint}: {drive.motor}, id {drive.id}, kp {drive.kp:g}, kd {drive.kd:g}",
            f"#   scaling (registers of the drive): PMAX {s.p:g} VMAX {s.v:g} TMAX {s.tau:g}",
            f"#   limits: q {low:g} to {high:g}, v {drive.speed:.4g}, tau {drive.torque:.4g}; "
            f"clamped: {shares}",
        ]
    keys = ("q", "v", "tau")
    lines.append(",".join(["t", *(f"{d.joint}.{key}" for d in drives for key in keys)]))
    # (N, joint, signal): the numbers of one motor stand side by side.
    values = np.stack([commands.q, commands.v, commands.tau], axis=2).reshape(len(commands), -1)
    for t, row in zip(commands.t, values, strict=True):
        lines.append(",".join([f"{t:.6f}", *(f"{float(x):.9g}" for x in row)]))
    return "\n".join(lines) + "\n"


def _code(x: Array, low: float, high: float, bits: int) -> Array:
    if not ((x >= low - 1e-12) & (x <= high + 1e-12)).all():
        raise ValueError(f"A command leaves the scaling {low:g} to {high:g}: clamp it first.")
    # Nearest code, as half a quantum is the least error; the drive decodes code / (2^bits - 1).
    return np.asarray(np.round((x - low) * (2**bits - 1) / (high - low)).astype(int))
