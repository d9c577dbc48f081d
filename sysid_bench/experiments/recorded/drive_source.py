"""Recordings of position-commanded robots as a source: torque errors, and rollouts of estimates."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import SIGNED
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS
from sysid_bench.apps.actuators.rollout import Drives, missing_simulation, rollout_error
from sysid_bench.errors import SimulationError, first_names
from sysid_bench.evaluation.score import base_parameters, data_figures, score_recorded
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.drive_part import DrivePart
from sysid_bench.experiments.recorded.published_drives import PublishedDrives
from sysid_bench.types import Array, Estimate, Problem, Row
from sysid_bench.words import AT_BOUND

DELAYS: Final = 1e-3 * np.arange(0.0, 21.0, 2.5)
"""s, of values that were published without one in seconds: the best on the judged samples."""

NEAR: Final = 1e-3
"""Share of the largest value of all joints within which one is on its bound of zero."""


@dataclass(frozen=True, eq=False)
class DriveSource:
    """Recordings of a robot with known links: `found` are the actuators of the training, whose
    delay the estimators are given. The values of an estimator that uses no data have the delay of
    DELAYS that fits the judged samples best, and the better sign of the bias of `published`
    ones."""

    training: Sequence[DrivePart]
    tests: Mapping[str, DrivePart]
    found: DriveEstimate
    published: PublishedDrives | None = None

    @property
    def warning(self) -> str:
        """Empty: recordings have no structure to compare their excitation with."""
        return ""

    def figures(self, problem: Problem, held_out: Mapping[str, Problem]) -> dict[str, Any]:
        """Rank and conditioning of the training data."""
        return data_figures(problem, {})

    def fields(self) -> Row:
        """Delay of the training with what it leaves open, and findings, as the field `log`."""
        apart, profile = self.found.separation, self.found.profile
        low, high = (self.found.delay,) * 2 if profile is None else profile.interval
        return {
            "log": {
                "delay": self.found.delay,
                "delay_low": low,
                "delay_high": high,
                "delay_open": None if apart is None or apart.is_static else apart.open,
                "findings": "; ".join(dict.fromkeys(self._findings())),
            }
        }

    def _findings(self) -> Iterator[str]:
        for part in (*self.training, *self.tests.values()):
            for finding in part.log.findings:
                yield f"{part.name}: {finding.text}"

    def score(
        self, prepared: ExperimentData["DriveSource"], method: Any, estimate: Estimate
    ) -> Row:
        """Torque errors, the error of the simulated positions of the tests, and all values."""
        scores = score_recorded(estimate, prepared.problem, prepared.held_out, prepared.figures)
        beta = base_parameters(estimate)
        if beta is None:
            return vars(scores)
        values = beta.reshape(-1, len(UNKNOWNS))
        scores = replace(scores, rollout_error=self._rollout(method, values))
        return vars(scores) | {"parameters_table": self._table(values)}

    def _rollout(self, method: Any, values: Array) -> float | None:
        """RMS error (rad, m) of the simulated positions of all tests; None of measured torques and
        of robots that are not simulated."""
        tests = [part for part in self.tests.values() if part.log.commands is not None]
        if not tests or missing_simulation(tests[0].robot):
            return None
        joints = self.found.rows.joints
        if getattr(method, "uses_data", True):
            return _error_of_fit(tests, Drives(joints, values, self.found.delay))
        errors = (_error_or_none(tests, drives) for drives in self._published_drives(values))
        return min((error for error in errors if error is not None), default=None)

    def _published_drives(self, values: Array) -> Iterator[Drives]:
        """Yield drives with published values: those state neither delay nor the sign of bias."""
        joints = self.found.rows.joints
        bias = np.zeros(len(joints)) if self.published is None else self.published.bias
        for sign in (-1.0, 1.0) if bias.any() else (1.0,):
            for delay in DELAYS:
                yield Drives(joints, values, float(delay), {"bias": sign * bias})

    def _table(self, values: Array) -> list[Row]:
        """The values of all joints, and which are on their bound of zero."""
        at_bound = values[:, :SIGNED] <= NEAR * values[:, :SIGNED].max(axis=0)
        return [
            {
                "body": joint,
                "name": term,
                "true": None,
                "estimate": float(values[j, i]),
                "std": None,
                "identifiable": AT_BOUND if i < SIGNED and at_bound[j, i] else "identifiable",
                "expression": f"{joint}.{term}",
            }
            for j, joint in enumerate(self.found.rows.joints)
            for i, term in enumerate(UNKNOWNS)
        ]


def _error(tests: Sequence[DrivePart], drives: Drives) -> float:
    squares = [
        rollout_error(part.robot, drives, part.log.commands.of(drives.joints), part.rows) ** 2
        for part in tests
        if part.log.commands is not None
    ]
    return float(np.sqrt(np.mean(squares)))


def _error_of_fit(tests: Sequence[DrivePart], drives: Drives) -> float:
    """Raise SimulationError, with the values that no actuator has, where the robot diverges."""
    try:
        return _error(tests, drives)
    except SimulationError as error:
        wrong = np.argwhere(drives.values[:, :SIGNED] < 0.0)
        names = [f"{drives.joints[j]}.{UNKNOWNS[i]}" for j, i in wrong]
        reason = f"; negative are {first_names(names)}" if names else ""
        raise SimulationError(f"The simulation with these values diverges{reason}.") from error


def _error_or_none(tests: Sequence[DrivePart], drives: Drives) -> float | None:
    """None where the robot diverges."""
    try:
        return _error(tests, drives)
    except SimulationError:
        return None
