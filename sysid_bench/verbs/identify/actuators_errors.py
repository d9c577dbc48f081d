"""Errors of identified actuators on the parts of recordings that were not fitted."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sysid_bench.apps.actuators.drive_estimate import DriveEstimate
from sysid_bench.apps.actuators.drive_part import DrivePart
from sysid_bench.apps.actuators.drive_rows import drive_rows, pooled_rows
from sysid_bench.apps.actuators.rollout import missing_simulation, simulated_positions
from sysid_bench.evaluation.torque_errors import loaded_joints
from sysid_bench.signals.log_samples import scalar_kinds
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class DriveErrors:
    """Errors (k,) of identified actuators on parts that were not fitted."""

    found: DriveEstimate
    parts: Sequence[DrivePart]

    @property
    def reason(self) -> str:
        """Reason for which the robot is not simulated; empty if it is."""
        return missing_simulation(self.parts[0].robot)

    @cached_property
    def position_errors(self) -> list[Array]:
        """Squared errors (n, k) of the simulated positions of each part; none of a measured torque,
        whose commands are not known, and of robots that are not simulated."""
        if self.reason:
            return []
        joints = self.found.rows.joints
        return [
            (simulated_positions(part.robot, self.found.drives, commands, part.rows)
             - commands.q[part.rows]) ** 2
            for part in self.parts
            if part.log.commands is not None
            for commands in [part.log.commands.of(joints)]
        ]  # fmt: skip

    @cached_property
    def torque_rms(self) -> tuple[Array, Array]:
        """RMS of the torque, filtered, and of its error (k,)."""
        of = self.found.rows
        rows = pooled_rows([
            drive_rows(p.robot, p.log, of.joints, p.rows, of.more, of.bias) for p in self.parts
        ])  # fmt: skip
        tau = rows.torque(self.found.delay)
        error = tau - np.einsum("nkc,kc->nk", rows.features, self.found.fit.factors)
        return _rms(tau + rows.links), _rms(error)

    @cached_property
    def torque_ratio(self) -> Array:
        """RMS error of the torque over its RMS (k,); NaN for joints with hardly any torque."""
        robot, (torque, error) = self.parts[0].robot, self.torque_rms
        kind = scalar_kinds(robot)
        loaded = loaded_joints(torque, [kind[name] for name in self.found.rows.joints])
        return np.asarray(np.divide(error, torque, out=np.full_like(error, np.nan), where=loaded))


def _rms(x: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)))


def part_errors(judged: DriveErrors) -> list[dict[str, Any]]:
    """Return recording, first and last time (s) and RMS error (rad, m) of each simulated part."""
    parts = [part for part in judged.parts if part.log.commands is not None and not judged.reason]
    return [
        {
            "log": part.name,
            "from": part.times[0],
            "to": part.times[1],
            "rollout": float(np.sqrt(squares.mean())),
        }
        for part, squares in zip(parts, judged.position_errors, strict=True)
    ]
