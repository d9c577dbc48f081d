"""Baselines of an answer: predictions of the test without an identification.

The null model takes the bodies as the model file has them (of a simulated robot: as its prior) and
fits joint terms alone; trivial are zero torque and the mean torque of the training. Floors are what
no answer can be better than: the same model fitted to the tests themselves, and hardly any model of
the state: the training torque itself, played again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from sysid_bench.evaluation.torque_errors import (
    RowErrors,
    least_torque_error,
    mean_torque_error,
)
from sysid_bench.identification.estimators.bayesian import FileFriction, body_columns, file_values
from sysid_bench.identification.identify import identify
from sysid_bench.types import Array, Problem

ZERO_TORQUE: Final = 1.0
"""Torque error of an answer that predicts no torque at all."""

TIE: Final = 1.05
"""Ratio of errors up to which an answer is as good as a baseline: errors of one answer on two test
motions differ by as much (measured on a UR10e)."""

ROUNDING: Final = 1e-9
"""Torque error that is rounding: the prior may be the exact truth."""

FILE, FILE_FRICTION, ZERO, MEAN = "file", "file-friction", "zero-torque", "mean-torque"
COMMAND: Final = "position-command"
"""Baselines by name; `file`: values of the model file as they are, where joint terms alone or no
joint terms are unknown."""

WORDS: Final[Mapping[str, str]] = {
    FILE: "the values of the model file",
    FILE_FRICTION: "the model file with fitted friction",
    ZERO: "zero torque",
    MEAN: "the mean torque of the training",
    COMMAND: "the commanded positions themselves",
}


@dataclass(frozen=True)
class Baselines:
    """Errors of predictions on the tests by name, the null model first, that of the repeated motion
    (`floor`) and of the model fitted to the tests (`best`); as `torque_error`, or of positions
    (rad, m)."""

    errors: Mapping[str, float] = field(default_factory=dict)
    floor: float | None = None
    best: float | None = None

    @property
    def null(self) -> float | None:
        """Error of the null model."""
        return self.errors.get(FILE_FRICTION, self.errors.get(FILE))

    @property
    def fields(self) -> dict[str, Any]:
        """Fields of a row."""
        return {
            "torque_error_null": self.null,
            "torque_error_mean": self.errors.get(MEAN),
            "torque_error_floor": self.floor,
            "torque_error_best": self.best,
        }

    def gap_closed(self, error: float | None) -> float | None:
        """Return the share of the way from the null model to the lower floor that an error has
        gone, negative for one above the null model; None where no floor is below it."""
        floors = [floor for floor in (self.floor, self.best) if floor is not None]
        if error is None or self.null is None or not floors:
            return None
        # Errors of rounding size are equal.
        way = self.null - min(floors)
        return (self.null - error) / way if way > max(ROUNDING, 1e-6 * self.null) else None

    def text(self, names: Sequence[str]) -> str:
        """Return some of them in words, with their errors."""
        return " and ".join(f"{WORDS[name]} ({self.errors[name]:.4g})" for name in names)

    def beaten_by(self, error: float | None) -> list[str]:
        """Return the names of the baselines with a smaller error, the null model first."""
        if error is None:
            return []
        return [name for name, one in self.errors.items() if error > max(TIE * one, ROUNDING)]


def baselines(
    problem: Problem, tests: Mapping[str, Problem], floor: float | None = None
) -> Baselines:
    """Return the baselines of a problem on its tests; `floor`: error of the repeated motion."""
    judged = list(tests.values())
    if not judged:
        return Baselines()
    theta, name = _null_model(problem)
    null = None if theta is None else RowErrors(judged, problem.base.K @ theta).torque_error
    errors = {name: null, MEAN: mean_torque_error(problem, judged), ZERO: ZERO_TORQUE}
    known = {key: x for key, x in errors.items() if x is not None}
    return Baselines(known, floor, least_torque_error(judged))


def _null_model(problem: Problem) -> tuple[Array | None, str]:
    """theta (p,) of the null model, None where nothing is known beforehand, and its name."""
    if problem.file is None and problem.prior is None:
        return None, FILE
    is_body = body_columns(problem)
    if is_body.all() or not is_body.any():
        return file_values(problem), FILE
    return identify(FileFriction(), problem).theta, FILE_FRICTION
