"""CPU seconds that a run is expected to take, from a table of one core of 2025."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from sysid_bench.errors import SysidBenchError
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.units import quantity

START: Final = 11.0
"""Start of the processes, tables, figures and report."""
ROBOT: Final = 0.2
"""Loading and cross-check of a robot with a payload."""
_EXPERIMENT: Final = 0.035
_SAMPLE: Final = 1e-5  # regressor and reduction of one sample of a motion
_STEP: Final = 3e-6  # of a simulation in closed loop
_LOG: Final = 1.8  # recordings of an experiment: reading, checks, filters
_ESTIMATOR: Final = 0.01
_BUDGET: Final = 0.7
"""Share of a budget of CPU time that methods take: some stop before."""
_METHODS: Final[Mapping[str, float]] = {
    "ml": 0.7, "log-cholesky": 0.06, "reconstruction": 0.02, "ar-gls": 0.05, "iv": 0.15,
    "didim": 0.4, "didim-guarded": 0.5, "cloe": 5.0, "clie": 3.0, "ekf": 1.2, "ukf": 1.2,
    "rollout": 1.7,
}  # fmt: skip
"""Methods that take more than `_ESTIMATOR`: those that simulate or iterate over all samples."""


@dataclass(frozen=True)
class CellCost:
    """Expected CPU seconds of an experiment, shared by its cells, and of an estimator on it."""

    experiment: float
    estimator: float


def cell_cost(spec: ExperimentSpec, estimator: Mapping[str, Any]) -> CellCost:
    """Return the cost of a cell from the table."""
    return CellCost(_experiment(spec), _estimator(estimator))


def _experiment(spec: ExperimentSpec) -> float:
    if spec.log is not None:
        return _LOG
    period = _number(spec.excitation.get("period"), "s", 5.0)
    cycles = _number(spec.excitation.get("cycles"), "1", 2.0)
    seconds = period * cycles * (spec.motions + len(spec.held_out))
    steps = 0.0
    if spec.simulation["use"] == "closed-loop":
        rate = _number(spec.simulation.get("rate"), "Hz", 1000.0)
        steps = seconds * rate * _number(spec.simulation.get("substeps"), "1", 4.0)
    return _EXPERIMENT + _SAMPLE * seconds * spec.rate + _STEP * steps


def _estimator(estimator: Mapping[str, Any]) -> float:
    table = _METHODS.get(str(estimator["use"]), _ESTIMATOR)
    budget = _number(estimator.get("budget"), "s", 0.0)
    return _BUDGET * budget if budget else table


def _number(written: Any, unit: str, default: float) -> float:
    try:
        return quantity(written, unit)
    except (SysidBenchError, TypeError):  # a plug-in may use this key for something else
        return default


def run_cost(parts: Iterable[float], robots: int) -> float:
    """Return the cost of a whole run of some robots with payloads from those of its parts."""
    return START + ROBOT * robots + sum(parts)
