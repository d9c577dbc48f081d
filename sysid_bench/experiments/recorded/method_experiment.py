"""What methods that simulate or model the noise are given of a recording."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError, first_names
from sysid_bench.experiments.recorded.problem import LogProblemBuilder, regressor_blocks
from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.experiments.recorded.unknowns import Unknowns
from sysid_bench.experiments.simulated.estimator_model import SimulatedModel
from sysid_bench.models.robot import SUFFIX
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.signals.row_processing import MOVING
from sysid_bench.simulation.candidate import Candidate, KnownModel, kinematics_of
from sysid_bench.types import Array, Experiment, Problem, Recording, Trajectory


def recorded_experiment(
    problem: Problem, builder: LogProblemBuilder, first: ProcessedLog
) -> Experiment:
    """The problem, and the functions that methods may call: the regressor, the known torque, and
    the closed loop where the log declares its controller."""
    return Experiment(
        problem=problem,
        recording=first.recording,
        raw=first.log.recording,
        regress=partial(regressor_blocks, builder),
        simulate=_closed_loop(builder.unknowns, first),
        known=partial(_known_torque, builder, first),
        filter_rows=builder.rows_along(first).processed,
        moving=builder.rows_along(replace(first, rows=MOVING)).weights > 0.0,
    )


def _known_torque(builder: LogProblemBuilder, first: ProcessedLog, motion: Trajectory) -> Array:
    """Torque (n, rows) of the payload of the first log along a motion, where it is known."""
    load, unknowns = first.robot.payload_body, builder.unknowns
    if load is None or unknowns.loaded is not None:
        return np.zeros((len(motion), len(unknowns.rows)))
    instruments = unknowns.instruments(first.robot)
    columns = first.robot.bodies[load].columns
    regression = torque_regression(first.robot, columns, instruments)
    at = [regression.rows.index(row) for row in unknowns.rows]
    whole = instruments.motion(motion)
    return np.asarray(regression.torque(whole, first.robot.phi[load])[:, at])


def _closed_loop(unknowns: Unknowns, first: ProcessedLog) -> Callable[[Any], Recording]:
    """The closed loop along the commanded motion of a log, as a function of theta (p,)."""
    if first.log.recording.controller is not None and unknowns.extra:
        return partial(_refuse, unknowns.extra)
    return SimulatedModel(_known_model(unknowns, first), first.log.recording, Candidate())


def _refuse(features: tuple[str, ...], *_: Any) -> Recording:
    """Raise UnsupportedError: simulated joints have the terms in SUFFIX alone."""
    raise UnsupportedError(
        f"The closed loop cannot be simulated with {first_names(features)}: give --terms of joints "
        f"alone ({', '.join(SUFFIX)})."
    )


def _known_model(unknowns: Unknowns, first: ProcessedLog) -> KnownModel:
    """The kinematics of a log's robot, and its payload where that is known."""
    robot = first.robot
    given = np.zeros_like(robot.phi)
    if robot.payload_body is not None and unknowns.loaded is None:
        given[robot.payload_body] = robot.phi[robot.payload_body]
    return KnownModel(
        kinematics_of(robot),
        unknowns.parameters,
        unknowns.bodies,
        robot.tree.link_parameters(given),
        {},
        np.zeros((robot.nv, robot.nv)),
    )
