"""Columns of effects: the torque of each as the plug-in of its name has it, per unit of its size.

A joint's friction has a direction s, sign(v) with the play of a `width` at each reversal, which all
its columns share. Each group of columns is kept or left out as a whole.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from sysid_bench.apps.twins.joint_signals import JointSignals
from sysid_bench.simulation.effects.friction import play_position
from sysid_bench.types import Array

STEP_WIDTH: Final = 1e-6
"""rad, m: a transition so narrow that friction is sign(v)."""

WIDTHS: Final = (2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2)
"""rad, m: transitions that are tried; 0.1 to 5 mrad in residuals of recorded arms."""

DELAYS: Final = (0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06)
"""s: delays of the torque that are tried; recorded arms show up to 60 ms."""

SPEEDS: Final = (0.05, 0.15, 0.4)
"""Stribeck velocities that are tried, as shares of the RMS rate."""

SHARPNESS: Final = 20.0
"""Stribeck velocity over the width of its smooth sign."""

FOLDS: Final = 5
"""Blocks of time of each recording for cross-validation."""

BASE: Final = ("viscous", "coulomb", "offset")
"""Columns of every joint."""

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "load-friction": ("load",),
    "stribeck": ("stribeck",),
    "curved-friction": ("curved",),
    "low-harmonics 1": ("sin 1", "cos 1"),
    "low-harmonics 2": ("sin 2", "cos 2"),
    "low-harmonics 3": ("sin 3", "cos 3"),
    "torque-drift": ("time",),
}
"""Columns by the effect or sensor error that has them; of low harmonics by order."""

NOT_NEGATIVE: Final = ("viscous", "coulomb", "load", "stribeck")
"""Columns that dissipate: their coefficients are not negative."""

PRESLIDING, DELAY = "play", "delay"
"""Groups that change the other columns, and have none of their own."""

PERIODIC: Final = "low-harmonics"
"""Begin of the groups that hinges alone have."""


def group_names(turns: bool) -> tuple[str, ...]:
    """Return the groups of a hinge (`turns`) or a slide."""
    names = (PRESLIDING, DELAY, *GROUPS)
    return names if turns else tuple(n for n in names if not n.startswith(PERIODIC))


@dataclass(frozen=True)
class JointEffects:
    """Groups of columns of a joint, with the shapes of its friction: `width` (rad, m) of the
    transition, `delay` (s) of the torque, Stribeck velocity `vs` (rad/s, m/s)."""

    groups: tuple[str, ...] = ()
    width: float = STEP_WIDTH
    delay: float = 0.0
    vs: float = 1.0

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns, those of BASE first."""
        more = (name for group in self.groups for name in GROUPS.get(group, ()))
        return (*BASE, *more)

    def candidates(self, groups: Iterable[str], speed: float) -> Iterator["JointEffects"]:
        """Yield the effects with one further group in each of its shapes. `speed`: RMS rate of the
        joint."""
        for group in groups:
            if group not in self.groups:
                yield from self._with_group(group, speed)

    def _with_group(self, group: str, speed: float) -> Iterator["JointEffects"]:
        added = replace(self, groups=(*self.groups, group))
        if group == PRESLIDING:
            yield from (replace(added, width=width) for width in WIDTHS)
        elif group == DELAY:
            yield from (replace(added, delay=delay) for delay in DELAYS)
        elif group == "stribeck":
            yield from (replace(added, vs=share * speed) for share in SPEEDS)
        else:
            yield added


@dataclass(frozen=True, eq=False)
class JointColumns:
    """Filtered columns of one joint along some recordings, each computed once."""

    logs: tuple[JointSignals, ...]
    joint: int
    step: int  # every `step`-th sample is fitted
    _columns: dict[tuple[str, float], Array] = field(default_factory=dict)

    def matrix(self, effects: JointEffects) -> Array:
        """Return the columns (N, k) of these effects at the samples of the fit."""
        return np.column_stack([self._column(name, effects) for name in effects.columns])

    def torque_with_delay(self, delay: float) -> Array:
        """Return the torque (N,) that the columns have to explain, where it is late by `delay`."""
        return self._kept(("target", delay), lambda one: self._unexplained(one, delay))

    @property
    def blocks(self) -> Array:
        """The block of time (N,) of each sample, those of every recording in turn."""
        counts = [len(range(0, len(one.t), self.step)) for one in self.logs]
        return np.concatenate([np.arange(n) * FOLDS // n for n in counts])

    @property
    def speed(self) -> float:
        """RMS rate of the joint (rad/s, m/s)."""
        v = np.concatenate([one.v[:, self.joint] for one in self.logs])
        return float(np.sqrt(np.mean(v**2)))

    def _column(self, name: str, effects: JointEffects) -> Array:
        shape = effects.vs if name == "stribeck" else effects.width
        key = (name, shape if name in ("coulomb", "load", "stribeck") else 0.0)
        return self._kept(
            key, lambda one: one.smooth(effect_values(one, self.joint, name, effects)[:, None])
        )

    def _kept(self, key: tuple[str, float], values: Callable[[JointSignals], Array]) -> Array:
        if key not in self._columns:
            parts = [values(one).reshape(-1)[:: self.step] for one in self.logs]
            self._columns[key] = np.concatenate(parts)
        return self._columns[key]

    def _unexplained(self, one: JointSignals, delay: float) -> Array:
        tau = np.interp(one.t + delay, one.t, one.tau[:, self.joint])
        return np.asarray(tau - one.smooth(one.rest[:, [self.joint]])[:, 0])


def effect_values(one: JointSignals, joint: int, name: str, effects: JointEffects) -> Array:
    """Return a column (N,) of effects of one joint, unfiltered."""
    q, v = one.q[:, joint], one.v[:, joint]
    word, _, order = name.partition(" ")
    if word in ("sin", "cos"):
        return np.asarray(getattr(np, word)(float(order) * q))
    if name in ("coulomb", "load"):
        s = _friction_direction(q, v, effects.width)
        return np.asarray(s if name == "coulomb" else np.abs(one.load[:, joint]) * s)
    if name == "stribeck":
        peak = np.exp(-((v / effects.vs) ** 2))
        return np.asarray(peak * np.tanh(SHARPNESS * v / effects.vs))
    simple = {"viscous": v, "curved": np.abs(v) * v, "time": one.t}
    return np.asarray(simple.get(name, np.ones_like(v)))


def _friction_direction(q: Array, v: Array, width: float) -> Array:
    """Return the normalised play (N,) of a motion q (N,), which starts at rates v (N,)."""
    if width <= STEP_WIDTH:
        return np.asarray(np.sign(v))
    place, w = np.empty_like(q), np.array(width)
    p = np.asarray(q[0] - width * np.sign(v[0]))
    for k, position in enumerate(q):
        p = play_position(p, position, w)
        place[k] = p
    return np.asarray((q - place) / width)
