"""What the columns of a row mean: title, unit, digits. Units as people write them, SI."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final


@dataclass(frozen=True)
class Metric:
    """A column of the cells. `unit` may hold alternatives ("N m|N": rotary|linear);
    `digits` are significant ones, 0 for whole numbers; sizes below `floor` are rounding, and none
    of them is better than another."""

    name: str
    title: str
    unit: str = ""
    digits: int = 3
    floor: float = 0.0
    words: bool = False  # texts, of which there is no statistic
    repeated: bool = False  # of all repeats together: a statistic itself

    @property
    def units(self) -> tuple[str, ...]:
        """The alternatives of the unit; empty for a pure number."""
        return tuple(self.unit.split("|")) if self.unit else ()

    @property
    def heading(self) -> str:
        """Title and unit in plain text, "Held-out RMSE (N·m, N)"."""
        units = ", ".join(unit.replace(" ", "·") for unit in self.units)
        return f"{self.title} ({units})" if units else self.title


_TORQUE = "N m|N"
_ROUNDING: Final = 1e-12
_BOUND: Final = "Cramér-Rao bound of torque noise alone"
_ALL: Final = (
    Metric("rmse_train", "Training RMSE", _TORQUE),
    Metric("rmse_test", "Held-out RMSE", _TORQUE),
    Metric("torque_error", "Relative held-out torque error", floor=_ROUNDING),
    Metric("torque_error_sample", "Held-out torque error per sample", floor=_ROUNDING),
    Metric("torque_error_worst", "Held-out torque error of the worst joint", floor=_ROUNDING),
    Metric("rank", "Base parameters", digits=0),
    Metric("data_rank", "Excited base parameters", digits=0),
    Metric("parameters", "Parameters", digits=0),
    Metric("rank_gap", "Rank gap"),
    Metric("near_degenerate", "Nearly dependent directions", digits=0),
    Metric("condition", "Condition number (SI columns)"),
    Metric("condition_unit", "Condition number (unit columns)"),
    Metric("d_optimality", "Log-determinant of information"),
    Metric("parameter_error", "Relative parameter error in torque", floor=_ROUNDING),
    Metric("beta_error", "Relative base-parameter error", floor=_ROUNDING),
    Metric("payload_error", "Relative payload error", floor=_ROUNDING),
    Metric("mass_error", "Mass error", "kg", floor=_ROUNDING),
    Metric("mass", "Mass", "kg"),
    Metric("mass_low", "Mass, lower end of the 95 % interval", "kg"),
    Metric("mass_high", "Mass, upper end of the 95 % interval", "kg"),
    Metric("com_error", "Error of the centre of mass", "m", floor=_ROUNDING),
    Metric("inertia_error", "Relative error of the inertia", floor=_ROUNDING),
    Metric("structural_rank", "Base parameters of the sub-tree", digits=0),
    Metric("excited_rank", "Excited base parameters of the sub-tree", digits=0),
    Metric("left_out", "Share of samples taken for contacts"),
    Metric("unpredictable", "Joints whose torque cannot be foretold", digits=0),
    Metric("sensed_torque_ratio", "Torque error with sensor / that of true parameters", digits=4),
    Metric("sensed_wrench_ratio", "Touch error with sensor / that of true parameters", digits=4),
    Metric("sensed_cad_ratio", "Torque error with sensor, CAD / identified"),
    Metric("alone_cad_ratio", "Torque error of parameters alone, identified / CAD"),
    Metric("feasible", "Share of feasible estimates"),
    Metric("plausible", "Share of plausible estimates"),
    Metric("min_eigenvalue", "Smallest pseudo-inertia eigenvalue"),
    Metric("coverage", "Share of 95 % intervals that hold the truth"),
    Metric("bias", "Mean error in standard deviations of an estimate", repeated=True),
    Metric("spread", f"Scatter over the {_BOUND}", repeated=True),
    Metric("efficiency", f"Efficiency against the {_BOUND}", repeated=True),
    Metric("bound_ratio", f"RMS error over the {_BOUND}", repeated=True),
    Metric("verdict", "Verdict on each parameter", words=True),
    Metric("joint_rms", "RMS torque of the joint", _TORQUE),
    Metric("joint_rmse", "Held-out RMSE of the joint", _TORQUE),
    Metric("joint_error", "Relative held-out error of the joint", floor=_ROUNDING),
    Metric("joint_replayed", "Relative error of the training torque, played again"),
    Metric("joint_rmse_train", "Training RMSE of the joint", _TORQUE),
    Metric("joint_error_train", "Relative training error of the joint", floor=_ROUNDING),
    Metric("seconds", "Time", "s"),
    Metric("seconds_experiment", "Time to read, filter and reduce the data", "s"),
    Metric("gap", "Regressor gap to Pinocchio"),
    Metric("closure", "Torque closure with MuJoCo"),
    Metric("native_gap", "Regressor gap to Pinocchio's own parser"),
)
METRICS: Final[Mapping[str, Metric]] = MappingProxyType({metric.name: metric for metric in _ALL})


def metric_of(name: str) -> Metric:
    """The metric of a column; a column that is not described here keeps its name as title."""
    return METRICS.get(name, Metric(name, name))
