"""Limits as shares of what is allowed: how much a motion uses, where, and how that changes.

A limit turns a motion into uses (N, m): 1 is the limit itself. The optimiser keeps smooth maxima of
them below one; the report takes the true maxima on a finer grid.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.models.coupling.derivatives import Slopes
from sysid_bench.models.robot import Joint
from sysid_bench.types import Array, Trajectory

Split = Literal["together", "by column", "by moment", "by joint"]


@dataclass(frozen=True, eq=False)
class Limit:
    """`use` (motion) gives uses (N, m), each of something called `names[m]`; `value` and `allowed`
    are the same in `units[m]`; `label` names what has no constant name. `slopes` (motion, G (N, m))
    are those of sum(G * use). In the search all uses are one constraint, or each column is; or each
    is and can be looked at in any samples, in any order; or each is and moves one joint alone. Only
    one sample of `every` is looked at there."""

    kind: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    use: Callable[[Trajectory], Array]
    value: Callable[[Trajectory], Array]
    allowed: Callable[[Array], Array]  # values (N, m) to the limit on their side (N, m)
    slopes: Callable[[Trajectory, Array], Slopes]
    split: Split = "together"
    every: int = 1
    label: Callable[[Trajectory, int, int], str] | None = None  # name at sample k, column j


@dataclass(frozen=True)
class LimitUse:
    """The worst moment of one kind of limit: `margin` = |limit - value|, negative beyond it."""

    kind: str
    name: str
    unit: str
    value: float
    limit: float
    margin: float
    use: float  # share; above 1 the limit is violated
    time: float  # s

    def to_json(self) -> dict[str, float | str]:
        """The fields that people and scripts read."""
        return {
            "at": self.name, "value": self.value, "limit": self.limit, "margin": self.margin,
            "unit": self.unit, "share": self.use, "time": self.time,
        }  # fmt: skip


def joint_limits(brief: DesignProblem, dofs: Array, share: float = 1.0) -> tuple[Limit, ...]:
    """Position, velocity and acceleration of the profiles `dofs`, and of the joints that follow
    where somebody states them; a motion may use a share."""
    v, a = brief.v[dofs], brief.a[dofs]
    bounds = np.array([brief.low[dofs], brief.high[dofs], v, a])
    limits = _bounded(brief, brief.dofs[dofs], bounds, share, "", "by joint")
    if brief.coupling is not None:
        after = brief.coupling
        limits += _bounded(brief, after.dependent, after.bounds, share, "follower ", "by moment")
    return tuple(limits)


def _bounded(
    brief: DesignProblem, dofs: Array, bounds: Array, share: float, whose: str, split: Split
) -> list[Limit]:
    """Limits of degrees of freedom of the tree; bounds (4, k): lowest, highest, v, a."""
    scalar = {j.vadr: j for j in brief.joints if j.kind in ("hinge", "slide")}
    joints = [scalar[int(dof)] for dof in dofs]
    low, high, v, a = bounds
    ranges = {"position": (low, high), "velocity": (-v, v), "acceleration": (-a, a)}
    limits = []
    for kind, (lowest, highest) in ranges.items():
        stated = np.flatnonzero(np.isfinite(highest - lowest))
        if len(stated):
            own = [joints[k] for k in stated]
            limit = _between(kind, own, lowest[stated], highest[stated], share)
            limits.append(replace(limit, kind=whose + kind, split=split))
    return limits


def _between(kind: str, joints: list[Joint], low: Array, high: Array, share: float) -> Limit:
    order = ("position", "velocity", "acceleration").index(kind)
    per = ("", "/s", "/s^2")[order]
    qadr, dofs = [joint.qadr for joint in joints], [joint.vadr for joint in joints]
    centre, reach = 0.5 * (high + low), 0.5 * (high - low)

    def take(motion: Trajectory) -> Array:
        return (motion.q[:, qadr], motion.v[:, dofs], motion.a[:, dofs])[order]

    def slopes(motion: Trajectory, G: Array) -> Slopes:
        out = [np.zeros_like(motion.v) for _ in range(3)]
        out[order][:, dofs] = G / (share * reach)
        return out[0], out[1], out[2]

    return Limit(
        kind,
        tuple(joint.name for joint in joints),
        tuple(("rad" if joint.kind == "hinge" else "m") + per for joint in joints),
        lambda motion: (take(motion) - centre) / (share * reach),
        take,
        lambda values: centre + np.where(values < centre, -reach, reach),
        slopes,
    )


def torque_limits(brief: DesignProblem, share: float = 1.0) -> tuple[Limit, ...]:
    """Torques of every joint that moves and has a limit; none where nothing is known of them."""
    limited = np.flatnonzero(np.isfinite(brief.tau))
    torque = brief.torque
    if torque is None or len(limited) == 0:
        return ()
    reach = brief.tau[limited]
    rows = [row for joint in brief.joints for row in joint.dofs]
    slides = {joint.vadr for joint in brief.joints if joint.kind == "slide"}
    moving = brief.dofs[limited]

    def slopes(motion: Trajectory, G: Array) -> Slopes:
        U = np.zeros((len(motion), brief.nv))
        U[:, limited] = G / (share * reach)
        return torque.gradient(motion, U)

    return (
        Limit(
            "torque",
            tuple(rows[dof] for dof in moving),
            tuple("N" if dof in slides else "N m" for dof in moving),
            lambda motion: torque.of(motion)[:, limited] / (share * reach),
            lambda motion: torque.of(motion)[:, limited],
            lambda values: np.where(values < 0, -reach, reach),
            slopes,
            split="by moment",
        ),
    )


def smooth_max(use: Array, sharpness: float) -> tuple[Array, Array]:
    """An upper bound (m,) of the largest |use| of each column (N, m), and its slope (N, m).

    Kreisselmeier & Steinhauser (1979); it lies above by log(2 N) / sharpness at most.
    """
    top = np.abs(use).max(axis=0)
    up, down = np.exp(sharpness * (use - top)), np.exp(sharpness * (-use - top))
    total = (up + down).sum(axis=0)
    return top + np.log(total) / sharpness, (up - down) / total


def largest_use(limit: Limit, motion: Trajectory) -> LimitUse:
    """The moment of a motion that uses most of a limit."""
    use = np.abs(limit.use(motion))
    k, j = np.unravel_index(int(np.argmax(use)), use.shape)
    values = limit.value(motion)
    value, allowed = float(values[k, j]), float(limit.allowed(values)[k, j])
    share = float(use[k, j])
    name = limit.names[j] if limit.label is None else limit.label(motion, int(k), int(j))
    return LimitUse(
        limit.kind, name, limit.units[j], value, allowed,
        float(np.copysign(abs(allowed - value), 1.0 - share)), share, float(motion.t[k]),
    )  # fmt: skip
