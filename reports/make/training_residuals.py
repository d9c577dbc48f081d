"""Sizes of effects in the training residuals of those recorded robots that sizes may come from.

    SYSID_BENCH_DATA=... python -m reports.make.training_residuals

For each robot with "sizes" in recorded_levels.toml and each joint, the columns of one
effect at a time are added to the rigid model of its training logs (least squares; all columns and
the torque through the same low-pass of 10 Hz). Printed is the size of the effect in the unit of the
plant files, if it is above zero in a fit whose error on left-out fifths of the recording falls;
0 otherwise; then quartiles over joints. No test log is read.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import mkdtemp
from typing import Final

import numpy as np
from scipy.signal import butter, sosfiltfilt

from reports.make.recorded_cases import Case, cases
from sysid_bench.experiments.recorded.prepare import LogOptions, prepare_recordings
from sysid_bench.types import Array

BAND: Final = 10.0
"""Hz: low-pass of rows."""
VS: Final = 0.05
"""rad/s: Stribeck velocity of `lugre`."""
WIDTHS: Final = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3)
"""rad: half widths of play that are tried."""
FOLDS: Final = 5
ROWS: Final = 40.0
"""Hz: rate of the rows that are kept."""


class Joint:
    """Rows of one joint: W (N, r), tau (N,), and the state q, v (N,) at the rate of the log."""

    def __init__(self, W: Array, tau: Array, q: Array, v: Array, rate: float) -> None:
        self.q, self.v, self.rate = q, v, rate
        self.sos = butter(2, BAND, fs=rate, output="sos") if rate > 2.5 * BAND else None
        self.W, self.tau = self.rows(W), self.rows(tau[:, None])[:, 0]
        used = np.linalg.norm(self.W, axis=0) > 1e-9 * np.linalg.norm(self.W)
        self.W = self.W[:, used]
        self.model = self.W @ np.linalg.lstsq(self.W, self.tau, rcond=1e-10)[0]
        self.load = np.interp(np.arange(len(q)), np.arange(len(self.model)) * self.step, self.model)
        force = self.rows(np.sign(v)[:, None])
        self.coulomb = abs(self._own(force[:, 0]))

    @property
    def step(self) -> int:
        """Rows that are left out between kept ones."""
        return max(1, int(self.rate / ROWS))

    def rows(self, columns: Array) -> Array:
        """Columns (N, k) through the low-pass, decimated."""
        if self.sos is not None:
            columns = sosfiltfilt(self.sos, columns, axis=0)
        return np.asarray(columns[:: self.step])

    def _own(self, filtered: Array) -> float:
        """The Coulomb friction of the fit: the response of the column most like sign(v)."""
        theta = np.linalg.lstsq(self.W, self.tau, rcond=1e-10)[0]
        likeness = np.abs(self.W.T @ filtered) / np.linalg.norm(self.W, axis=0)
        column = int(np.argmax(likeness / np.linalg.norm(filtered)))
        scale = float(self.W[:, column] @ filtered / (filtered @ filtered))
        return float(theta[column]) * scale

    def error(self, extra: Array) -> float:
        """Sum of squares over left-out fifths with columns (N, k) added."""
        A = np.column_stack([self.W, self.rows(extra)]) if extra.size else self.W
        fold, total = np.arange(len(A)) * FOLDS // len(A), 0.0
        for k in range(FOLDS):
            theta = np.linalg.lstsq(A[fold != k], self.tau[fold != k], rcond=1e-10)[0]
            total += float(((self.tau[fold == k] - A[fold == k] @ theta) ** 2).sum())
        return total

    def coefficients(self, extra: Array) -> Array:
        """Coefficients (k,) of added columns."""
        A = np.column_stack([self.W, self.rows(extra)])
        return np.asarray(np.linalg.lstsq(A, self.tau, rcond=1e-10)[0][self.W.shape[1] :])

    def share(self, extra: Array) -> float:
        """Share of the left-out residual that columns (N, k) remove."""
        return 1.0 - self.error(extra) / self.error(np.empty((len(self.q), 0)))


def played(q: Array, width: float) -> Array:
    """The normalised play of half width `width`."""
    p, out = q[0], np.empty_like(q)
    for i, x in enumerate(q):
        p = min(max(p, x - width), x + width)
        out[i] = (x - p) / width
    return out


def peak(joint: Joint) -> tuple[float, Array]:
    """Stribeck peak over Coulomb friction, beside presliding; the share is that of both."""
    width, transition = presliding(joint)
    peaked = played(joint.q, width) * np.exp(-((joint.v / VS) ** 2))
    columns = np.column_stack([peaked, transition])
    return float(joint.coefficients(columns)[0]) / joint.coulomb, columns


def presliding(joint: Joint) -> tuple[float, Array]:
    """Half width of the best play in place of sign(v) (rad, m)."""
    columns = {w: (played(joint.q, w) - np.sign(joint.v))[:, None] for w in WIDTHS}
    best = min(WIDTHS, key=lambda w: joint.error(columns[w]))
    return best, columns[best]


def load(joint: Joint) -> tuple[float, Array]:
    """Coulomb friction per transmitted torque."""
    column = (np.abs(joint.load) * np.sign(joint.v))[:, None]
    return float(joint.coefficients(column)[0]), column


def asymmetry(joint: Joint) -> tuple[float, Array]:
    """Half of the difference of viscous friction of both directions, over Coulomb friction at the
    RMS rate."""
    column = np.abs(joint.v)[:, None]
    rate = float(np.sqrt((joint.v**2).mean()))
    return abs(float(joint.coefficients(column)[0])) * rate / joint.coulomb, column


def harmonics(joint: Joint) -> tuple[float, Array]:
    """Amplitude of sin, cos of 2 q and 3 q over RMS torque (those of q are gravity)."""
    q = joint.q
    columns = np.column_stack([np.sin(2 * q), np.cos(2 * q), np.sin(3 * q), np.cos(3 * q)])
    fitted = joint.rows(columns) @ joint.coefficients(columns)
    return float(fitted.std() / np.sqrt((joint.tau**2).mean())), columns


EFFECTS: Final[Mapping[str, Callable[[Joint], tuple[float, Array]]]] = {
    "peak": peak, "presliding": presliding, "load": load, "asymmetry": asymmetry,
    "harmonics": harmonics,
}  # fmt: skip


def joints_of(case: Case) -> Iterator[tuple[str, Joint]]:
    """Yield the joints of a case with the rows of its longest training log."""
    log = case.logs("train")[0]
    options = LogOptions(terms=case.options.terms, filter="butter 4 20 Hz zero-phase")
    posed = prepare_recordings(case.manifest, [log], {}, options)
    blocks = list(posed.problem.blocks())
    W, tau = np.concatenate([b[0] for b in blocks]), np.concatenate([b[1] for b in blocks])
    motion, robot = posed.source.training[0].recording.motion, posed.robot
    rate = float(1.0 / (motion.t[1] - motion.t[0]))
    for k, row in enumerate(posed.problem.rows):
        dof = robot.rows.index(row)
        q = next(motion.q[:, j.qadr] for j in robot.joints if j.vadr == dof)
        yield row, Joint(W[:, k], tau[:, k], q, motion.v[:, dof], rate)


def main() -> None:
    """Print one line per joint, and quartiles."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*")
    given = parser.parse_args()
    found: dict[str, list[float]] = {name: [] for name in EFFECTS}
    print("| robot | joint | Fc / RMS | residual | " + " | ".join(EFFECTS) + " |")
    for case in cases(given.robots, Path(mkdtemp())):
        if case.half != "sizes":
            continue
        for row, joint in joints_of(case):
            rms = float(np.sqrt((joint.tau**2).mean()))
            words = []
            for name, effect in EFFECTS.items():
                size, columns = effect(joint)
                share = joint.share(columns)
                held = size if share > 0.01 and size > 0 else 0.0
                found[name].append(held)
                words.append(f"{size:.3g} ({100 * share:.0f} %)")
            rest = float(np.sqrt(((joint.tau - joint.model) ** 2).mean())) / rms
            print(f"| {case.name} | {row} | {joint.coulomb / rms:.2g} | {rest:.2g} | "
                  + " | ".join(words) + " |", flush=True)  # fmt: skip
    for name, sizes in found.items():
        print(name, "quartiles", np.round(np.percentile(sizes, [10, 25, 50, 75, 90]), 5))


if __name__ == "__main__":
    main()
