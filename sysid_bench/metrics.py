"""All metrics of a row, one record each: fields, tables, rankings, reports and axes follow from it.

A new column is one record with `compute` here, or a plug-in that a suite names in [[metric]].
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.types import Better, Level, Metric, MetricInput, Row
from sysid_bench.words import CELL_FIELDS, FRAME_DEPENDENT, MACHINE_FIELDS

_TORQUE: Final = "N m|N"
_ROUNDING: Final = 1e-12
_BOUND: Final = "Cramér-Rao bound of torque noise alone"
_ENCODER_BOUND: Final = "Cramér-Rao bound of encoder and torque noise"


def _error(name: str, title: str, formula: str, unit: str = "", truth: bool = False) -> Metric:
    """A metric that methods are ranked by: an error on held-out torque or of the parameters."""
    # An error with a unit has no scale below which it is rounding, except lengths and masses.
    floor = 0.0 if unit == _TORQUE else _ROUNDING
    return Metric(
        name, title, unit, "lower", needs=("truth",) if truth else ("held-out",), formula=formula,
        floor=floor, ranked=True, shown=name in ("rmse_test", "torque_error", "parameter_error"),
    )  # fmt: skip


def _shown_in(metric: Metric, unit: str, scale: float) -> Metric:
    """The metric in another unit of tables and reports; rows stay in SI units."""
    return replace(metric, unit=unit, scale=scale)


_ACCURACY: Final = (
    Metric("rmse_train", "Training RMSE", _TORQUE, "lower",
           formula="RMS residual on the measured training torque"),
    _error("rmse_test", "Held-out RMSE", "RMS error over all held-out motions and joints", _TORQUE),
    _error("torque_error", "Relative held-out torque error",
           "RMS over joints of (RMS error / RMS whole torque)"),
    Metric("torque_error_null", "Relative held-out torque error of the null model", better="lower",
           needs=("held-out",), shown=True,
           formula="bodies of the model file (simulated: of the prior), joint terms fitted"),
    Metric("torque_error_mean", "Relative held-out torque error of the mean torque", better="lower",
           needs=("held-out",), formula="of predicting the mean torque of the training"),
    Metric("torque_error_floor", "Relative error of the training torque, played again",
           better="lower", needs=("held-out",), formula="where a test repeats the training motion"),
    Metric("torque_error_best", "Least relative torque error of the model on the tests",
           better="lower", needs=("held-out",),
           formula="of the base parameters that fit the tests themselves"),
    Metric("gap_closed", "Share of the gap between null model and floor that is closed",
           better="higher", needs=("held-out",), shown=True,
           formula="(null - error) / (null - floor), floor the smaller of torque_error_floor and "
           "torque_error_best; absent where it is not below the null"),
    Metric("beaten_by", "Baselines with a smaller error", text=True, needs=("held-out",),
           formula="file-friction (file: values of the model file), mean-torque, zero-torque; of "
           "positions file, position-command"),
    Metric(FRAME_DEPENDENT, "Reason for which the answer depends on the frames of the links",
           text=True),
    _error("torque_error_moving", "Relative held-out torque error of moving joints",
           "the same over rows with |v| of the joint at least 10 % of its RMS"),
    _error("torque_error_weighted", "Relative held-out torque error by torque",
           "RMS over joints, each weighted by its RMS torque"),
    _error("torque_error_sample", "Held-out torque error per sample",
           "mean over samples of |error| / |torque|"),
    _error("torque_error_worst", "Held-out torque error of the worst joint",
           "largest RMS error / RMS torque of a joint"),
    _shown_in(_error("rollout_error", "Error of simulated positions",
                     "RMS over judged samples and joints under recorded commands; row in rad, m"),
              "mrad|mm", 1000.0),
    Metric("rollout_error_null", "Error of positions simulated with the file's values", "rad|m",
           "lower", needs=("held-out",), formula="armature and friction of the model file"),
    Metric("rollout_error_command", "Error of the commanded positions", "rad|m", "lower",
           needs=("held-out",), formula="RMS of commanded minus recorded positions"),
    Metric("rollout_error_floor", "Difference of positions under repeated commands", "rad|m",
           "lower", needs=("held-out",), formula="RMS over the motion that the training repeats"),
    _error("parameter_error", "Relative parameter error in torque",
           "sqrt(d' W'W d) / |W beta*|, d = beta - beta*, W of the held-out rows: the error of the "
           "parameters as the torque that it amounts to", truth=True),
    # Of mixed units, and dependent on the base chosen: for comparison with publications alone.
    _error("beta_error", "Relative base-parameter error (mixed units)",
           "|beta - beta*| / |beta*|, SI columns", truth=True),
    _error("payload_error", "Relative payload error (mixed units)",
           "|phi - phi*| / |phi*|, ten SI numbers", truth=True),
    _error("mass_error", "Mass error", "|m - m*|", "kg", truth=True),
    _error("com_error", "Error of the centre of mass", "|c - c*|", "m", truth=True),
    _error("inertia_error", "Relative error of the inertia",
           "|I - I*| / |I*| about the centre of mass, Frobenius", truth=True),
    _error("payload_mass_error", "Mass error", "|m - m*|", "kg", truth=True),
    _shown_in(_error("payload_mass_error_relative", "Relative mass error", "|m - m*| / m*",
                     truth=True), "%", 100.0),
    _shown_in(_error("payload_com_error", "Error of the centre of mass", "|c - c*|; row in m",
                     truth=True), "mm", 1000.0),
    _shown_in(_error("payload_inertia_error", "Relative error of the inertia",
                     "|I - I*| / |I*| about the centre of mass, Frobenius", truth=True),
              "%", 100.0),
    _error("payload_distance", "Geodesic distance of the pseudo-inertias",
           "sqrt(sum_i ln(l_i)^2), l_i the eigenvalues of J*^-1 J: the same in every frame; none "
           "for a body that cannot exist", truth=True),
)  # fmt: skip

_DATA: Final = (
    Metric("rank", "Base parameters", digits=0, shown=True,
           formula="rank of the regressor on random states"),
    Metric("data_rank", "Excited base parameters", digits=0, better="higher",
           formula="rank of the regressor on the training motion"),
    Metric("parameters", "Parameters", digits=0),
    Metric("rank_gap", "Rank gap", better="higher",
           formula="smallest kept over largest dropped singular value"),
    Metric("near_degenerate", "Nearly dependent directions", digits=0, better="lower"),
    Metric("condition", "Condition number (SI columns)", better="lower", shown=True,
           formula="sigma_max / sigma_min of W, left-to-right base set"),
    Metric("condition_unit", "Condition number (unit columns)", better="lower",
           formula="sigma_max / sigma_min of W with columns of length one"),
    Metric("d_optimality", "Log-determinant of information", better="higher", needs=("held-out",),
           formula="log det of the information about held-out torques"),
    Metric("left_out", "Share of samples taken for contacts"),
    Metric("standstill", "Share of rows left out at standstill"),
    Metric("plant_step", "Step of the plant", "s"),
    Metric("candidate_step", "Step of candidate models", "s"),
    Metric("candidate_simulator", "What simulates candidate models"),
    Metric("same_simulator", "Plant and candidates with one step and integrator, or simulator"),
    Metric("q_margin", "Share of the position limits left", better="higher",
           formula="smallest over all motions and joints; negative beyond a limit"),
    Metric("v_margin", "Share of the velocity limits left", better="higher",
           formula="smallest over all motions and joints; negative beyond a limit"),
    Metric("a_margin", "Share of the acceleration limits left", better="higher",
           formula="smallest over all motions and joints; negative beyond a limit"),
)  # fmt: skip

_LOAD: Final = (
    Metric("mass", "Mass", "kg", needs=("load",)),
    Metric("mass_low", "Mass, lower end of the 95 % interval", "kg", needs=("load",)),
    Metric("mass_high", "Mass, upper end of the 95 % interval", "kg", needs=("load",)),
)

_SENSOR: Final = (
    Metric("structural_rank", "Base parameters of the sub-tree", digits=0, needs=("sensor",)),
    Metric("excited_rank", "Excited base parameters of the sub-tree", digits=0, better="higher",
           needs=("sensor",)),
    Metric("unpredictable", "Joints with unpredictable torque", digits=0, better="lower",
           needs=("sensor",), formula="joints whose torque depends on unexcited parameters"),
    Metric("sensed_torque_ratio", "Torque error with sensor / that of true parameters", digits=4,
           better="lower", needs=("sensor",)),
    Metric("sensed_wrench_ratio", "Touch error with sensor / that of true parameters", digits=4,
           better="lower", needs=("sensor",)),
    Metric("sensed_cad_ratio", "Torque error with sensor, CAD / identified", better="higher",
           needs=("sensor",)),
    Metric("alone_cad_ratio", "Torque error of parameters alone, identified / CAD",
           better="lower", needs=("sensor",)),
)  # fmt: skip

_BODIES: Final = (
    Metric("feasible", "Share of feasible estimates", better="higher", needs=("theta",),
           shown=True, formula="every pseudo-inertia is positive semidefinite"),
    Metric("plausible", "Share of plausible estimates", better="higher", needs=("theta",),
           formula="mass, centre and inertia fit into the bounding box of each body"),
    Metric("min_eigenvalue", "Smallest pseudo-inertia eigenvalue", better="higher",
           needs=("theta",)),
)  # fmt: skip


def _by_class(
    name: str,
    title: str,
    better: Better | None = None,
    level: Level = "interval",
    formula: str = "",
) -> tuple[Metric, ...]:
    """A metric of intervals for inertial base parameters, and one for those of friction."""
    return tuple(
        Metric(name.format(one), title.format(one), better=better, level=level, formula=formula,
               needs=("truth", "noise"))
        for one in ("inertial", "friction")
    )  # fmt: skip


_UNCERTAINTY: Final = (
    Metric("coverage", "Share of 95 % intervals that hold the truth", level="interval",
           needs=("truth", "noise")),
    *_by_class("coverage_{}", "Share of 95 % intervals that hold the value, {} parameters"),
    *_by_class("width_{}", "Width of 95 % intervals, {} parameters", better="lower",
               formula="mean width, as the share of the torque that it amounts to"),
    *_by_class("interval_score_{}", "Interval score of 95 % intervals, {} parameters",
               better="lower",
               formula="mean of width + 40 times the distance of values outside (Gneiting and "
               "Raftery 2007), as the share of the torque that it amounts to"),
    *_by_class("coverage_worst_{}", "Share of 95 % intervals that hold the value, worst of the {} "
               "parameters over repeats", level="interval-repeats"),
    Metric("torque_inside", "Share of held-out torque inside of 95 % prediction intervals",
           needs=("held-out", "noise")),
    Metric("bias", "Mean error in standard deviations of an estimate", better="lower",
           level="repeats", needs=("truth", "repeats")),
    Metric("spread", f"Scatter over the {_BOUND}", better="lower", level="repeats",
           needs=("truth", "noise", "repeats")),
    Metric("efficiency", f"Efficiency against the {_BOUND}", better="higher", level="repeats",
           needs=("truth", "noise", "repeats")),
    Metric("bound_ratio", f"RMS error over the {_BOUND}", better="lower", level="repeats",
           needs=("truth", "noise", "repeats")),
    Metric("bound_ratio_encoders", f"RMS error over the {_ENCODER_BOUND}", better="lower",
           level="repeats", needs=("truth", "noise", "repeats"),
           formula="bound (W' (S_tau + J S_q J')^-1 W)^-1: every sample of q unknown, J the torque "
           "by q through central differences; of the first repeat"),
    Metric("verdict", "Verdict on each parameter", level="parameter", text=True,
           key="identifiable"),
)  # fmt: skip


def _joint(name: str, title: str, key: str, unit: str = "", floor: float = 0.0) -> Metric:
    better: Better | None = None if key == "rms" else "lower"
    return Metric(name, title, unit, better, "joint", floor=floor, key=key)


_JOINTS: Final = (
    _joint("joint_rms", "RMS torque of the joint", "rms", _TORQUE),
    _joint("joint_rmse", "Held-out RMSE of the joint", "rmse_test", _TORQUE),
    _joint("joint_error", "Relative held-out error of the joint", "relative", floor=_ROUNDING),
    _joint("joint_replayed", "Relative error of the training torque, played again", "replayed"),
    Metric("joint_inside", "Share of the joint's held-out torque inside of prediction intervals",
           level="joint", key="inside"),
    _joint("joint_rmse_train", "Training RMSE of the joint", "rmse_train", _TORQUE),
    _joint("joint_error_train", "Relative training error of the joint", "relative_train",
           floor=_ROUNDING),
)  # fmt: skip

_RUN: Final = (
    Metric("converged", "Share of converged estimates", better="higher",
           formula="of the iterative methods, by the stop rule of each"),
    Metric("iterations", "Iterations", better="lower", digits=0),
    Metric("simulations", "Simulations", better="lower", digits=0,
           formula="runs of the closed loop over the recording; filters and open-loop rollouts "
           "run none"),
    Metric("seconds", "Time", "s", "lower", ranked=True, shown=True),
    Metric("seconds_cpu", "CPU time of the process", "s", "lower"),
    Metric("seconds_experiment", "Time to read, filter and reduce the data", "s", "lower"),
    Metric("seconds_experiment_cpu", "CPU time to read, filter and reduce the data", "s", "lower"),
    Metric("seconds_kernel_cpu", "CPU time of the regressor kernel in it", "s", "lower"),
    Metric("gap", "Regressor gap to Pinocchio", better="lower", shown=True,
           formula="max |Y - Y_pin| / max |Y_pin|"),
    Metric("closure", "Torque closure with MuJoCo", better="lower", shown=True,
           formula="max |Y theta - tau_mujoco| / max |tau_mujoco|"),
    Metric("native_gap", "Regressor gap to Pinocchio's own parser", better="lower"),
)  # fmt: skip

METRICS: Final[Mapping[str, Metric]] = MappingProxyType(
    {
        metric.name: metric
        for group in (_ACCURACY, _DATA, _LOAD, _SENSOR, _BODIES, _UNCERTAINTY, _JOINTS, _RUN)
        for metric in group
    }
)

REASONS: Final = "metric_reasons"
"""Row field with the reason of every plug-in metric that gave no value, by name."""

_NAME: Final = re.compile(r"[a-z][a-z0-9_]*")
_RECORD: Final = ("name", "title", "unit", "better", "digits", "floor", "ranked", "needs", "scale")


def names_of(level: Level) -> tuple[str, ...]:
    """Names of the metrics of a level."""
    return tuple(name for name, metric in METRICS.items() if metric.level == level)


ROW_FIELDS: Final = CELL_FIELDS | {"status", "reason", "stop", "crosscheck", *names_of("cell")}
"""Fields of a finished cell in expressions."""

_OTHER_FIELDS: Final = MACHINE_FIELDS | {
    *("joints", "parameters_table", "stats", "versions", "fingerprint", "sources", "losses"),
    *("traceback", "row_sha256", "native_reason", "repairs", "nv", "free_base", REASONS),
}
"""Fields of rows that are not metrics, nor in expressions."""


def metric_of(name: str, metrics: Mapping[str, Metric] = METRICS) -> Metric:
    """The metric of a column; an unknown column keeps its name as title."""
    return metrics.get(name, Metric(name, name))


def metric_of_plugin(thing: Any) -> Metric:
    """A plug-in's metric.

    Raises UsageError for another type, a name that is taken or not a field name, another level
    than "cell", a direction or ranking that contradict each other, and a missing `compute`.
    """
    if not isinstance(thing, Metric):
        raise UsageError(
            f"A metric plug-in is a sysid_bench.types.Metric, or a function that returns one; got "
            f"{type(thing).__name__}."
        )
    if not _NAME.fullmatch(thing.name):
        raise UsageError(f"The metric name {thing.name!r} is not a field name; use a-z, 0-9 and _.")
    if thing.name in {*METRICS, *ROW_FIELDS, *_OTHER_FIELDS}:
        raise UsageError(
            f"The metric name {thing.name!r} is a field of rows already; choose another."
        )
    if thing.compute is None or thing.level != "cell" or thing.text:
        raise UsageError(
            f"The metric {thing.name!r} needs `compute` and level 'cell', and is a number."
        )
    if thing.better not in ("lower", "higher", None):
        raise UsageError(f"The metric {thing.name!r}: better is 'lower', 'higher' or None.")
    # A ranking divides by the smallest value of a case: the best has to be the smallest.
    if thing.ranked and thing.better != "lower":
        raise UsageError(
            f"The metric {thing.name!r} is ranked by ratios: better has to be 'lower'."
        )
    return thing


def metric_record(metric: Metric) -> dict[str, Any]:
    """JSON values that describe a metric without its code, as a run folder keeps them."""
    values = {key: getattr(metric, key) for key in _RECORD} | {"needs": list(metric.needs)}
    return {key: value for key, value in values.items() if value is not None}


def metric_from_record(record: Mapping[str, Any]) -> Metric:
    """The metric of a record; it computes nothing. Raises UsageError for unknown keys."""
    try:
        return Metric(**{**record, "needs": tuple(record.get("needs", ()))})
    except TypeError as error:
        raise UsageError(f"The record of a metric has unknown or missing keys: {error}.") from error


def metric_fields(makers: Mapping[str, Callable[[], Any]], cell: MetricInput) -> Row:
    """Row fields of plug-in metrics by name; `makers` import and build them.

    Any exception, and any value that is not a finite number, leaves the field empty and adds its
    reason to the field `metric_reasons`: a row is never lost to a metric.
    """
    fields: Row = {}
    reasons: dict[str, str] = {}
    for name, make in makers.items():
        fields[name], reason = _field(make, cell)
        if reason:
            reasons[name] = reason
    return {**fields, REASONS: reasons} if reasons else fields


def _field(make: Callable[[], Any], cell: MetricInput) -> tuple[float | None, str]:
    """Value and reason of a plug-in metric that `make` imports and builds; neither where the metric
    says that it does not apply."""
    try:
        metric = metric_of_plugin(make())
        missing = ", ".join(need for need in metric.needs if not _is_there(need, cell))
        if missing:
            return None, f"needs {missing}"
        assert metric.compute is not None
        given: Any = metric.compute(cell)
        return (None, "") if given is None else _finite(given)
    except (Exception, SystemExit) as error:  # a plug-in's file may call sys.exit()
        return None, reason_of(error)


def _finite(given: Any) -> tuple[float | None, str]:
    """A metric's result as a number, or the reason why it is not one."""
    # Scalars of numpy and booleans are numbers, too; arrays of one element are a mistake.
    if getattr(given, "ndim", 0) or isinstance(given, (str, bytes)):
        return None, f"returned {type(given).__name__}; a metric is one number or None"
    number = float(given)
    return (number, "") if math.isfinite(number) else (None, f"returned {number}")


def _is_there(need: str, cell: MetricInput) -> bool:
    """True where a cell has what a metric needs; needs beyond its input are taken as met."""
    if need == "held-out":
        return bool(cell.held_out)
    if need == "theta":
        return cell.estimate.theta is not None
    return need != "truth" or cell.score.beta_error is not None
