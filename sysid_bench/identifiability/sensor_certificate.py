"""Certificate of a force/torque sensor: which drive torques its identifiable subspace predicts.

Proposition 1 of Traversaro et al. (2015) states that the wrench of a six-axis sensor identifies
every combination on which the torques of the joints behind it depend. Its hypothesis is that these
joints move independently. Couplings restrict the motions: fewer combinations appear in the wrench,
while the torque of a drive may need the others (two fingers that open symmetrically).

With Y_n over random admissible states, V an orthonormal basis of its row space, and g_k the row of
G(q)^T Y_c of drive k, the residual is rho_k = max |g_k (I - V V')| / max |g_k|. The torque of drive
k is predictable in all motions iff rho_k = 0.

V is that of exact arithmetic. Estimators drop directions that are nearly dependent
(`RANK_TOLERANCE`); `dropped` is the residual against what they keep.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np

from sysid_bench.identifiability.base_expressions import ZERO
from sysid_bench.identifiability.base_map import NOISE_FLOOR, qr_columns
from sysid_bench.identifiability.subspaces import floating_subtree_states, row_space
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree, chain_bodies
from sysid_bench.numerics import qr_factor
from sysid_bench.regressors.wrench import SubtreeDrives, subtree_drives
from sysid_bench.types import Array

RESIDUAL: Final = 1e-9
"""Residual rho above which a torque is unpredictable. Predictable ones leave at most 1.3e-11,
others at least 1.3e-2 (measured on 55 sub-trees of 26 robots with couplings)."""

SPARSE: Final = 0.1
"""Share of the largest effect that a direction with fewer parameters must have to be preferred."""


@dataclass(frozen=True)
class _DrivePrediction:
    """Verdict on the torque of one drive, in N m or N (`unit`): predicted by a sensor or not.

    `residual`: rho_k; `dropped`: the same against the base parameters that estimators keep, a
    relative error that nearly dependent parameters can cause; `followers`: other joints that the
    drive moves; `direction`: changes of parameters {name: change} that leave the wrench as it is,
    in every motion, but change the torque by `effect` (largest over random states); None where the
    torque is predictable.
    """

    name: str
    unit: str
    residual: float
    dropped: float
    followers: tuple[str, ...] = ()
    direction: Mapping[str, float] | None = None
    effect: float = 0.0

    @property
    def predictable(self) -> bool:
        """True if the wrench identifies all combinations that the torque depends on."""
        return self.residual <= RESIDUAL


@dataclass(frozen=True)
class _Addition:
    """A measurement besides the sensor's wrench: the torque of a drive, or a second sensor at a
    body. `rank`: base parameters that it adds; `predicts`: drives that become predictable."""

    kind: Literal["torque", "sensor"]
    name: str
    rank: int
    predicts: tuple[str, ...]


@dataclass(frozen=True)
class SensorCertificate:
    """Torques that the wrench of a sensor predicts in every motion, by structure alone.

    `coupled`: joints behind the sensor are coupled, so that Proposition 1 does not apply; `rank`:
    base parameters of the wrench; `partial`: drives that also move joints proximal to the sensor.
    """

    sensor: str
    rank: int
    coupled: bool
    drives: tuple[_DrivePrediction, ...]
    additions: tuple[_Addition, ...] = ()
    partial: tuple[str, ...] = ()

    @property
    def predictable(self) -> tuple[str, ...]:
        """Drives whose torque the sensor predicts."""
        return tuple(drive.name for drive in self.drives if drive.predictable)

    @property
    def unpredictable(self) -> tuple[str, ...]:
        """Drives whose torque no motion makes predictable from this sensor alone."""
        return tuple(drive.name for drive in self.drives if not drive.predictable) + self.partial


def sensor_certificate(robot: RobotModel, cut: SensorSubtree) -> SensorCertificate:
    """Return the certificate of a sensor over all motions of the robot."""
    test = _RowSpaceTest(robot, cut)
    drives = tuple(test.prediction(k) for k in range(len(test.drives.rows)))
    lost = [k for k, drive in enumerate(drives) if not drive.predictable]
    return SensorCertificate(
        sensor=cut.name,
        rank=test.kept.shape[1],
        coupled=bool(test.drives.partial) or any(test.drives.followers),
        drives=drives,
        additions=tuple(test.additions(lost)),
        partial=test.drives.partial,
    )


class _RowSpaceTest:
    """Rows of a sub-tree at random admissible states, and the row space V (p, r) of the wrench."""

    def __init__(self, robot: RobotModel, cut: SensorSubtree) -> None:
        subtree = floating_subtree_states(robot, cut)
        self.robot, self.cut = robot, cut
        self.columns, self.Y_n = subtree.columns, subtree.Y_n
        self.drives: SubtreeDrives = subtree_drives(robot, cut, subtree.motion.q)
        self.rows = self.drives.reduced(subtree.Y_c)  # (N, d, p)
        self.V = row_space(self.Y_n, NOISE_FLOOR)[0]
        self.kept = row_space(self.Y_n)[0]

    @cached_property
    def null_directions(self) -> Array:
        """Parameter changes (p, p - r) with Y_n x = 0: each changes one parameter, and pivots that
        compensate for it."""
        p, rank = self.V.shape
        # Pivots of V' are as well conditioned as they can be; K is exact for the row space V.
        pivots = qr_columns(self.V.T, rank)
        K = np.linalg.solve(self.V.T[:, pivots], self.V.T)
        others = np.setdiff1d(np.arange(p), pivots)
        directions = np.eye(p)[:, others]
        directions[pivots] = -np.where(np.abs(K) > ZERO, K, 0.0)[:, others]
        return directions

    def prediction(self, k: int) -> _DrivePrediction:
        """Residual of drive k, and a direction that changes its torque alone."""
        found = _DrivePrediction(
            self.drives.rows[k],
            self.drives.units[k].split(" ", 1)[1],
            _residual(self.rows[:, k], self.V),
            _residual(self.rows[:, k], self.kept),
            self.drives.followers[k],
        )
        if found.predictable:
            return found
        # The sparsest of the directions with a large effect on the torque of drive k.
        X = self.null_directions
        effects = np.abs(self.rows[:, k] @ X).max(axis=0)
        shares = effects / np.linalg.norm(X, axis=0)
        candidates = np.flatnonzero(shares > SPARSE * shares.max())
        sizes = np.count_nonzero(X[:, candidates], axis=0)
        best = candidates[np.lexsort((-shares[candidates], sizes))[0]]
        x = X[:, best]
        named = {self.columns[i]: float(x[i]) for i in np.argsort(-np.abs(x)) if x[i] != 0.0}
        return replace(found, direction=named, effect=float(effects[best]))

    def additions(self, lost: Sequence[int]) -> Iterator[_Addition]:
        """Measurements that make drives `lost` predictable: their torques, then further sensors."""
        if not lost:
            return
        for k in lost:
            yield self._addition("torque", self.drives.rows[k], self.rows[:, k, None], lost)
        # Bodies that a second sensor can be at: moved, and in no closed loop.
        moving, p = {link.body for link in self.robot.tree.links}, len(self.columns)
        chains = chain_bodies(self.robot)
        for body in self.cut.bodies[1:]:
            places = self._distal(body)
            distal = {self.cut.bodies[i] for i in places}
            if body not in moving or any((a in distal) != (b in distal) for a, b in chains):
                continue
            inside = np.isin(np.arange(p) // 10, places)
            found = self._addition("sensor", self.robot.body_names[body], self.Y_n * inside, lost)
            if found.predicts:
                yield found

    def _addition(
        self, kind: Literal["torque", "sensor"], name: str, rows: Array, lost: Sequence[int]
    ) -> _Addition:
        more = _span(rows, self.V)
        V = np.hstack([self.V, more])
        predicts = tuple(
            self.drives.rows[k] for k in lost if _residual(self.rows[:, k], V) <= RESIDUAL
        )
        return _Addition(kind, name, more.shape[1], predicts)

    def _distal(self, body: int) -> list[int]:
        """Indices among the bodies of the sub-tree of a body and its descendants."""
        inside = [body]
        for b in self.cut.bodies:
            if b > body and int(self.robot.mj.body_parentid[b + 1]) - 1 in inside:
                inside.append(b)
        return [self.cut.bodies.index(b) for b in inside]


def _residual(rows: Array, V: Array) -> float:
    """max |g (I - V V')| / max |g| over rows g (N, p); zero where all rows vanish."""
    largest = float(np.linalg.norm(rows, axis=1).max(initial=0.0))
    if largest == 0.0:
        return 0.0
    left = rows - (rows @ V) @ V.T
    return float(np.linalg.norm(left, axis=1).max()) / largest


def _span(rows: Array, V: Array) -> Array:
    """Orthonormal basis (p, k) of what rows (N, m, p) add to the span of V (p, r), relative to
    their own size: drives of a gripper are small beside the wrench of an arm."""
    p = rows.shape[-1]
    rows = rows.reshape(-1, p)
    left = qr_factor([np.zeros((1, p)), rows - (rows @ V) @ V.T])
    _, values, Vt = np.linalg.svd(left, full_matrices=False)
    count = int((values > RESIDUAL * np.linalg.norm(rows, 2)).sum())  # above the rounding of V
    return Vt[:count].T
