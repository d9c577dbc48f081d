"""Torque terms of motors that drive several joints through a transmission.

With q = G q_motor, virtual work gives tau_motor = G^T tau. Friction, hysteresis and inertia of
motor k therefore appear on the row of joint i with the factor (G^-1)_ki.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid_bench.regressors.joint_features import JointFeatures
from sysid_bench.regressors.regression import TERM
from sysid_bench.types import Array, Trajectory
from sysid_bench.words import MOTOR


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
