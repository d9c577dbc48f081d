"""Limits of scenes."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.excitation.collision_model import REACH, WATCHED, CollisionModel
from sysid_bench.excitation.limit_use import Limit
from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.types import Array, Trajectory

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


