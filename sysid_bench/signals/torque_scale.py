"""Scale of a signal that follows the torque of the model along a motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_checks import check_finite
from sysid_bench.types import Array

_ROWS: Final = 20_000
_EVALUATED: Final = 400
"""Rows that are compared, and rows at which the model is evaluated."""

FOLLOWS: Final = 0.5
"""Share of a torque that is explained by the model's beyond friction; temperatures, counters and
the rates themselves have less than a tenth."""

_SLOPES: Final = (1 / 3, 3.0)
"""Torque over that of the model: beyond it a current, or the torque of a motor before its gear."""

_TINY: Final = 20.0
"""Gravity over what is recorded, beyond which no motion makes up for it: a free fall would."""

_SLIDES: Final = 0.02
"""rad/s, m/s at which friction reaches its size in what controllers compute of it."""

_ONE_RELATION, _PARTS, _KNOWN_GAIN = 0.98, 8, 0.05
"""Least share of a current that torque and friction explain where the controller computes one from
the other; parts of a jackknife; largest deviation of a gain that is taken from them."""

_ALIKE: Final = 0.3
"""Difference of the scales of gravity and inertia up to which both are that of the torque."""


def scale_contradiction(
    q: Array, tau: Array, t: Array, robot: RobotModel, joints: Sequence[str], sure: bool = False
) -> str:
    """Return the reason for which tau (N, k) is not a torque of the joints in N m, "" where it may
    be one: it has no sign, or follows the model's torque along q (N, k) at another scale; `sure`: a
    positive one below that of torques in all joints, since other ones are of other mistakes."""
    rows = ~check_finite(q, tau, t[:, None])
    q, tau, t = q[rows][:_ROWS], tau[rows][:_ROWS], t[rows][:_ROWS]
    if len(tau) and tau.min() >= 0 and (np.ptp(tau, axis=0) > 0).all():
        return f"it is never negative in any of {tau.shape[1]} joints: a size without its sign"
    fit = TorqueFit.of(q, t, robot, joints)
    if fit is None or q.shape != tau.shape:
        return ""
    score, slopes, _ = fit.follows(tau)
    is_below = bool(len(slopes)) and slopes.min() > 0 and slopes.max() < _SLOPES[0]
    if score < FOLLOWS or is_torque_scale(slopes) or (sure and not is_below):
        return ""
    by_model = ""
    if slopes.min() > 0:
        by_model = f" (by the model's masses its gain is {range_of(1 / slopes, '')})"
    return (
        f"it follows the model's torque ({score:.0%} beyond friction) at {range_of(slopes)}: a "
        f"current, or the torque of a motor before its gear{by_model}"
    )


def drive_gains(current: Array, torque: Array, v: Array) -> tuple[list[float], str] | None:
    """Return N m per A in each joint, and how that is known, from the currents (N, k) that a
    controller asks for and the torques (N, k) that it computes, at rates v (N, k); None where they
    are not one relation in every joint, friction apart: measured currents carry loads that no model
    has."""
    rows = ~check_finite(current, torque, v)
    gains, deviations = [], []
    for i, tau, rate in zip(current[rows].T, torque[rows].T, v[rows].T, strict=True):
        A = np.column_stack([tau, np.tanh(rate / _SLIDES), rate, np.ones_like(rate)])
        x = np.linalg.lstsq(A, i, rcond=None)[0]
        if not len(i) or x[0] == 0 or np.var(i - A @ x) > (1 - _ONE_RELATION) * np.var(i):
            return None
        parts = np.array_split(np.arange(len(i)), _PARTS)
        rest = [np.delete(np.arange(len(i)), part) for part in parts]
        slopes = [np.linalg.lstsq(A[kept], i[kept], rcond=None)[0][0] for kept in rest]
        gains.append(float(f"{1.0 / x[0]:.4g}"))
        deviations.append(np.sqrt(_PARTS - 1) * np.std(slopes) / abs(x[0]))  # jackknife
    worst = max(deviations, default=np.inf)
    reason = f"gain: the controller's own torques over its currents, within {100 * worst:.1g} %"
    return (gains, reason) if worst < _KNOWN_GAIN else None


def is_torque_scale(slopes: Array) -> bool:
    """Test whether y per N m of the model may be 1 in any joint: single ones have balances."""
    sizes = np.abs(slopes)
    return not len(sizes) or bool(((sizes > _SLOPES[0]) & (sizes < _SLOPES[1])).any())


def range_of(slopes: Array, unit: str = " per N m") -> str:
    return f"{slopes.min():.3g} to {slopes.max():.3g}{unit}" if len(slopes) else "no known scale"


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Torque of the model's gravity and of its inertia (M, k) at `rows`, and the rates v (M, k)."""

    rows: Array
    gravity: Array
    inertial: Array
    v: Array
    slides: Array

    @classmethod
    def of(cls, q: Array, t: Array, robot: RobotModel, joints: Sequence[str]) -> "TorqueFit | None":
        """Evaluate the model along positions q (N, k) at t (N,), without forces of loops, with the
        base at rest; None for short recordings, and for times that do not rise."""
        joint_of = {
            joint.dofs[0]: joint for joint in robot.joints if joint.kind in ("hinge", "slide")
        }
        at = [joint_of[name] for name in joints[: q.shape[1]] if name in joint_of]
        if len(q) < 50 or not at:
            return None
        q = q[:, : len(at)]
        low, high = (getattr(robot.limits, end) for end in ("q_low", "q_high"))
        reach = np.maximum(np.abs(low), np.abs(high))
        # Degrees, where radians would be turns beyond every limit.
        if np.abs(q).max() > 2 * np.max(reach[np.isfinite(reach)], initial=2 * np.pi):
            q = np.deg2rad(q)
        skip = max(1, len(q) // 4000)
        q, t = _smoothed(q[::skip]), t[::skip]
        step = float(np.median(np.diff(t)))
        if not step > 0.0:
            return None
        step = next((step * unit for unit in (1.0, 1e-3, 1e-6) if step * unit < 0.5), step * 1e-9)
        v = np.gradient(q, step, axis=0)
        a = np.gradient(_smoothed(v), step, axis=0)
        rows = np.unique(np.linspace(8, len(q) - 9, _EVALUATED).astype(int))
        torques, data = np.zeros((2, len(rows), robot.nv)), mujoco.MjData(robot.mj)
        data.qpos[:] = robot.mj.qpos0
        for n, i in enumerate(rows):
            for part, moves in enumerate((0.0, 1.0)):
                for j, joint in enumerate(at):
                    data.qpos[joint.qadr] = q[i, j]
                    data.qvel[joint.vadr], data.qacc[joint.vadr] = moves * v[i, j], moves * a[i, j]
                mujoco.mj_kinematics(robot.mj, data)
                mujoco.mj_comPos(robot.mj, data)
                mujoco.mj_comVel(robot.mj, data)
                mujoco.mj_rne(robot.mj, data, 1, torques[part, n])
        gravity, whole = (part[:, [int(np.ravel(j.vadr)[0]) for j in at]] for part in torques)
        slides = np.array([joint.kind == "slide" for joint in at])
        return cls(rows * skip, gravity, whole - gravity, v[rows], slides)

    def follows(self, y: Array) -> tuple[float, Array, float]:
        """Share of y (N, k) that the model explains beyond friction, over the joints that it loads
        most; y per N m where gravity does; and the share of friction."""
        y = y[self.rows, : self.v.shape[1]]
        load = (self.gravity + self.inertial).std(axis=0)
        # Newtons of slides are not compared with newton metres of hinges.
        most = np.array([load[self.slides == one].max(initial=0.0) for one in self.slides])
        shares, slopes, rubs = [], [], []
        for j in np.flatnonzero(load > 0.2 * most):
            v, g, i = self.v[:, j], self.gravity[:, j], self.inertial[:, j]
            friction = np.stack(
                [np.tanh(v / max(0.1 * v.std(), 1e-12)), v, np.ones_like(v)], axis=1
            )
            wide = np.column_stack([g, i, friction])
            scale = np.maximum(np.abs(wide).max(axis=0), 1e-300)
            x = np.linalg.lstsq(wide / scale, y[:, j], rcond=1e-9)[0] / scale
            plain = friction @ np.linalg.lstsq(friction, y[:, j], rcond=1e-9)[0]
            rest = np.array([np.sum((y[:, j] - fit) ** 2) for fit in (plain, wide @ x)])
            shares.append(1.0 - rest[1] / rest[0] if rest[0] > 0 else 0.0)
            # Differences of encoders exaggerate accelerations: gravity shows the scale, or both.
            far = y[:, j].std() * _TINY < g.std()
            alike = abs(x[0] - x[1]) < _ALIKE * np.abs(x[:2]).max()
            slopes += [x[0]] if g.std() > i.std() or far or alike else []
            rubs.append((friction[:, :2] @ x[2:4]).std() / max(y[:, j].std(), 1e-300))
        if not shares:
            return 0.0, np.zeros(0), 0.0
        return float(np.mean(shares)), np.array(slopes), float(np.median(rubs))


def _smoothed(x: Array) -> Array:
    """Mean of five neighbours (N, k): a derivative of raw encoders is mostly their steps."""
    padded = np.pad(x, ((2, 2), (0, 0)), mode="edge")
    return np.asarray(sum(padded[i : len(padded) - 4 + i] for i in range(5)) / 5)
