"""Closed sets of words in suites and rows, part of the contract of the command line."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:  # types load numpy, and --help needs these words alone
    from sysid_bench.types import Level

TERMS: Final = ("viscous", "coulomb", "offset", "armature", "spring")
MOTOR: Final = "motor"
"""Prefix of motor names (motor1, motor2, ... in the order of the columns of G) and of the terms of
motors instead of joints."""
FINDINGS: Final = (
    "rate", "velocity", "units", "held", "lost", "non-finite", "time", "limits", "joined",
    "zero", "copied", "wrapped", "magnitude", "spikes", "sign", "columns", "direction", "gain",
    "current", "gravity", "offset", "robot", "delay",
)  # fmt: skip
"""Findings in a recording that a user can accept: those of the reader, then those of a diagnosis.
"""
STATUSES: Final = (
    "ok", "failed", "timeout", "crash", "memory", "lost", "unsupported", "skipped",
)  # fmt: skip
MACHINE_FIELDS: Final = frozenset((
    "seconds", "seconds_cpu", "seconds_experiment", "seconds_experiment_cpu",
    "seconds_kernel_cpu", "load", "peak_memory", "machine", "isolation",
))  # fmt: skip
"""Fields of a row that differ from run to run on the same machine; all others are reproduced."""
NAMESPACES: Final = "namespaces"
PROCESS: Final = "process"
"""Isolation of a third-party method: without network, other processes and files of others, or a
fresh process alone."""

MOST_LOSSES: Final = 3
"""A resumed run repeats a `lost` cell until it was lost this often."""

LABELS: Final = (
    "robot", "payload", "task", "terms", "plant", "prior", "excitation", "motions", "held_out",
    "simulation", "rate", "noise", "signals", "pipeline", "estimator",
)  # fmt: skip
"""Labels of a row: one text per axis of a suite."""

CELL_FIELDS: Final = frozenset((
    *LABELS, "id", "experiment", "repeat", "robot.free_base", "payload.mass",
    "noise.q", "noise.tau", "noise.quantum", "noise.tau_drift", "noise.tau_correlation",
    "noise.force", "noise.moment", "noise.force_offset", "noise.moment_offset",
    "noise.force_drift", "noise.moment_drift", "noise.gain", "noise.crosstalk", "noise.mounting",
    "noise.touch", "prior.mass", "prior.com", "prior.inertia", "prior.terms", "prior.axes",
    "prior.friction", "prior.declared", "prior.known", "signals.filter", "signals.derivatives",
    "signals.torque", "signals.runs", "plant.use", "excitation.use", "simulation.use",
    "pipeline.use", "estimator.use",
))  # fmt: skip
"""Fields of a planned cell in expressions, besides the written settings of its plug-ins."""

PARAMETER: Final = "parameter"
VERDICT: Final = "verdict"
"""Metric of a table by parameter (m, hx, ..., fc): its identifiability, in words."""

JOINT: Final = "joint"
"""Axis of tables with metrics of joints."""

COVERAGE: Final = "coverage"
STD_FROM: Final = "std_from"
"""Axis of tables by kind of interval (motions, periods, residuals, textbook): how often their 95 %
intervals hold the truth, and how wide they are."""

INTERVAL_LIMITS: Final = {
    "motions": "holds noise and the misfit that differs between motions; what all motions share, "
    "as a wrong gain or friction that the filter distorts, is a bias that it does not know of",
    "periods": "holds noise; misfit repeats in every period and is not in it, nor is the bias of "
    "gains, filters and friction",
    "residuals": "holds noise and its correlation in time; W is taken as exact, and the bias of "
    "encoders, gains, filters and friction is not in it",
    "blocks": "holds noise and the misfit that differs between the parts of the motion; the pull "
    "of constraints and prior, and the bias of gains, filters and friction, are not in it; a value "
    "that a constraint holds in every part has none",
    "textbook": "holds noise as the method assumes it; neither misfit nor any bias is in it",
}
"""Contents and limits of an interval, by kind."""

INTEGRATORS: Final = ("auto", "euler", "implicitfast", "implicit", "rk4")
"""Integrators of a closed loop; "auto" is semi-implicit Euler where the torque is held over the
control period, else "implicitfast"."""

SIMULATORS: Final = ("mujoco", "lanes")
"""Simulators of a closed loop: MuJoCo, or the steps of lanes.c."""

STATISTICS: Final = ("median", "mean", "min", "max", "count")
INTERVALS: Final = ("none", "iqr", "std", "range", "ci95")
BESTS: Final = ("none", "min-bold", "max-bold", "bold")
"""Marks of the best values of a table; `bold` follows the direction of each metric."""

FRAME_DEPENDENT: Final = "frame_dependent"
"""Attribute of a method, and field of its rows, with the reason for which its answer depends on the
frames of the links: rankings leave it out."""

BASELINE_LABELS: Final = ("null model", "floor")
"""Labels of baselines in the place of an estimator, which no estimator may have."""

UNKNOWN: Final = "unknown"
"""Friction of which a prior knows the order of magnitude alone."""

RECORDED: Final = "recorded"
"""Label of what cells of recordings do not simulate, as their plant."""
REFERENCE: Final = "wls"
MARGIN: Final = "10 %"
"""Reference and margin of equivalence of a [[ranking]] that names none."""

UNCONVERGED: Final = ("accepted", "replaced")
"""Ways to count answers that have not converged: as they are, or as those of the reference."""

LEFT_OUT: Final = "left-out"
CLAIM_STATISTICS: Final = (
    *("ratio", "difference", "rank", "median", "coverage", "share"),
    LEFT_OUT,
)
PAIRED: Final = ("ratio", "difference", "rank")
"""Statistics of a [[claim]]; those that compare two selections."""

DIRECTIONS: Final = ("at most", "at least", "within")
CLAIM_LEVELS: Final = ("L0", "L1", "L2", "L3", "L4")
"""Plants that a [[claim]] may be tested on, one by one."""

CLAIM_UNITS: Final = ("robot", "payload", "excitation", "repeat", "joint", "cell")
"""Units that the interval of a claim is over."""

OF_REPEATS: Final = ("repeats", "interval-repeats")
"""Levels of metrics that are computed from all repeats of some cells together."""

LEVEL_AXES: Final[Mapping["Level", str]] = {
    "parameter": PARAMETER,
    "interval": STD_FROM,
    "interval-repeats": STD_FROM,
    "joint": JOINT,
}
"""Axis that a table needs for metrics of these levels, and for no others."""

AT_BOUND: Final = "at bound"
"""Verdict on a value of actuators that lies on its bound of zero."""

PUBLISHED: Final = "published:"
"""Begins a prior of published values, before their name in the file beside a recording."""
