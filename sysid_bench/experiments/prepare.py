"""Preparation of one experiment: the only choice between simulated and recorded data."""

from typing import Any

from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.recorded.prepare import prepare_recorded
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.spec import ExperimentSpec


def prepare(spec: ExperimentSpec, loaded: LoadedRobot) -> ExperimentData[Any]:
    """The data, problem and scoring of a specification.

    Raises UnsupportedError or UsageError where there is no such experiment, with the reason.
    """
    run = prepare_simulated if spec.log is None else prepare_recorded
    return run(spec, loaded)
