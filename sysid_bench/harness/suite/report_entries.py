"""Keys of a suite that make its report: tables, rankings, and figures as papers print them."""

from functools import partial
from typing import Annotated

from pydantic import (
    BaseModel,
    ConfigDict,
    PlainValidator,
    StrictStr,
    StringConstraints,
    model_validator,
)

from sysid_bench.harness.suite.checks import condition, one_of
from sysid_bench.vocabulary import (
    BESTS,
    COVERAGE,
    ERRORS,
    INTERVALS,
    JOINT,
    JOINT_METRICS,
    LABELS,
    METRICS,
    PARAMETER,
    REPEATED,
    STATISTICS,
    STD_FROM,
    VERDICT,
)

RowCondition = Annotated[str, PlainValidator(partial(condition, True))]


class Section(BaseModel):
    """A table of the suite file."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TableCells(Section):
    metric: Annotated[
        str, one_of("metric", (*METRICS, VERDICT, COVERAGE, *REPEATED, *JOINT_METRICS))
    ]
    stat: Annotated[str, one_of("statistic", STATISTICS)] = "median"
    interval: Annotated[str, one_of("interval", INTERVALS)] = "none"


Label = Annotated[str, one_of("label of a cell", (*LABELS, "repeat"))]
Folder = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z0-9_][A-Za-z0-9._-]*$")]


Axis = Annotated[str, one_of("label of a cell", (*LABELS, "repeat", PARAMETER, STD_FROM, JOINT))]


class TableEntry(Section):
    name: Folder
    title: StrictStr | None = None
    rows: tuple[Axis, ...] = ("robot", "payload")
    columns: tuple[Axis, ...] = ("estimator",)
    cells: TableCells
    best: Annotated[str, one_of("way to mark the best", BESTS)] = "none"
    select: RowCondition | None = None

    @model_validator(mode="after")
    def _verdicts_by_parameter(self) -> "TableEntry":
        if (self.cells.metric == VERDICT) != (PARAMETER in (*self.rows, *self.columns)):
            raise ValueError(
                f"the metric {VERDICT!r} and the label {PARAMETER!r} among rows or columns go "
                "together: a verdict belongs to a parameter, and other metrics to a cell."
            )
        by_joint = JOINT in (*self.rows, *self.columns)
        if (self.cells.metric in JOINT_METRICS) != by_joint:
            raise ValueError(
                f"the metrics {', '.join(JOINT_METRICS)} and the label {JOINT!r} among rows or "
                "columns go together."
            )
        return self

    @model_validator(mode="after")
    def _coverage_by_origin(self) -> "TableEntry":
        if (self.cells.metric == COVERAGE) != (STD_FROM in (*self.rows, *self.columns)):
            raise ValueError(
                f"the metric {COVERAGE!r} and the label {STD_FROM!r} among rows or columns go "
                "together: intervals from periods, residuals and textbook differ."
            )
        return self

    @model_validator(mode="after")
    def _repeats_together(self) -> "TableEntry":
        if self.cells.metric in REPEATED and (
            "repeat" in (*self.rows, *self.columns) or self.cells.interval not in ("none", "ci95")
        ):
            raise ValueError(
                f"the metric {self.cells.metric!r} is one of all repeats together: it has no value "
                "by repeat, and no interval but 'ci95'."
            )
        return self


class Paper(Section):
    """A table or figure as papers print it: `model` (bodies and joints), `base-parameters` with the
    values of a cell, `torques` measured and predicted along a test log."""

    name: Folder
    show: Annotated[str, one_of("thing to show", ("model", "base-parameters", "torques"))]
    title: StrictStr = ""
    select: RowCondition | None = None  # the first cell that meets it
    test: StrictStr | None = None


class RankingEntry(Section):
    """Comparison of methods over robots; one ranking for each value of the labels `apart`."""

    name: Folder
    title: StrictStr | None = None
    metric: Annotated[str, one_of("metric to rank by", ERRORS)] = "torque_error"
    apart: tuple[Label, ...] = ()
    against: StrictStr | None = None  # the method that the others are tested against
    select: RowCondition | None = None
