"""Commands along a motion: positions, velocities, accelerations and feed-forward torques."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.csv_text import csv_text
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands of k joints over time: t (N,), q, v, a, tau (N, k), SI."""

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array
    a: Array
    tau: Array

    def __len__(self) -> int:
        return len(self.t)

    @property
    def is_at_standstill(self) -> bool:
        """True if the motion starts and ends below 0.001 rad/s (m/s)."""
        return bool(np.abs(self.v[[0, -1]]).max() < 1e-3)


def commands_of(
    motion: Trajectory, tau: Array, joints: tuple[str, ...], qadr: list[int], dofs: list[int]
) -> Commands:
    """Return the commands of joints at `qadr` in q and `dofs` in v, with torques tau (N, k)."""
    return Commands(joints, motion.t, motion.q[:, qadr], motion.v[:, dofs], motion.a[:, dofs], tau)


def commands_csv(commands: Commands) -> str:
    """Return CSV text `t, <joint>.q ..., <joint>.v ..., <joint>.a ..., <joint>.tau ...`, a line per
    sample, whose numbers read back exactly."""
    parts = {"q": commands.q, "v": commands.v, "a": commands.a, "tau": commands.tau}
    head = ["t", *(f"{joint}.{key}" for key in parts for joint in commands.joints)]
    table = np.column_stack([commands.t, *parts.values()])
    return csv_text([head, *table.tolist()])
