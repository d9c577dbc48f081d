"""Simulator of the methods that simulate: time step, integrator and friction of their models."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.simulation.effects.stribeck import StribeckLaw
from sysid_bench.simulation.plant import Plant
from sysid_bench.simulation.tracking_control import TrackingControl

SMOOTHING: Final = 0.01
"""v0 (rad/s, m/s) of smooth Coulomb friction tanh(v / v0)."""


@dataclass(frozen=True)
class Candidate:
    """Simulator of candidate models: `step` (s; None: the control period), `integrator`, and
    Coulomb `friction` that sticks ("sticking") or "smooth" friction tanh(v / v0).

    It is declared apart from that of the plant: where both are equal, methods that simulate are
    given the very process that made the data (inverse crime).
    """

    step: float | None = None
    integrator: str = "auto"
    friction: str = "sticking"

    def control(self, rate: float) -> TrackingControl:
        """Return the closed loop of a controller at `rate` (Hz).

        Raises UsageError for a step that does not divide the control period.
        """
        ratio = 1.0 if self.step is None else 1.0 / (rate * self.step)
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise UsageError(
                f"The step of the candidate, {self.step} s, does not divide the control period "
                f"of {1 / rate:g} s."
            )
        return TrackingControl(rate=rate, substeps=round(ratio), integrator=self.integrator)

    def plant(self, plant: Plant) -> Plant:
        """Return a candidate model with this kind of Coulomb friction."""
        if self.friction == "sticking" or not plant.terms.coulomb.any():
            return plant
        coulomb = plant.terms.coulomb
        same = np.full(len(coulomb), np.inf), np.full(len(coulomb), SMOOTHING)
        law = StribeckLaw(np.concatenate([coulomb, *same]))
        terms = replace(plant.terms, coulomb=np.zeros_like(coulomb))
        return replace(plant, terms=terms, laws=(law, *plant.laws))

    def has_steps_of(self, simulation: TrackingControl, step: float) -> bool:
        """Return True where a plant with the time step `step` (s) under `simulation` may have the
        integrator of the candidate, and has its step."""
        own = self.control(simulation.rate)
        names = {own.integrator, simulation.integrator}
        one_step = abs(step * own.substeps * own.rate - 1.0) < 1e-6
        return one_step and (len(names) == 1 or "auto" in names)
