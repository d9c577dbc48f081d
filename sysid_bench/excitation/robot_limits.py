"""Limits of a robot's joints: position, velocity, acceleration and torque."""

from dataclasses import replace

import numpy as np

from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.excitation.limit_use import Limit, Split
from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.models.robot import Joint
from sysid_bench.types import Array, Trajectory


def joint_limits(brief: DesignProblem, dofs: Array, share: float = 1.0) -> tuple[Limit, ...]:
    """Return limits of position, velocity and acceleration of the profiles `dofs` (k,).

    Dependent joints of closed chains are included where their limits are stated. A motion may use
    `share` of each limit.
    """
    v, a = brief.v[dofs], brief.a[dofs]
    bounds = np.array([brief.low[dofs], brief.high[dofs], v, a])
    limits = _stated_limits(brief, brief.dofs[dofs], bounds, share)
    found = [replace(limit, split="by joint") for limit in limits]
    if brief.coupling is not None:
        closure = brief.coupling
        limits = _stated_limits(brief, closure.dependent, closure.bounds, share)
        split: Split = "by moment"  # a dependent joint moves with several independent ones
        found += [replace(one, kind=f"follower {one.kind}", split=split) for one in limits]
    return tuple(found)


def _stated_limits(brief: DesignProblem, dofs: Array, bounds: Array, share: float) -> list[Limit]:
    """Return limits of degrees of freedom of the tree; bounds (4, k): low, high, v, a; rad, m, s.

    Infinite bounds are left out.
    """
    low, high, v, a = bounds
    ranges = {"position": (low, high), "velocity": (-v, v), "acceleration": (-a, a)}
    limits = []
    for kind, (lowest, highest) in ranges.items():
        stated = np.flatnonzero(np.isfinite(highest - lowest))
        if len(stated):
            bounded = _scalar_joints(brief, dofs[stated])
            limits.append(_range_limit(kind, bounded, lowest[stated], highest[stated], share))
    return limits


def _scalar_joints(brief: DesignProblem, dofs: Array) -> list[Joint]:
    """Return the hinge or slide of each degree of freedom."""
    scalar = {joint.vadr: joint for joint in brief.joints if joint.kind in ("hinge", "slide")}
    return [scalar[int(dof)] for dof in dofs]


def _range_limit(kind: str, joints: list[Joint], low: Array, high: Array, share: float) -> Limit:
    """Return the limit low <= x <= high (k,) of q, v or a: use (x - centre) / (share reach)."""
    order = ("position", "velocity", "acceleration").index(kind)
    unit = ("", "/s", "/s^2")[order]
    qadr, dofs = [joint.qadr for joint in joints], [joint.vadr for joint in joints]
    centre, reach = 0.5 * (high + low), 0.5 * (high - low)

    def value(motion: Trajectory) -> Array:
        return (motion.q[:, qadr], motion.v[:, dofs], motion.a[:, dofs])[order]

    def slopes(motion: Trajectory, G: Array) -> Slopes:
        # use = (x - centre) / (share reach) is linear in one of q, v, a alone.
        by_qva = [np.zeros_like(motion.v) for _ in range(3)]
        by_qva[order][:, dofs] = G / (share * reach)
        return by_qva[0], by_qva[1], by_qva[2]

    return Limit(
        kind=kind,
        names=tuple(joint.name for joint in joints),
        units=tuple(("rad" if joint.kind == "hinge" else "m") + unit for joint in joints),
        use=lambda motion: (value(motion) - centre) / (share * reach),
        value=value,
        allowed=lambda values: centre + np.where(values < centre, -reach, reach),
        slopes=slopes,
    )


def torque_limits(brief: DesignProblem, share: float = 1.0) -> tuple[Limit, ...]:
    """Return limits of the torques (N m, N) of independent joints; none without a torque model."""
    limited = np.flatnonzero(np.isfinite(brief.tau))
    torque = brief.torque
    if torque is None or len(limited) == 0:
        return ()
    reach = brief.tau[limited]
    rows = [row for joint in brief.joints for row in joint.dofs]
    moving = brief.dofs[limited]

    def slopes(motion: Trajectory, G: Array) -> Slopes:
        # The weights of limited torques, zero for the others: the adjoint of tau(q, v, a).
        U = np.zeros((len(motion), brief.nv))
        U[:, limited] = G / (share * reach)
        return torque.gradient(motion, U)

    return (
        Limit(
            kind="torque",
            names=tuple(rows[dof] for dof in moving),
            units=_torque_units(brief, moving),
            use=lambda motion: torque.of(motion)[:, limited] / (share * reach),
            value=lambda motion: torque.of(motion)[:, limited],
            allowed=lambda values: np.where(values < 0, -reach, reach),
            slopes=slopes,
            split="by moment",
        ),
    )


def _torque_units(brief: DesignProblem, dofs: Array) -> tuple[str, ...]:
    slides = {joint.vadr for joint in brief.joints if joint.kind == "slide"}
    return tuple("N" if dof in slides else "N m" for dof in dofs)
