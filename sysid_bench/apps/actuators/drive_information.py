"""Information of a recording on its actuators and on the delay of their commands."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.delay_information import delay_effect
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS, DriveRows
from sysid_bench.types import Array

RESIDUAL: Final = 0.05
"""Share of the RMS torque of a joint that the model is expected to leave."""

FLOOR: Final = 0.005
"""rad, m: position error whose torque, kp times it, is left at rest as well."""

CORRELATION: Final = 0.05
"""s, correlation time of these residuals."""

SMALLEST: Final = 1e-12
"""Added to the scaled information, so that what a recording says nothing of has a deviation."""


@dataclass(frozen=True, eq=False)
class DriveInformation:
    """Information matrices (k, 5, 5) of the values of each joint, in the order of UNKNOWNS, and of
    the delay; its value (s) is common to the joints. `rest` (k,): share of the residuals' mean
    square that a second of delay adds beyond what the values of the joint take up."""

    blocks: Array
    rest: Array

    @cached_property
    def matrix(self) -> Array:
        """The whole information matrix (4 k + 1, 4 k + 1); the delay is last."""
        k, each = len(self.blocks), len(UNKNOWNS)
        whole = np.zeros((each * k + 1, each * k + 1))
        for j, block in enumerate(self.blocks):
            places = [*range(each * j, each * (j + 1)), each * k]
            whole[np.ix_(places, places)] += block
        return whole

    @property
    def std(self) -> Array:
        """Deviations (4 k + 1,) of an estimate, the delay's (s) last."""
        return np.sqrt(np.diag(_inverse(self.matrix)))

    @property
    def delay_open(self) -> float:
        """Error (s) of the delay whose effect is as large as the residuals."""
        mean = float(np.mean(self.rest))
        return 1.0 / np.sqrt(mean) if mean > 0.0 else np.inf

    def by_joint(self, armature: Array) -> Array:
        """Return ln det (k,) of the covariance of each joint's armature, over `armature` (k,), and
        of the delay (ms), from the rows of that joint alone."""
        found = []
        for block, nominal in zip(self.blocks, armature, strict=True):
            covariance = _inverse(block)[np.ix_([0, -1], [0, -1])]
            unit = np.array([nominal, 1e-3])
            found.append(np.linalg.slogdet(covariance / np.outer(unit, unit))[1])
        return np.array(found)


def drive_information(rows: DriveRows, delay: float, kp: Array) -> DriveInformation:
    """Return the information of rows at a delay (s), for residuals of RESIDUAL of each joint and
    of FLOOR times its gain kp (k,)."""
    effect = delay_effect(rows, delay)
    total = rows.torque(delay) + rows.links
    sigma = np.hypot(RESIDUAL * np.sqrt(np.mean(total**2, axis=0)), FLOOR * kp)
    weight = min(1.0, 1.0 / (CORRELATION * rows.rate))
    whole = np.concatenate([rows.features, effect[:, :, None]], axis=2) / sigma[:, None]
    blocks = weight * np.einsum("nkc,nkd->kcd", whole, whole)
    scaled = [1.0 / max(_inverse(block)[-1, -1], SMALLEST) for block in blocks]
    return DriveInformation(blocks, np.array(scaled) / (weight * len(effect)))


def _inverse(matrix: Array) -> Array:
    scale = np.sqrt(np.maximum(np.diag(matrix), SMALLEST))
    unit = matrix / np.outer(scale, scale) + SMALLEST * np.eye(len(matrix))
    return np.asarray(np.linalg.inv(unit) / np.outer(scale, scale))
