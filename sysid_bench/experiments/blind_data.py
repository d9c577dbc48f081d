"""Data of a method as bytes: what it may know of an experiment, and nothing behind it.

Third-party methods run in a process that never held the ground truth. It gets the fields of
`Problem` and `Experiment` with all that their functions are made of: recordings, regressor, prior,
nominal model. Types that are not listed here, among them all with a truth, cannot be written.
"""

import io
import pickle
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.candidate import kinematics_of
from sysid_bench.types import Experiment, Oracle, Problem, Truth

PACKAGES: Final = (
    "errors", "types", "spatial", "numerics", "models", "regressors", "signals", "simulation",
    "identifiability", "experiments.processed_rows", "experiments.recorded",
    "experiments.simulated.problem",
)  # fmt: skip
"""Packages and modules whose types and functions methods may be given."""

SECRET: Final = (Oracle, Truth)
"""Types of them that are for scoring alone."""


class SecretError(TypeError):
    """An object that methods may not have is within reach of their data: an error of this
    package."""


def method_data(problem: Problem, experiment: Experiment | None, *, simulated: bool) -> bytes:
    """Return (problem, experiment) as bytes; `simulated`: no robot among them may have inertial
    parameters, since those of its file are near the truth, or are the truth.

    Raises SecretError where an object is in reach that methods may not have.
    """
    stream = io.BytesIO()
    _Writer(stream, simulated).dump((problem, experiment))
    return stream.getvalue()


def read_method_data(data: bytes) -> tuple[Problem, Experiment | None]:
    """Return (problem, experiment) of `method_data`; their arrays are read-only."""
    problem, experiment = pickle.loads(data)
    return problem, experiment


class _Writer(pickle.Pickler):
    def __init__(self, stream: io.BytesIO, simulated: bool) -> None:
        super().__init__(stream, protocol=pickle.HIGHEST_PROTOCOL)
        self._simulated = simulated

    def reducer_override(self, value: Any) -> Any:
        """Write fields of frozen types alone: what they have cached may lead anywhere."""
        kind = value if isinstance(value, type) else type(value)
        module, _, path = kind.__module__.partition(".")
        if module != "sysid_bench":
            return NotImplemented
        is_known = any(path == name or path.startswith(f"{name}.") for name in PACKAGES)
        if not is_known or issubclass(kind, SECRET):
            raise SecretError(f"A method's data lead to {kind.__module__}.{kind.__qualname__}.")
        if isinstance(value, type) or not is_dataclass(value):
            return NotImplemented
        given = {field.name: getattr(value, field.name) for field in fields(value)}
        if isinstance(value, RobotModel):
            if self._simulated and value.phi.any():
                raise SecretError(f"A method's data lead to the inertias of {value.name}.")
            bare = kinematics_of(value)
            # The compiled specification is made again from the compiled model.
            given |= {"mj": bare.mj, "manifest": bare.manifest, "text": b"", "spec": None}
            return _read_robot, (given,)
        return _read_fields, (kind, given)


def _read_fields(kind: type, given: Mapping[str, Any]) -> Any:
    value: Any = object.__new__(kind)
    for name, field in given.items():
        if isinstance(field, np.ndarray):
            field.flags.writeable = False
        object.__setattr__(value, name, field)
    return value


def _read_robot(given: Mapping[str, Any]) -> RobotModel:
    robot = RobotModel(**{**given, "spec": mujoco.MjSpec()})
    return robot if robot.phi.any() else replace(robot, spec=kinematics_of(robot).spec)
