"""Joint terms that look at a whole motion of one joint: hysteresis, smooth friction, cable torque.

A feature has `suffixes`, the names of its columns after the joint's, and `values(q, v, reach)`,
its columns (N, k) along positions and rates (N,) of the joint; `reach` (low, high) is where the
joint went in training, so that a column means the same on every other motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sysid_bench.types import Array, Trajectory


class Feature(Protocol):
    """Columns of one joint along a whole motion."""

    @property
    def suffixes(self) -> tuple[str, ...]: ...

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array: ...


@dataclass(frozen=True)
class Play:
    """Friction that does not jump where the joint turns round but builds up along a way of twice
    `width` times the joint's reach: the play operator, (q - p) / r with p dragged along by q at a
    distance of r at most. Rate-independent hysteresis, as of cables and belts (Brokate and Sprekels
    1996)."""

    width: float = 0.01

    @property
    def suffixes(self) -> tuple[str, ...]:
        """play10 for a width of 1 %."""
        return (f"play{1000 * self.width:g}",)

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """(N, 1) between -1 and 1."""
        r = max(self.width * (reach[1] - reach[0]), 1e-12)
        dragged, p = np.empty_like(q), float(q[0] - r * np.sign(v[0]))
        for k, here in enumerate(q.tolist()):
            p = min(max(p, here - r), here + r)
            dragged[k] = p
        return ((q - dragged) / r)[:, None]


@dataclass(frozen=True)
class PositionPlay:
    """Hysteresis that is not everywhere the same, as where a cable bends more: play times the
    position and its square, -1 to 1 over the joint's reach."""

    width: float = 0.01

    @property
    def suffixes(self) -> tuple[str, ...]:
        """play10q1 and play10q2 for a width of 1 %."""
        (own,) = Play(self.width).suffixes
        return (f"{own}q1", f"{own}q2")

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """(N, 2)."""
        return Play(self.width).values(q, v, reach) * Polynomial(2).values(q, v, reach)


@dataclass(frozen=True)
class SmoothCoulomb:
    """tanh(v / scale): Coulomb friction without a jump; scale in rad/s or m/s."""

    scale: float = 0.02

    @property
    def suffixes(self) -> tuple[str, ...]:
        """tanh20 for 0.02 rad/s."""
        return (f"tanh{1000 * self.scale:g}",)

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """(N, 1)."""
        return np.tanh(v / self.scale)[:, None]


@dataclass(frozen=True)
class Polynomial:
    """Torque that depends on where the joint is, as of cables that bend: powers up to `degree` of
    its position, -1 to 1 over its reach."""

    degree: int = 3

    @property
    def suffixes(self) -> tuple[str, ...]:
        """q1, q2, ..."""
        return tuple(f"q{power}" for power in range(1, self.degree + 1))

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """(N, degree); beyond the reach the position is held, since powers run away there."""
        middle, half = 0.5 * (reach[0] + reach[1]), 0.5 * (reach[1] - reach[0]) or 1.0
        x = np.clip((q - middle) / half, -1.0, 1.0)
        return np.stack([x**power for power in range(1, self.degree + 1)], axis=1)


@dataclass(frozen=True, eq=False)
class JointFeatures:
    """Chosen columns of features, by name "<joint>.<suffix>", each on its own joint's row. `reach`
    is that of each joint in training."""

    features: tuple[Feature, ...]
    places: dict[str, tuple[int, int]]  # joint -> (place in q, place in v)
    reach: dict[str, tuple[float, float]]

    @property
    def columns(self) -> tuple[str, ...]:
        """All names, joint after joint."""
        return tuple(
            f"{joint}.{suffix}"
            for joint in self.places
            for feature in self.features
            for suffix in feature.suffixes
        )

    def of_joint(self, joint: str, motion: Trajectory, chosen: Sequence[str]) -> Array:
        """The chosen columns (N, k) of one joint, in the order of `chosen`."""
        at, dof = self.places[joint]
        found: dict[str, Array] = {}
        for feature in self.features:
            names = [f"{joint}.{suffix}" for suffix in feature.suffixes]
            if not set(names).isdisjoint(chosen):
                values = feature.values(motion.q[:, at], motion.v[:, dof], self.reach[joint])
                found |= dict(zip(names, values.T, strict=True))
        own = [found[name] for name in chosen if name in found]
        return np.stack(own, axis=1) if own else np.zeros((len(motion), 0))


def features_of(
    features: Sequence[Feature],
    joints: Sequence[str],
    places: Sequence[tuple[int, int]],
    motions: Sequence[Trajectory],
) -> JointFeatures:
    """Features of some joints, with their reach over all training motions."""
    reach = {}
    for joint, (at, _) in zip(joints, places, strict=True):
        q = np.concatenate([motion.q[:, at] for motion in motions])
        reach[joint] = (float(q.min()), float(q.max()))
    return JointFeatures(tuple(features), dict(zip(joints, places, strict=True)), reach)
