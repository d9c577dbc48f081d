"""Torque that acts in motors and reaches joints through a transmission: friction, hysteresis and
inertia of drives that move several joints together.

q = G q_motor, tau_motor = G' tau: what motor k pays, joint i feels (G^-1)_ki of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.regressors.friction_features import JointFeatures
from sysid_bench.regressors.regression import TERM
from sysid_bench.types import Array, Trajectory

MOTOR: Final = "motor"
"""Motors are called motor1, motor2, ... in the order of the transmission's columns."""


@dataclass(frozen=True, eq=False)
class MotorColumns:
    """Columns by name "<motor>.<suffix>": `suffixes` of plain terms (fv, fc, Ia), and `features`
    whose joints are the motors. `inverse` G^-1 (k, k); `coordinates` (k,) name what is driven."""

    inverse: Array
    coordinates: tuple[str, ...]
    suffixes: tuple[str, ...]
    table: JointFeatures

    @property
    def names(self) -> tuple[str, ...]:
        """motor1, motor2, ..."""
        return motor_names(len(self.inverse))

    @property
    def plain(self) -> tuple[str, ...]:
        """Names of plain terms."""
        return tuple(f"{motor}.{suffix}" for suffix in self.suffixes for motor in self.names)

    @property
    def columns(self) -> tuple[str, ...]:
        """All names, plain terms first."""
        return (*self.plain, *self.table.columns)

    @property
    def coupled(self) -> tuple[str, ...]:
        """Columns of motors that share a joint with another: those of the others are what their
        joint's own columns are."""
        shares = self.inverse != 0
        alone = [
            shares[k].sum() == 1 and shares[:, shares[k].argmax()].sum() == 1
            for k in range(len(shares))
        ]
        kept = {motor for motor, own in zip(self.names, alone, strict=True) if not own}
        return tuple(name for name in self.columns if name.partition(".")[0] in kept)

    def rows_of(self, name: str) -> tuple[str, ...]:
        """The joints that feel a column."""
        felt = self.inverse[self.names.index(name.partition(".")[0])]
        return tuple(c for c, share in zip(self.coordinates, felt, strict=True) if share != 0)

    def on_row(self, row: str, names: Sequence[str], motors: Trajectory) -> Array:
        """Values (N, k) on one joint's row, along a motion of the motors."""
        i = self.coordinates.index(row)
        columns = []
        for name in names:
            motor, _, suffix = name.partition(".")
            k = self.names.index(motor)
            if suffix in self.suffixes:
                value = TERM[suffix](motors.q[:, k], motors.v[:, k], motors.a[:, k])
            else:
                value = self.table.of_joint(motor, motors, [name])[:, 0]
            columns.append(self.inverse[k, i] * value)
        return np.stack(columns, axis=1)


def motor_names(count: int) -> tuple[str, ...]:
    """Names of so many motors."""
    return tuple(f"{MOTOR}{k + 1}" for k in range(count))
