"""Fits of one joint's torque by its own columns, without model parameters or other torques."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput, JointMotion
from sysid_bench.types import Array

SAMPLES: Final = 1500
FOLDS: Final = 5
RIDGE: Final = 1e-8
"""Relative to the largest singular value squared."""


@dataclass(frozen=True, eq=False)
class JointRows:
    """Rows of one recording: link columns and friction of each joint for its own torque."""

    evidence: DiagnoseInput

    @cached_property
    def rows(self) -> slice:
        """Samples in use among those of the evidence."""
        return slice(0, None, max(1, -(-len(self.evidence.motion) // SAMPLES)))

    @cached_property
    def motion(self) -> JointMotion:
        """Motion at these samples."""
        return self.evidence.motion.rows(self.rows)

    @cached_property
    def torque(self) -> Array:
        """Torque (N, n) at these samples."""
        return np.asarray(self.evidence.torque[self.rows])

    @cached_property
    def _links(self) -> Array:
        return np.asarray(self.evidence.regressor(self.motion) * self.evidence.link_std)

    @cached_property
    def _folds(self) -> Array:
        """Part (N,) of the time of each sample."""
        return np.asarray(np.arange(len(self.motion)) * FOLDS // len(self.motion))

    def friction(self, j: int) -> Array:
        """Columns (N, 3) of viscous and Coulomb friction and offset."""
        m = self.motion
        return np.column_stack([m.v[:, j], m.sign[:, j], np.ones(len(m))])

    def link_columns(self, j: int) -> Array:
        """Independent columns (N, r) of the links in the torque of joint j."""
        W = self._links[:, j]
        values, vectors = np.linalg.eigh(W.T @ W)
        kept = values > RIDGE * max(float(values[-1]), 1e-300)
        return np.asarray(W @ vectors[:, kept] / np.sqrt(values[kept]))

    def columns(self, j: int) -> Array:
        """Columns (N, r + 4) of the links, friction, offset and armature."""
        return np.column_stack([self.link_columns(j), self.friction(j), self.motion.a[:, j]])

    def left_out_error(self, X: Array, j: int) -> float:
        """Mean squared error of joint j's torque in parts of time that columns X (N, k) were not
        fitted to."""
        y = self.torque[:, j]
        size = np.linalg.norm(X, axis=0)
        Xs = X[:, size > 0] / size[size > 0]
        error = 0.0
        for fold in range(FOLDS):
            out = self._folds == fold
            A, b = Xs[~out], y[~out]
            H = A.T @ A + RIDGE * np.eye(Xs.shape[1])
            error += float(((y[out] - Xs[out] @ np.linalg.solve(H, A.T @ b)) ** 2).sum())
        return error / len(y)
