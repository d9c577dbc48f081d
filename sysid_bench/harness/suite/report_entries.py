"""Keys of a suite that make its report: tables, rankings, and figures as papers print them."""

from collections.abc import Sequence
from functools import partial
from itertools import chain
from typing import Annotated, Any, Final

from pydantic import (
    BaseModel,
    ConfigDict,
    PlainValidator,
    StrictBool,
    StrictStr,
    StringConstraints,
    ValidationInfo,
    model_validator,
)

from sysid_bench.harness.suite.checks import (
    check_input,
    choice_of,
    condition,
    metric_name,
    quantity_of,
)
from sysid_bench.metrics import METRICS, names_of
from sysid_bench.types import Metric
from sysid_bench.words import (
    BESTS,
    INTERVALS,
    JOINT,
    LABELS,
    LEVEL_AXES,
    MARGIN,
    OF_REPEATS,
    PARAMETER,
    REFERENCE,
    STATISTICS,
    STD_FROM,
    UNCONVERGED,
)

RowCondition = Annotated[str, PlainValidator(partial(condition, True))]


class SuiteTable(BaseModel):
    """A table of the suite file."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


AnyMetric = Annotated[str, metric_name("metric", lambda metric: True)]
CellMetric = Annotated[str, metric_name("metric", lambda metric: metric.level == "cell")]
RankedMetric = Annotated[str, metric_name("metric to rank by", lambda metric: metric.ranked)]


class TableCells(SuiteTable):
    metric: AnyMetric | None = None  # the one metric of the table
    stat: Annotated[str, choice_of("statistic", STATISTICS)] = "median"
    """Statistic over the cells of an entry."""
    interval: Annotated[str, choice_of("interval", INTERVALS)] = "none"  # interval beside it


Label = Annotated[str, choice_of("label of a cell", (*LABELS, "repeat"))]
Folder = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z0-9_][A-Za-z0-9._-]*$")]


Axis = Annotated[str, choice_of("label of a cell", (*LABELS, "repeat", PARAMETER, STD_FROM, JOINT))]


class TableEntry(SuiteTable):
    name: Folder  # name of its files
    title: StrictStr | None = None  # heading; default: the name
    rows: tuple[Axis, ...] = ("robot", "payload")  # labels of cells down the side
    columns: tuple[Axis, ...] = ("estimator",)  # labels of cells along the top
    metrics: tuple[AnyMetric, ...] = ()
    """Several, each a column; `cells` then has stat and interval alone."""
    cells: TableCells = TableCells()  # one metric with its statistic
    best: Annotated[str, choice_of("way to mark the best", BESTS)] = "none"
    """Mark of the best values of a row."""
    select: RowCondition | None = None  # condition on rows
    effects: StrictBool = False
    """Main effects of rows and columns as ratios: what a pipeline and what a method contributes."""

    @model_validator(mode="after")
    def _effects_have_two_sides(self) -> "TableEntry":
        if self.effects and (self.metrics or not self.columns):
            raise ValueError(
                "effects = true compares rows with columns: give columns = [...] and one metric, "
                "cells = { metric = ... }."
            )
        return self

    @model_validator(mode="after")
    def _metrics_fit_the_axes(self, info: ValidationInfo) -> "TableEntry":
        if bool(self.metrics) == (self.cells.metric is not None):
            raise ValueError("give metrics = [...], or cells = { metric = ... }; not both.")
        known = {**METRICS, **check_input(info).metrics}
        named = [known[name] for name in self.metrics or (str(self.cells.metric),)]
        self._check_levels(named)
        self._check_repeats(named)
        return self

    def _check_levels(self, named: Sequence[Metric]) -> None:
        """Raise ValueError where metrics of joints or parameters and their axis are apart."""
        for axis in dict.fromkeys(LEVEL_AXES.values()):
            levels = [level for level, needed in LEVEL_AXES.items() if needed == axis]
            if any((metric.level in levels) != (axis in self._axes) for metric in named):
                names = ", ".join(chain.from_iterable(map(names_of, levels)))
                raise ValueError(
                    f"the metrics {names} and the label {axis!r} among rows or columns go together."
                )

    def _check_repeats(self, named: Sequence[Metric]) -> None:
        """Raise ValueError where a metric of all repeats would be one of a single repeat."""
        is_by_repeat = "repeat" in self._axes or self.cells.interval not in ("none", "ci95")
        repeated = [metric.name for metric in named if metric.level in OF_REPEATS]
        if repeated and is_by_repeat:
            raise ValueError(
                f"the metric {repeated[0]!r} is one of all repeats together: it has no value "
                "by repeat, and no interval but 'ci95'."
            )

    @property
    def _axes(self) -> tuple[str, ...]:
        return (*self.rows, *self.columns)


SHOWN: Final = ("model", "base-parameters", "torques", "motion", "online")
DRAWN: Final = ("torques", "motion", "online")
"""Things that a [[paper]] entry shows, and those of them that are figures."""


class Paper(SuiteTable):
    """A table or figure as papers print it: `model` (bodies and joints), `base-parameters` with the
    values of a cell, `torques` measured and predicted along a test log, `motion` of the training
    with its limits, `online` (torques and parameters of an on-line estimate over time)."""

    name: Folder  # name of its files
    show: Annotated[str, choice_of("thing to show", SHOWN)]  # one of these
    title: StrictStr = ""  # heading
    select: RowCondition | None = None  # the first cell that meets it
    test: StrictStr | None = None  # name of the test log of a figure; default: the first


class MacroEntry(SuiteTable):
    """One number of a paper's prose as a LaTeX macro with a name of the suite, in
    tables/macros.tex: it does not change with the labels of cells."""

    name: Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z]{2,}$")]  # \\name
    metric: CellMetric = "torque_error"  # metric of the cells
    stat: Annotated[str, choice_of("statistic", STATISTICS)] = "median"
    """Statistic over the cells that meet `select`."""
    select: RowCondition | None = None  # condition on rows


class RankingEntry(SuiteTable):
    """Comparison of methods over robots; one ranking for each value of the labels `apart`."""

    name: Folder  # name of its files
    title: StrictStr | None = None  # heading; default: the name
    metric: RankedMetric = "torque_error"  # error that is compared
    apart: tuple[Label, ...] = ()  # labels of which each value has a ranking of its own
    against: StrictStr = REFERENCE  # the method that all ratios refer to
    family: tuple[StrictStr, ...] = ()
    """Methods whose comparisons Holm's correction is over, declared before the run; none: all."""
    margin: Annotated[Any, quantity_of("%", positive=True)] = MARGIN
    """Largest difference of an equivalent method."""
    unconverged: Annotated[str, choice_of("way to count unconverged answers", UNCONVERGED)] = (
        "accepted"
    )
    """Answers that have not converged count as they are, or as the reference."""
    select: RowCondition | None = None  # condition on rows
