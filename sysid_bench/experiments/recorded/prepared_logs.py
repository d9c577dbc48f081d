"""One problem of all training logs, and one of each test log. Nothing here knows a truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.experiments.recorded.extra_columns import extra_columns, is_motor
from sysid_bench.experiments.recorded.preprocess import Preprocessing, ProcessedLog
from sysid_bench.experiments.recorded.problem import (
    LogProblemBuilder,
    fold_factors,
    merge_factors,
    regressor_blocks,
)
from sysid_bench.experiments.recorded.term_selection import FOLDS, TermSelection, select_terms
from sysid_bench.experiments.recorded.unknowns import MASS, Unknowns
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.tasks.task import named_task, unknown_bodies
from sysid_bench.types import Experiment, Problem


@dataclass(frozen=True, eq=False)
class PreparedLogs:
    """All that methods and scores need of some logs."""

    robot: RobotModel
    problem: Problem
    tests: dict[str, Problem]
    experiment: Experiment
    builder: LogProblemBuilder
    training: tuple[ProcessedLog, ...]
    testing: dict[str, ProcessedLog]
    terms: tuple[str, ...]
    selection: TermSelection | None = None


def build_problems(
    task: str,
    terms: tuple[str, ...],
    training: Sequence[ProcessedLog],
    tests: Mapping[str, ProcessedLog],
    treatment: Preprocessing,
    candidates: tuple[str, ...] = (),
    position_given: bool = False,
) -> PreparedLogs:
    """The problem of all training logs together, and one of each test log.

    `robot`: links and terms, with the payloads that the logs state taken as known. `payload`: the
    same and ten more of the load that some logs state and others do not carry. `terms`: joint
    terms, and those of motors ("motor.armature"). `candidates`: more of them, and features by name
    ("play", "motor.play"), of which cross-validation inside of the training logs chooses.
    `position_given`: of the load the mass alone is unknown, what the logs say of its centre of mass
    (and of its inertia per mass) is taken as known.
    """
    ask = _question(task, terms, training, position_given)
    selection = None
    if candidates:
        ask, selection = select_terms(ask, candidates, training, treatment)
    base = ask.base()
    posing = LogProblemBuilder(ask, base.names, treatment)
    problem = posing.build(training, base)
    experiment = Experiment(
        problem,
        training[0].recording,
        training[0].log.recording,
        partial(regressor_blocks, posing),
        _no_simulation,
        _no_simulation,
    )
    posed = {name: posing.build([test], base) for name, test in tests.items()}
    return PreparedLogs(
        ask.robot,
        problem,
        posed,
        experiment,
        posing,
        tuple(training),
        dict(tests),
        terms,
        selection,
    )


def leave_one_fold_out(posed: PreparedLogs, count: int = FOLDS) -> list[Problem]:
    """The training problem again and again, each time without one part of every motion: what
    estimates differ by when other stretches had been recorded."""
    every = fold_factors(posed.builder, posed.training, count)
    return [
        replace(
            posed.problem,
            factors=tuple(
                merge_factors([own for f in range(count) if f != part for own in every[f][k]])
                for k in range(len(posed.problem.rows))
            ),
        )
        for part in range(count)
    ]


def _question(
    task: str, terms: tuple[str, ...], training: Sequence[ProcessedLog], position_given: bool
) -> Unknowns:
    definition = named_task(task)
    if not definition.supports_recordings:
        raise UnsupportedError(
            f"The task {task!r} needs a robot that is known; with recordings there are 'robot' and "
            "'payload'."
        )
    if position_given and not definition.identifies_payload:
        raise UsageError("A given position is one of the task 'payload'.")
    unloaded = next((p.robot for p in training if not p.payload), None)
    loaded = next((p.robot for p in training if p.payload), None)
    if definition.identifies_payload and (unloaded is None or loaded is None):
        raise UsageError(
            "The task 'payload' compares recordings with and without the load: give one --log of "
            "each, and the loaded one a payload."
        )
    robot = load_robot(training[0].robot.manifest) if unloaded is None else unloaded
    bodies = tuple(column for body in unknown_bodies(robot) for column in body.columns)
    rows = training[0].log.joints
    words = tuple(term for term in terms if is_motor(term))
    own = extra_columns(robot, rows, words, training) if words else None
    more = () if own is None or own.motors is None else own.motors.columns
    return Unknowns(
        robot,
        loaded if definition.identifies_payload else None,
        bodies,
        robot.term_columns(tuple(term for term in terms if not is_motor(term))),
        rows,
        features=own,
        motor_words=words,
        extra=(*((MASS,) if position_given else ()), *more),
        given=position_given,
    )


def _no_simulation(asked: Any) -> Any:
    raise UnsupportedError("This recording declares no controller: nothing to simulate with.")
