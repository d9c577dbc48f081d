"""Closed sets of words in suites and rows, part of the contract of the command line."""

from collections.abc import Mapping
from typing import Final

from sysid_bench.metrics import METRICS as RECORDS
from sysid_bench.metrics import names_of
from sysid_bench.types import Level

TERMS: Final = ("viscous", "coulomb", "offset", "armature", "spring")
FINDINGS: Final = (
    "rate", "velocity", "units", "held", "lost", "non-finite", "time", "limits",
)  # fmt: skip
"""Findings in a recording that a user can accept."""
STATUSES: Final = (
    "ok", "failed", "timeout", "crash", "memory", "lost", "unsupported", "skipped",
)  # fmt: skip
FAILURES: Final = ("failed", "timeout", "crash", "memory", "lost")
"""Statuses of failures; `unsupported` and `skipped` are valid results. `lost` is the machine's: the
process was killed from outside, or storage failed."""
MACHINE_FIELDS: Final = frozenset(("seconds", "seconds_experiment", "load", "peak_memory"))
"""Fields of a row that differ from run to run on the same machine; all others are reproduced."""
MOST_LOSSES: Final = 3
"""A resumed run repeats a `lost` cell until it was lost this often."""

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
    "pipeline",
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
    "pipeline.use",
    "estimator.use",
}
"""Fields of a planned cell in expressions, besides the written settings of its plug-ins."""

METRICS: Final = names_of("cell")
"""Columns that hold a number (or yes and no) per cell."""

ERRORS: Final = tuple(name for name in METRICS if RECORDS[name].ranked)
"""Metrics of which the smaller is the better, and their ratio says how much."""

PARAMETER: Final = "parameter"
VERDICT: Final = "verdict"
"""Metric of a table by parameter (m, hx, ..., fc): its identifiability, in words."""

JOINT: Final = "joint"
"""Axis of tables with metrics of joints."""
JOINT_METRICS: Final = names_of("joint")

COVERAGE: Final = "coverage"
STD_FROM: Final = "std_from"
"""Axis of tables by source of the standard deviations (periods, residuals, textbook): how often
the truth lies in their 95 % intervals."""

REPEATED: Final = names_of("repeats")
"""Metrics of all repeats together (evaluation/repeat_statistic.py); a single cell has none."""

ROW_FIELDS: Final = CELL_FIELDS | {"status", "reason", "crosscheck", *METRICS}
"""Fields of a finished cell in expressions."""

STATISTICS: Final = ("median", "mean", "min", "max", "count")
INTERVALS: Final = ("none", "iqr", "std", "range", "ci95")
BESTS: Final = ("none", "min-bold", "max-bold", "bold")
"""Marks of the best values of a table; `bold` follows the direction of each metric."""

LEVEL_AXES: Final[Mapping[Level, str]] = {
    "parameter": PARAMETER,
    "interval": STD_FROM,
    "joint": JOINT,
}
"""Axis that a table needs for metrics of these levels, and for no others."""
