"""Force laws of a plant: functions of the present state, and laws with internal states."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from sysid_bench.types import Array


class TorqueLaw(Protocol):
    """Torque as a function of time and state.

    Called with single samples (closed loop) or whole motions. A law with a `kind` and `numbers`
    that steps.c implements runs compiled.
    """

    def __call__(self, t: Array, q: Array, v: Array) -> Array:
        """Return the torque (..., nv) at t (), q (..., nq), v (..., nv)."""
        ...


@runtime_checkable
class StateLaw(Protocol):
    """Torque that depends on internal states, which advance with the simulation: deflections of
    bristles, play, temperatures."""

    def start(self, q: Array, v: Array) -> Array:
        """Return the states (s,) at the start, at q (nv,) and v (nv,)."""
        ...

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) over a step of h (s) from t (s) on, and the states (s,) after it.

        q and v (nv,) are positions and rates of hinges and slides, by degree of freedom; `load`
        (nv,) is the torque on the links, M a + bias without armature, at the step before.
        """
        ...


@dataclass(frozen=True, eq=False)
class LawStates:
    """Force laws with the present states of each, as a simulation advances them."""

    laws: tuple[Any, ...]
    states: tuple[Array, ...]

    def step(
        self, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, "LawStates"]:
        """Return the torque (nv,) of all laws over a step, and the laws after it."""
        total, states = np.zeros_like(v), []
        for law, state in zip(self.laws, self.states, strict=True):
            if isinstance(law, StateLaw):
                torque, state = law.step(state, h, t, q, v, load)
            else:
                torque = law(np.asarray(t), q, v)
            total = total + torque
            states.append(state)
        return total, LawStates(self.laws, tuple(states))


def start_states(laws: Sequence[Any], q: Array, v: Array) -> LawStates:
    """Return laws with their states at the start, at q (nv,) and v (nv,)."""
    states = [
        np.array(law.start(q, v), dtype=float) if isinstance(law, StateLaw) else np.zeros(0)
        for law in laws
    ]
    return LawStates(tuple(laws), tuple(states))


def _has_states(laws: Sequence[Any]) -> bool:
    """Return True if one of the laws has internal states."""
    return any(isinstance(law, StateLaw) for law in laws)


def law_values(laws: Sequence[Any], name: str, nv: int) -> Array:
    """Return the sum of the laws' internal springs ("stiffness", N m/rad or N/m) or dampers
    ("damping", N m s/rad or N s/m) of each degree of freedom (nv,)."""
    values = [np.asarray(getattr(law, name, np.zeros(nv))) for law in laws]
    return np.asarray(np.sum([np.zeros(nv), *values], axis=0))
