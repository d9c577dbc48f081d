"""What is asked of some logs: which parameters are unknown, and which rows were measured."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from sysid_bench.experiments.recorded.extra_columns import ExtraColumns
from sysid_bench.identifiability.base_map import base_map
from sysid_bench.identifiability.structural import structural_factor
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.qr_accumulation import upper_factor
from sysid_bench.tasks.task import unknown_bodies
from sysid_bench.types import Array, BaseMap, Body, Trajectory

MASS: Final = "payload.m"
"""The load's mass where it is its only unknown."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What is unknown: `inertial` parameters of the robot and its joint `terms`, those of the load
    where `loaded` carries an unknown one, and `extra` columns of `features`; `rows`: the joints
    that were recorded."""

    robot: RobotModel
    loaded: RobotModel | None
    inertial: tuple[str, ...]
    terms: tuple[str, ...]
    rows: tuple[str, ...]
    features: ExtraColumns | None = None
    motor_words: tuple[str, ...] = ()  # terms of motors that were asked for, not chosen
    extra: tuple[str, ...] = ()
    given: bool = False  # the load's shape is, and its mass one of the extra columns

    def rows_of(self, name: str) -> tuple[str, ...]:
        """The recorded joints that a term or feature is chosen for."""
        if self.features is not None and name in self.extra:
            return self.features.rows_of(name)
        return (name.partition(".")[0],)

    @property
    def robot_parameters(self) -> tuple[str, ...]:
        """Parameters of the robot itself."""
        return self.inertial + self.terms

    @property
    def payload_parameters(self) -> tuple[str, ...]:
        """Names of the load's ten parameters, or none."""
        if self.loaded is None or self.loaded.payload_body is None or self.given:
            return ()
        return self.loaded.bodies[self.loaded.payload_body].columns

    @property
    def motor_terms(self) -> tuple[str, ...]:
        """Terms of motors, linear in the state as those of joints are: they join the base."""
        known = () if self.features is None else self.features.motor_terms
        return tuple(name for name in self.extra if name in known)

    @property
    def extra_parameters(self) -> tuple[str, ...]:
        """Features, and a mass: they stand for themselves."""
        return tuple(name for name in self.extra if name not in self.motor_terms)

    @property
    def parameters(self) -> tuple[str, ...]:
        """All unknowns (p,)."""
        return (
            self.robot_parameters
            + self.payload_parameters
            + self.motor_terms
            + self.extra_parameters
        )

    def base(self) -> BaseMap:
        """The base parameters."""
        base = base_map(
            self.structural_factor(),
            self.robot_parameters + self.payload_parameters + self.motor_terms,
        )
        if not self.extra_parameters:
            return base
        r, p, k = base.rank, len(base.parameters), len(self.extra_parameters)
        K = np.zeros((r + k, p + k))
        K[:r, :p], K[r:, p:] = base.K, np.eye(k)
        return replace(
            base, row_space=None, K=K, pivots=np.append(base.pivots, np.arange(p, p + k)),
            parameters=self.parameters,
        )  # fmt: skip

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies whose ten numbers are unknown."""
        if self.loaded is None or self.loaded.payload_body is None or self.given:
            return unknown_bodies(self.robot)
        return (*unknown_bodies(self.robot), self.loaded.bodies[self.loaded.payload_body])

    def structural_factor(self) -> Array:
        """R (m, p) over random states with and, where there is one, without the load."""
        own, load, m = self.robot_parameters, self.payload_parameters, len(self.robot_parameters)
        bare = structural_factor(self.robot, own, self.rows, beside=self._motor_terms(self.robot))
        if self.loaded is None:
            return bare
        beside = self._motor_terms(self.loaded)
        carried = structural_factor(self.loaded, own + load, self.rows, beside=beside)
        nothing = np.zeros((len(bare), len(load)))
        return upper_factor([np.hstack([bare[:, :m], nothing, bare[:, m:]]), carried])

    def _motor_terms(self, robot: RobotModel) -> Callable[[Trajectory], Array] | None:
        if not self.motor_terms or self.features is None:
            return None
        return partial(self.features.on_rows, robot, self.rows, self.motor_terms)
