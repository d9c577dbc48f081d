"""Joint torque terms with memory or shape: hysteresis, smooth Coulomb friction, cable torque.

A term has `suffixes`, which name its columns "<joint>.<suffix>", and `values(q, v, reach)`, its
columns (N, k) along positions and rates (N,) of the joint. `reach` (low, high) is the range of the
joint in the training motions, so that a column has the same meaning on every motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sysid_bench.regressors.regression import TERM
from sysid_bench.types import Array, Trajectory
from sysid_bench.words import MOTOR


class Term(Protocol):
    """Regressor columns of one joint along a whole motion; see the module's docstring."""

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Names (k,) of the columns, after the joint's."""
        ...

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """Return the columns (N, k) at q and v (N,), rad or m and their rates."""
        ...


@dataclass(frozen=True)
class Play:
    """Rate-independent hysteresis of cables and belts: the play operator (Brokate and Sprekels
    1996).

    The column is (q - p) / r, with r = `width` times the joint's range. q drags p along at a
    distance of at most r, so that friction builds up over a travel of 2 r after a reversal instead
    of changing its sign at once.
    """

    width: float = 0.01

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Column name, e.g. play10 for a width of 1 %."""
        return (f"play{1000 * self.width:g}",)

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """Return the column (N, 1), between -1 and 1."""
        r = max(self.width * (reach[1] - reach[0]), 1e-12)
        # At the start p trails q by r, as if the joint had moved in its present direction for long.
        dragged, p = np.empty_like(q), float(q[0] - r * np.sign(v[0]))
        for k, position in enumerate(q.tolist()):
            p = min(max(p, position - r), position + r)
            dragged[k] = p
        return np.asarray((q - dragged) / r)[:, None]


@dataclass(frozen=True)
class PositionPlay:
    """Hysteresis that varies with position, as where a cable bends more.

    The columns are those of `Play` times the normalised position (-1 to 1 over the joint's range)
    and its square.
    """

    width: float = 0.01

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Column names, e.g. play10q1 and play10q2 for a width of 1 %."""
        (play,) = Play(self.width).suffixes
        return (f"{play}q1", f"{play}q2")

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """Return the columns (N, 2)."""
        return np.asarray(Play(self.width).values(q, v, reach) * Polynomial(2).values(q, v, reach))


@dataclass(frozen=True)
class SmoothFriction:
    """Coulomb friction without a discontinuity: tanh(v / scale), `scale` in rad/s or m/s."""

    scale: float = 0.02

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Column name, e.g. tanh20 for 0.02 rad/s."""
        return (f"tanh{1000 * self.scale:g}",)

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """Return the column (N, 1)."""
        return np.tanh(v / self.scale)[:, None]


@dataclass(frozen=True)
class Polynomial:
    """Position-dependent torque, e.g. of bending cables: powers 1 to `degree` of the normalised
    position, which is -1 to 1 over the joint's range."""

    degree: int = 3

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Column names q1, q2, ..."""
        return tuple(f"q{power}" for power in range(1, self.degree + 1))

    def values(self, q: Array, v: Array, reach: tuple[float, float]) -> Array:
        """Return the columns (N, degree).

        Outside of the range the position is clipped, since powers grow without bound there.
        """
        middle, half = 0.5 * (reach[0] + reach[1]), 0.5 * (reach[1] - reach[0]) or 1.0
        x = np.clip((q - middle) / half, -1.0, 1.0)
        return np.stack([x**power for power in range(1, self.degree + 1)], axis=1)


@dataclass(frozen=True, eq=False)
class JointFeatures:
    """Columns of features for several joints, named "<joint>.<suffix>", each on its joint's row.

    `indices` are those of each joint in q and v, `ranges` (low, high) its range in training.
    """

    features: tuple[Term, ...]
    indices: dict[str, tuple[int, int]]
    ranges: dict[str, tuple[float, float]]

    @property
    def columns(self) -> tuple[str, ...]:
        """All column names, joint by joint."""
        return tuple(
            f"{joint}.{suffix}"
            for joint in self.indices
            for feature in self.features
            for suffix in feature.suffixes
        )

    def of_joint(self, joint: str, motion: Trajectory, chosen: Sequence[str]) -> Array:
        """Return the columns (N, k) of one joint that `chosen` names, in that order."""
        qadr, dof = self.indices[joint]
        found: dict[str, Array] = {}
        for feature in self.features:
            names = [f"{joint}.{suffix}" for suffix in feature.suffixes]
            if not set(names).isdisjoint(chosen):
                values = feature.values(motion.q[:, qadr], motion.v[:, dof], self.ranges[joint])
                found |= dict(zip(names, values.T, strict=True))
        columns = [found[name] for name in chosen if name in found]
        return np.stack(columns, axis=1) if columns else np.zeros((len(motion), 0))


def features_of(
    features: Sequence[Term],
    joints: Sequence[str],
    indices: Sequence[tuple[int, int]],
    motions: Sequence[Trajectory],
) -> JointFeatures:
    """Return the features of `joints`, with their range over all training motions.

    `indices` are the indices (in q, in v) of each joint.
    """
    ranges = {}
    for joint, (qadr, _) in zip(joints, indices, strict=True):
        q = np.concatenate([motion.q[:, qadr] for motion in motions])
        ranges[joint] = (float(q.min()), float(q.max()))
    return JointFeatures(tuple(features), dict(zip(joints, indices, strict=True)), ranges)


@dataclass(frozen=True, eq=False)
class MotorColumns:
    """Columns of motor terms, named "<motor>.<suffix>".

    `inverse` is G^-1 (k, k), `coordinates` (k,) name the driven joints, `suffixes` are those of
    plain terms (fv, fc, Ia), and `features` those whose joints are the motors.
    """

    inverse: Array
    coordinates: tuple[str, ...]
    suffixes: tuple[str, ...]
    features: JointFeatures

    @property
    def names(self) -> tuple[str, ...]:
        """Names motor1, motor2, ... of the motors."""
        return motor_names(len(self.inverse))

    @property
    def plain(self) -> tuple[str, ...]:
        """Column names of plain terms."""
        return tuple(f"{motor}.{suffix}" for suffix in self.suffixes for motor in self.names)

    @property
    def columns(self) -> tuple[str, ...]:
        """All column names, plain terms first."""
        return (*self.plain, *self.features.columns)

    @property
    def coupled(self) -> tuple[str, ...]:
        """Columns of motors that share a joint with another motor.

        A motor that drives one joint alone is left out: its columns are, up to a factor, those of
        the joint, so that the two could not be identified apart.
        """
        shares = self.inverse != 0
        alone = [
            shares[k].sum() == 1 and shares[:, shares[k].argmax()].sum() == 1
            for k in range(len(shares))
        ]
        kept = {motor for motor, single in zip(self.names, alone, strict=True) if not single}
        return tuple(name for name in self.columns if name.partition(".")[0] in kept)

    def rows_of(self, name: str) -> tuple[str, ...]:
        """Return the joints on whose rows a column is non-zero."""
        factors = self.inverse[self.names.index(name.partition(".")[0])]
        return tuple(c for c, factor in zip(self.coordinates, factors, strict=True) if factor != 0)

    def on_row(self, row: str, names: Sequence[str], motors: Trajectory) -> Array:
        """Return the columns (N, k) called `names` on one joint's row, along a motion of the
        motors."""
        i = self.coordinates.index(row)
        columns = []
        for name in names:
            motor, _, suffix = name.partition(".")
            k = self.names.index(motor)
            if suffix in self.suffixes:
                value = TERM[suffix](motors.q[:, k], motors.v[:, k], motors.a[:, k])
            else:
                value = self.features.of_joint(motor, motors, [name])[:, 0]
            # tau = G^-T tau_motor: row i takes the share (G^-1)_ki of motor k.
            columns.append(self.inverse[k, i] * value)
        return np.stack(columns, axis=1)


def motor_names(count: int) -> tuple[str, ...]:
    """Return the names of `count` motors."""
    return tuple(f"{MOTOR}{k + 1}" for k in range(count))
