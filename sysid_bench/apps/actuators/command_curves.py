"""Commands of a recording that separates delay, armature, damping and gains: chirps with steps,
repeated under two sets of gains."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array

LOW: Final = np.array([0.2, 1.5, 0.0, 0.25, 0.0, 0.1])
HIGH: Final = np.array([0.6, 7.0, 6.3, 0.9, 6.3, 0.6])
"""Ranges of a wave: first and last frequency (Hz) and phase of its chirp, rate (Hz), phase and
share of its steps."""

RAMP: Final = 0.5
"""s in which curves grow and fade away."""


@dataclass(frozen=True, eq=False)
class CommandCurves:
    """Commands of k joints: `shapes` (k, 6) within LOW and HIGH, about `centre` (k,) with
    amplitudes `reach` (k,). Each of the `gains`, shares of kp and kd, acts for an equal part."""

    shapes: Array
    centre: Array
    reach: Array
    gains: tuple[tuple[float, float], ...]

    def positions(self, count: int, rate: float) -> Array:
        """Return the commanded positions (count, k) at a rate (Hz): all parts are alike."""
        part = -(-count // len(self.gains))
        t = np.arange(part)[:, None] / rate
        length = part / rate
        first, last, phase, steps, lag, share = self.shapes.T
        chirp = np.sin(2.0 * np.pi * (first + 0.5 * (last - first) * t / length) * t + phase)
        square = np.sign(np.sin(2.0 * np.pi * steps * t + lag))
        ramp = np.clip(np.minimum(t, length - t) / RAMP, 0.0, 1.0)
        one = self.centre + self.reach * ramp * ((1.0 - share) * chirp + share * square)
        return np.tile(one, (len(self.gains), 1))[:count]

    def commands(self, whole: Commands) -> Commands:
        """Return commands with these positions and gains; `whole` holds the nominal gains."""
        count = len(whole)
        part = np.arange(count) * len(self.gains) // count
        share = np.array(self.gains)[part]
        q_des = self.positions(count, whole.rate)
        kp, kd = whole.kp * share[:, :1], whole.kd * share[:, 1:]
        return replace(whole, q=np.tile(q_des[0], (count, 1)), q_des=q_des, kp=kp, kd=kd)


def random_curves(
    rng: np.random.Generator, centre: Array, reach: Array, gains: tuple[tuple[float, float], ...]
) -> CommandCurves:
    """Return random curves about `centre` within `reach` (k,)."""
    shapes = rng.uniform(LOW, HIGH, (len(centre), len(LOW)))
    return CommandCurves(shapes, centre, reach, gains)


def random_near(curves: CommandCurves, rng: np.random.Generator, spread: float) -> CommandCurves:
    """Return curves whose shapes differ by `spread`, a share of their ranges (one sigma)."""
    moved = curves.shapes + spread * (HIGH - LOW) * rng.normal(size=curves.shapes.shape)
    return replace(curves, shapes=np.clip(moved, LOW, HIGH))
