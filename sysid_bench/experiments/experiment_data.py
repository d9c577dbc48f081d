"""Outcome of the pipeline, simulated or recorded: the data of methods, and how they are scored."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

from sysid_bench.evaluation.baselines import Baselines, baselines
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Estimate, Experiment, Problem, Row
from sysid_bench.words import FRAME_DEPENDENT


class Source(Protocol):
    """Origin of the data of an experiment, which estimates are compared with: the ground truth of a
    simulation, or the measured torque of recordings."""

    @property
    def warning(self) -> str:
        """Unexcited directions of the data, for the reason of a failure; empty where unknown."""

    def figures(self, problem: Problem, held_out: Mapping[str, Problem]) -> dict[str, Any]:
        """Rank and conditioning of the data, as fields of Score."""

    def fields(self) -> Row:
        """Further fields of a row that depend on the data alone."""

    def score(self, prepared: "ExperimentData[Any]", method: Any, estimate: Estimate) -> Row:
        """Scores of an estimate of `method`, and its `parameters_table`."""


S_co = TypeVar("S_co", bound=Source, covariant=True)


@dataclass(frozen=True, eq=False)
class ExperimentData(Generic[S_co]):
    """One experiment, ready for its estimators.

    Methods get `problem` and `experiment`. `held_out` (other motions with exact signals, or test
    logs), `held_out_moving` (the same without rows at standstill), `floor` (error of the training
    torque itself, where a test repeats the motion) and `source` are for scoring alone.
    """

    robot: RobotModel
    problem: Problem
    experiment: Experiment
    held_out: Mapping[str, Problem]
    source: S_co
    held_out_moving: Mapping[str, Problem] = field(default_factory=dict)
    floor: float | None = None

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Rank and conditioning of the data: the same for all estimators."""
        return self.source.figures(self.problem, self.held_out)

    @cached_property
    def fields(self) -> Row:
        """Fields of a row that all estimators share, failed ones included."""
        return {**self.figures, **self.source.fields(), **self.baselines.fields}

    @cached_property
    def baselines(self) -> Baselines:
        """Baselines that an answer has to beat."""
        return baselines(self.problem, self.held_out, self.floor)

    def score(self, method: Any, estimate: Estimate) -> Row:
        """Fields of a row that depend on the estimate, and its `parameters_table`."""
        scores = self.source.score(self, method, estimate)
        error = scores.get("torque_error")
        beaten = ", ".join(self.baselines.beaten_by(error))
        declared = getattr(method, FRAME_DEPENDENT, "")
        if declared:
            scores = {FRAME_DEPENDENT: declared, **scores}
        # A source may judge otherwise.
        return {"beaten_by": beaten, "gap_closed": self.baselines.gap_closed(error), **scores}
