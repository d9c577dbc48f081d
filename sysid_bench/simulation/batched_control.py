"""Tracking control of many plants of a robot: in lanes where they are covered, else one by one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import EstimationError, SimulationError
from sysid_bench.simulation.plant import Plant, law_values
from sysid_bench.simulation.plant_batch import PlantBatch, check_plants, uncovered
from sysid_bench.simulation.tracking_control import TrackingControl, oracle_of
from sysid_bench.simulation.tracking_model import drive_of, tracking_model
from sysid_bench.types import Array, Controller, Oracle, Trajectory

CHUNK: Final = 16
"""Plants whose signals are in memory at a time: two groups of eight lanes."""

Outcome = Oracle | SimulationError | EstimationError
"""Signals of a plant, or why there are none."""


@dataclass(frozen=True, eq=False)
class BatchedControl:
    """The closed loop `control` with one controller for many plants of the robot of `plant`, which
    has the transmission and the time step of all."""

    control: TrackingControl
    plant: Plant
    controller: Controller

    @cached_property
    def mj(self) -> mujoco.MjModel:
        """Compiled model of `plant`."""
        return tracking_model(self.plant, self.controller, self.control.step_choice)

    @cached_property
    def uncovered(self) -> str:
        """The reason why MuJoCo simulates these plants one by one; empty where lanes.c does."""
        return uncovered(self.plant, self.mj)

    @property
    def simulator(self) -> str:
        """Simulator of the candidates: "lanes", or "mujoco" with the reason."""
        return f"mujoco: {self.uncovered}" if self.uncovered else "lanes"

    def follow(
        self,
        plants: Sequence[Plant],
        commanded: Trajectory,
        encoders: Sequence[Array] | Array | None,
    ) -> Iterator[Outcome]:
        """Simulate plants along a motion with their encoder errors (N, n), None: without; yield the
        outcome of each, in order. What it is does not depend on the other plants."""
        still = np.zeros((len(commanded), len(self.controller.kp)))
        for first in range(0, len(plants), CHUNK):
            part = plants[first : first + CHUNK]
            errors = [still] if encoders is None else encoders[first : first + CHUNK]
            if self._is_covered(part):
                yield from self._batch(part, commanded, errors)
                continue
            for k, plant in enumerate(part):
                encoder = errors[0] if encoders is None else errors[k]
                try:
                    yield self.control.follow(plant, self.controller, commanded, encoder)
                except (SimulationError, EstimationError) as error:
                    yield error

    def _is_covered(self, plants: Sequence[Plant]) -> bool:
        """True for plants in lanes: with the time step of the compiled model, and laws of the same
        kinds."""
        if self.uncovered or any(uncovered(plant, self.mj) for plant in plants):
            return False
        kinds = {tuple((law.kind, np.size(law.numbers)) for law in plant.laws) for plant in plants}
        # Internal springs may need more steps in one plant than in another.
        return len(kinds) == 1 and all(x is self.plant or not _has_springs(x) for x in plants)

    def _batch(
        self, plants: Sequence[Plant], commanded: Trajectory, encoders: Sequence[Array] | Array
    ) -> Iterator[Outcome]:
        """Outcomes of plants that are covered, of which the same encoder error or one each is
        given."""
        wrong = check_plants(self.mj, plants)
        able = [k for k, error in enumerate(wrong) if error is None]
        if able:
            own = able if len(encoders) > 1 else [0]
            driven = [
                self.control.inputs(self.plant, self.controller, commanded, encoders[k])
                for k in own
            ]
            whole, control = driven[0][0], np.array([u for _, u in driven])
            each = round((whole.t[1] - whole.t[0]) / self.mj.opt.timestep)
            drive = drive_of(self.plant, self.controller, self.control.step_choice, each)
            q, v = (np.tile(x[0], (len(able), 1)) for x in (whole.q, whole.v))
            signals = PlantBatch(
                self.mj, [plants[k] for k in able], drive, t=whole.t,
                control=control if len(control) == len(able) else control[0], q=q, v=v, each=each,
            ).run()  # fmt: skip
        for k, (plant, error) in enumerate(zip(plants, wrong, strict=True)):
            if error is not None:
                yield error
                continue
            try:
                found = signals.of_plant(able.index(k))
                yield oracle_of(plant, commanded, found, self.mj.opt.timestep)
            except SimulationError as diverged:
                yield diverged


def _has_springs(plant: Plant) -> bool:
    nv = plant.robot.nv
    return any(law_values(plant.laws, name, nv).any() for name in ("stiffness", "damping"))
