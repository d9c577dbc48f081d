"""Closed sets of words in suites and rows, part of the contract of the command line."""

from dataclasses import fields
from typing import Final

from sysid_bench.types import Score

TERMS: Final = ("viscous", "coulomb", "offset", "armature", "spring")
FINDINGS: Final = (
    "rate", "velocity", "units", "held", "lost", "non-finite", "time", "limits",
)  # fmt: skip
"""Findings in a recording that a user can accept."""
STATUSES: Final = ("ok", "failed", "timeout", "crash", "unsupported", "skipped")
FAILURES: Final = ("failed", "timeout", "crash")
"""Statuses of failures; `unsupported` and `skipped` are valid results."""

LABELS: Final = (
    "robot",
    "payload",
    "task",
    "terms",
    "plant",
    "prior",
    "excitation",
    "held_out",
    "simulation",
    "rate",
    "noise",
    "signals",
    "estimator",
)
"""Labels of a row: one text per axis of a suite."""

CELL_FIELDS: Final = frozenset(LABELS) | {
    "id",
    "experiment",
    "repeat",
    "robot.free_base",
    "payload.mass",
    "noise.q",
    "noise.tau",
    "noise.quantum",
    "noise.tau_drift",
    "noise.tau_correlation",
    "noise.force",
    "noise.moment",
    "noise.force_offset",
    "noise.moment_offset",
    "noise.force_drift",
    "noise.moment_drift",
    "noise.gain",
    "noise.crosstalk",
    "noise.mounting",
    "noise.touch",
    "prior.mass",
    "prior.com",
    "prior.inertia",
    "prior.terms",
    "prior.known",
    "signals.filter",
    "signals.derivatives",
    "signals.torque",
    "signals.runs",
    "plant.use",
    "excitation.use",
    "simulation.use",
    "estimator.use",
}
"""Fields of a planned cell in expressions, besides the written settings of its plug-ins."""

_NO_NUMBERS = ("joints", "torque_error_by_motion", "coverage")
METRICS: Final = (
    *(field.name for field in fields(Score) if field.name not in _NO_NUMBERS),
    "seconds",
    "seconds_experiment",
    "gap",
    "closure",
    "native_gap",
)
"""Columns that hold a number (or yes and no) per cell."""

ERRORS: Final = (
    "torque_error",
    "torque_error_sample",
    "torque_error_worst",
    "rmse_test",
    "parameter_error",
    "beta_error",
    "payload_error",
    "mass_error",
    "com_error",
    "inertia_error",
    "seconds",
)
"""Metrics of which the smaller is the better, and their ratio says how much."""

PARAMETER: Final = "parameter"
VERDICT: Final = "verdict"
"""Metric of a table by parameter (m, hx, ..., fc): its identifiability, in words."""

JOINT: Final = "joint"
"""A table by joint has its own metrics."""
JOINT_METRICS: Final = (
    "joint_rms", "joint_rmse", "joint_error", "joint_replayed",
    "joint_rmse_train", "joint_error_train",
)  # fmt: skip

COVERAGE: Final = "coverage"
STD_FROM: Final = "std_from"
"""A table by where deviations come from (periods, residuals, textbook) tells how often the truth
lies in their 95 % intervals."""

REPEATED: Final = ("bias", "spread", "efficiency", "bound_ratio")
"""Metrics of all repeats together (evaluation/repeats.py); no cell has one of its own."""

ROW_FIELDS: Final = CELL_FIELDS | {"status", "reason", "crosscheck", *METRICS}
"""Fields of a finished cell in expressions."""

STATISTICS: Final = ("median", "mean", "min", "max", "count")
INTERVALS: Final = ("none", "iqr", "std", "range", "ci95")
BESTS: Final = ("none", "min-bold", "max-bold")
