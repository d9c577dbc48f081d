"""Limits of a motion, as shares of the allowed value: joints, torques, clearance, workspace boxes.

A limit maps a motion to uses (N, m), 1 at the limit itself. The search keeps smooth maxima of them
below one; the report takes the true maxima on a finer grid.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.excitation.collision_model import REACH, WATCHED, CollisionModel
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.models.robot import Joint
from sysid_bench.types import Array, Trajectory

Split = Literal["together", "by column", "by moment", "by joint"]
"""Constraints of the search from uses (N, m): one for all; one per column; one per column, which
can be evaluated at any samples; one per column, which depends on one joint alone."""


@dataclass(frozen=True, eq=False)
class Limit:
    """Limit of one kind on m quantities `names` in `units`.

    `use` (motion): uses (N, m); `value` (motion): the same in units; `allowed` (values): the limit
    on their side (N, m). `slopes` (motion, G (N, m)): derivatives of sum(G * use) by q, v, a.
    `label` names quantities without a constant name. The search evaluates one sample of `every`.
    """

    kind: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    use: Callable[[Trajectory], Array]
    value: Callable[[Trajectory], Array]
    allowed: Callable[[Array], Array]
    slopes: Callable[[Trajectory, Array], Slopes]
    split: Split = "together"
    every: int = 1
    label: Callable[[Trajectory, int, int], str] | None = None  # name at sample k, column j


@dataclass(frozen=True)
class LimitUse:
    """Largest use of one kind of limit: `margin` = |limit - value|, negative beyond the limit."""

    kind: str
    name: str
    unit: str
    value: float
    limit: float
    margin: float
    use: float  # share; above 1 the limit is violated
    time: float  # s

    def to_json(self) -> dict[str, float | str]:
        """Return the fields as `excite --json` prints them."""
        return {
            "at": self.name,
            "value": self.value,
            "limit": self.limit,
            "margin": self.margin,
            "unit": self.unit,
            "share": self.use,
            "time": self.time,
        }


def smooth_bound(use: Array, sharpness: float) -> tuple[Array, Array]:
    """Return an upper bound (m,) of the largest |use| of each column (N, m), and its slope (N, m).

    log sum_k (exp(s u_k) + exp(-s u_k)) / s, at most log(2 N) / s too large (Kreisselmeier &
    Steinhauser 1979).
    """
    top = np.abs(use).max(axis=0)  # subtracted before exp, against overflow
    up, down = np.exp(sharpness * (use - top)), np.exp(sharpness * (-use - top))
    total = (up + down).sum(axis=0)
    return top + np.log(total) / sharpness, (up - down) / total


def largest_use(limit: Limit, motion: Trajectory) -> LimitUse:
    """Return the moment of a motion with the largest use of a limit."""
    use = np.abs(limit.use(motion))
    k, j = np.unravel_index(int(np.argmax(use)), use.shape)
    values = limit.value(motion)
    value, allowed = float(values[k, j]), float(limit.allowed(values)[k, j])
    share = float(use[k, j])
    return LimitUse(
        kind=limit.kind,
        name=limit.names[j] if limit.label is None else limit.label(motion, int(k), int(j)),
        unit=limit.units[j],
        value=value,
        limit=allowed,
        margin=float(np.copysign(abs(allowed - value), 1.0 - share)),
        use=share,
        time=float(motion.t[k]),
    )


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
    scalar = {joint.vadr: joint for joint in brief.joints if joint.kind in ("hinge", "slide")}
    ranges = {"position": (low, high), "velocity": (-v, v), "acceleration": (-a, a)}
    limits = []
    for kind, (lowest, highest) in ranges.items():
        stated = np.flatnonzero(np.isfinite(highest - lowest))
        if len(stated):
            bounded = [scalar[int(dof)] for dof in dofs[stated]]
            limits.append(_range_limit(kind, bounded, lowest[stated], highest[stated], share))
    return limits


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
    slides = {joint.vadr for joint in brief.joints if joint.kind == "slide"}

    def slopes(motion: Trajectory, G: Array) -> Slopes:
        # The weights of limited torques, zero for the others: the adjoint of tau(q, v, a).
        U = np.zeros((len(motion), brief.nv))
        U[:, limited] = G / (share * reach)
        return torque.gradient(motion, U)

    return (
        Limit(
            kind="torque",
            names=tuple(rows[dof] for dof in moving),
            units=tuple("N" if dof in slides else "N m" for dof in moving),
            use=lambda motion: torque.of(motion)[:, limited] / (share * reach),
            value=lambda motion: torque.of(motion)[:, limited],
            allowed=lambda values: np.where(values < 0, -reach, reach),
            slopes=slopes,
            split="by moment",
        ),
    )


_THINNED: Final = 4
"""Samples per collision query in the search, which leaves ten queries per fastest period."""

_FAR: Final = 100.0
"""m; stands for an open side of a box."""


def collision_limit(scene: CollisionModel, clearance: float) -> Limit:
    """Return the limit on distances: use (REACH - d) / (REACH - clearance), d in m.

    Raises UsageError for a clearance outside of [0, REACH).
    """
    if not 0.0 <= clearance < REACH:
        raise UsageError(f"A clearance lies between 0 and {REACH} m; got {clearance}.")
    contacts = _LastMotion(scene.contact_list)

    def distances(motion: Trajectory) -> Array:
        out = np.full((len(motion), WATCHED), REACH)
        for k, close in enumerate(contacts.along(motion)):
            out[k, : len(close)] = [distance for distance, _, _ in close]
        return out

    def slopes(motion: Trajectory, G: Array) -> Slopes:
        by_q = np.zeros_like(motion.v)
        for k, close in enumerate(contacts.along(motion)):
            for j, (_, _, slope) in enumerate(close):
                by_q[k] -= G[k, j] / (REACH - clearance) * slope
        return by_q, np.zeros_like(by_q), np.zeros_like(by_q)

    def pair(motion: Trajectory, k: int, j: int) -> str:
        close = contacts.along(motion)[k]
        return close[j][1] if j < len(close) else f"nothing nearer than {REACH} m"

    return Limit(
        kind="collision",
        names=("",) * WATCHED,
        units=("m",) * WATCHED,
        use=lambda motion: (REACH - distances(motion)) / (REACH - clearance),
        value=distances,
        allowed=lambda values: np.full_like(values, clearance),
        slopes=slopes,
        label=pair,
        every=_THINNED,
    )


def origin_limit(scene: CollisionModel, boxes: Mapping[str, Sequence[Sequence[float]]]) -> Limit:
    """Return the limit of body origins to boxes {body: [[x, x], [y, y], [z, z]]} (m, world frame).

    Raises UsageError for an unknown body or a wrong box.
    """
    names = [scene.mj.body(b).name for b in range(1, scene.mj.nbody)]
    bodies, edges = [], []
    for name, box in boxes.items():
        if name not in names:
            raise unknown_name("body", name, names)
        bodies.append(names.index(name) + 1)
        edges.append(_edges(name, box))
    low, high = np.concatenate(edges).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    labels = tuple(f"{name}.{axis}" for name in boxes for axis in "xyz")

    origins = _LastMotion(lambda q: scene.positions(q, bodies))

    def positions(motion: Trajectory) -> Array:
        return np.array([x.ravel() for x, _ in origins.along(motion)])

    def slopes(motion: Trajectory, G: Array) -> Slopes:
        J = np.array([J.reshape(len(half), -1) for _, J in origins.along(motion)])
        by_q = np.einsum("nc,ncj->nj", G / half, J)
        return by_q, np.zeros_like(by_q), np.zeros_like(by_q)

    return Limit(
        kind="box",
        names=labels,
        units=("m",) * len(labels),
        use=lambda motion: (positions(motion) - middle) / half,
        value=positions,
        allowed=lambda values: middle + np.where(values < middle, -half, half),
        slopes=slopes,
        split="by column",
    )


def _edges(name: str, box: Sequence[Sequence[float]]) -> Array:
    edges = np.array(box, dtype=float)
    if edges.shape != (3, 2) or not (edges[:, 0] < edges[:, 1]).all():
        raise UsageError(
            f"The box of {name!r} needs three ranges [[x, x], [y, y], [z, z]] in m, each from low "
            f"to high; got {box!r}."
        )
    return np.asarray(np.clip(edges, -_FAR, _FAR))


class _LastMotion:
    """Results of a query at each sample, kept for the last motion: use, value, label and slopes of
    a limit ask for the same ones, and MuJoCo's queries dominate the time of a search."""

    def __init__(self, query: Callable[[Array], Any]) -> None:
        self.query = query
        self.motion: Trajectory | None = None
        self.results: list[Any] = []

    def along(self, motion: Trajectory) -> list[Any]:
        if self.motion is not motion:
            self.results = [self.query(q) for q in motion.q]
            self.motion = motion
        return self.results
