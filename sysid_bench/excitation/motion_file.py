"""Motion from a CSV file: a column `t` (s) and one per joint, by its name (rad, m).

Recorded motions are replayed on robots with coupled joints, too: dependent joints are solved from
the independent ones, and columns of theirs are not read.
"""

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import scipy

from sysid_bench.csv_text import cell_text
from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import DesignProblem, is_count
from sysid_bench.input_files import read_text
from sysid_bench.types import Array, Trajectory

_NEGLIGIBLE: Final = 1e-8
"""Share of the largest harmonic below which others stem from the rounding of the file."""


@dataclass(frozen=True)
class MotionFile:
    """Motion of `file`, relative to the suite's folder, resampled to any rate.

    With `period` (s) the rows are one period, interpolated by their Fourier series: exact for a
    motion without frequencies above half the file's rate. Without, by a quintic spline.
    """

    file: str
    period: float | None = field(default=None, metadata={"unit": "s"})
    cycles: int = 1

    def __post_init__(self) -> None:
        if not is_count(self.cycles) or (self.period is not None and not self.period > 0):
            raise UsageError(f"{self}: required are cycles >= 1 and a positive period.")
        if self.period is None and self.cycles != 1:
            raise UsageError(f"{self}: several cycles need a period.")

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return the motion; raises UsageError for a file that does not fit the robot, ModelError
        where a closed chain cannot be closed along it. Limits are checked as those of any motion
        (limit_margins.py)."""
        # The joints of the profiles: all, or the independent ones of closed chains.
        moving = {int(dof) for dof in brief.dofs}
        ranges = [range(joint.vadr, joint.vadr + len(joint.dofs)) for joint in brief.joints]
        joints = [j for j, dofs in zip(brief.joints, ranges, strict=True) if moving & set(dofs)]
        if any(joint.kind not in ("hinge", "slide") for joint in joints):
            raise UsageError(
                f"{self.file}: a motion file can only move robots of hinges and slides."
            )
        t, x = _read(Path(self.file), [joint.name for joint in joints])
        name = Path(self.file).stem
        if self.period is None:
            grid = brief.times(t[-1] - t[0])
            curve = scipy.interpolate.make_interp_spline(t - t[0], x, k=5)
            motion = curve(grid), curve(grid, nu=1), curve(grid, nu=2)
        else:
            if abs(len(t) * (t[1] - t[0]) - self.period) > 1e-6 * self.period:
                raise UsageError(
                    f"{self.file}: {len(t)} rows every {t[1] - t[0]:.6g} s are not the period of "
                    f"{self.period} s; leave out the row that repeats the first."
                )
            grid = brief.times(self.cycles * self.period)
            # Fourier series (N, nv) through the rows of one period, and its derivatives.
            c = np.fft.rfft(x, axis=0) / len(x)
            if len(x) % 2 == 0:
                c[-1] = 0.0  # at half the file's rate the phase is unknown
            k = np.flatnonzero(np.abs(c).max(axis=1) > _NEGLIGIBLE * np.abs(c[1:]).max())
            k = k[k > 0]
            w = 2 * np.pi / self.period * k
            wave = np.exp(2j * np.pi / self.period * np.outer(grid, k))
            # Real signals have conjugate harmonics at -k: twice the real part stands for both.
            parts = [2 * (wave @ ((1j * w[:, None]) ** n * c[k])).real for n in range(3)]
            motion = c[0].real + parts[0], parts[1], parts[2]
        return brief.trajectory(grid, *motion, name, self.period)


def _read(path: Path, names: list[str]) -> tuple[Array, Array]:
    """Return times (N,) and positions (N, n) in the order of the names; raises UsageError for
    other columns, for text and missing numbers, and unless the times rise in even steps."""
    try:
        lines = csv.reader(read_text(path).splitlines())
        header, *rows = [row for row in lines if row and not row[0].startswith("#")]
        columns = [cell_text(name.strip()) for name in header]
        table = np.array(rows, dtype=float)
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(f"{path} is not a table of numbers with a header: {error}.") from error
    missing = {"t", *names} - set(columns)
    if missing or table.ndim != 2 or table.shape[1] != len(columns):
        raise UsageError(
            f"{path} has the columns {', '.join(columns)}; expected t, {', '.join(names)}."
        )
    t = table[:, columns.index("t")]
    steps = np.diff(t)
    if len(t) < 10 or not np.isfinite(table).all() or not (steps > 0).all():
        raise UsageError(f"{path} needs at least ten rows of finite numbers, with rising times.")
    if np.ptp(steps) > 1e-3 * steps.mean():
        raise UsageError(f"{path}: the times are not evenly spaced; resample the motion.")
    return t, table[:, [columns.index(name) for name in names]]
