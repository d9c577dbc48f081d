"""Keys of a suite that make its report: tables, rankings, and figures as papers print them."""

import math
from collections.abc import Callable
from functools import partial
from itertools import chain
from typing import Annotated, Any, Final

from pydantic import (
    BeforeValidator,
    PlainValidator,
    StrictBool,
    StrictStr,
    StringConstraints,
    ValidationInfo,
    model_validator,
)

from sysid_bench import words
from sysid_bench.errors import unknown_name
from sysid_bench.harness.suite.checks import (
    Folder,
    ListOf,
    MetricChoice,
    RowCondition,
    SuiteTable,
    check_input,
    choice_of,
    list_values,
    quantity_of,
    value_of,
)
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.metrics import METRICS, names_of
from sysid_bench.types import Metric
from sysid_bench.words import JOINT, LABELS, PARAMETER, STATISTICS, STD_FROM


def _metric_of(kind: str, accepts: Callable[[Metric], bool]) -> BeforeValidator:
    return BeforeValidator(MetricChoice(kind, accepts))


AnyMetric = Annotated[str, _metric_of("metric", lambda metric: True)]
CellMetric = Annotated[str, _metric_of("metric", lambda metric: metric.level == "cell")]
RankedMetric = Annotated[str, _metric_of("metric to rank by", lambda metric: metric.ranked)]


class TableCells(SuiteTable):
    metric: AnyMetric | None = None  # the one metric of the table
    stat: Annotated[str, choice_of("statistic", STATISTICS)] = "median"
    """Statistic over the cells of an entry."""
    interval: Annotated[str, choice_of("interval", words.INTERVALS)] = "none"  # interval beside it


Label = Annotated[str, choice_of("label of a cell", (*LABELS, "repeat"))]


Axis = Annotated[str, choice_of("label of a cell", (*LABELS, "repeat", PARAMETER, STD_FROM, JOINT))]


class TableEntry(SuiteTable):
    name: Folder  # name of its files
    title: StrictStr | None = None  # heading; default: the name
    rows: tuple[Axis, ...] = ("robot", "payload")  # labels of cells down the side
    columns: tuple[Axis, ...] = ("estimator",)  # labels of cells along the top
    metrics: tuple[AnyMetric, ...] = ()
    """Several, each a column; `cells` then has stat and interval alone."""
    cells: TableCells = TableCells()  # one metric with its statistic
    best: Annotated[str, choice_of("way to mark the best", words.BESTS)] = "none"
    """Mark of the best values of a row."""
    select: RowCondition | None = None  # condition on rows
    effects: StrictBool = False
    """Main effects of rows and columns as ratios: what a pipeline and what a method contributes."""
    baselines: StrictBool = True  # null model and floors beside the torque errors of methods

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
        axes = (*self.rows, *self.columns)
        # A metric of joints or parameters needs their axis, and their axis such metrics alone.
        for axis in dict.fromkeys(words.LEVEL_AXES.values()):
            levels = [level for level, needed in words.LEVEL_AXES.items() if needed == axis]
            if any((metric.level in levels) != (axis in axes) for metric in named):
                names = ", ".join(chain.from_iterable(map(names_of, levels)))
                raise ValueError(
                    f"the metrics {names} and the label {axis!r} among rows or columns go together."
                )
        is_by_repeat = "repeat" in axes or self.cells.interval not in ("none", "ci95")
        repeated = [metric.name for metric in named if metric.level in words.OF_REPEATS]
        if repeated and is_by_repeat:
            raise ValueError(
                f"the metric {repeated[0]!r} is one of all repeats together: it has no value "
                "by repeat, and no interval but 'ci95'."
            )
        return self


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
    against: StrictStr = words.REFERENCE  # the method that all ratios refer to
    family: tuple[StrictStr, ...] = ()
    """Methods that have a verdict, declared before the run; none: all."""
    margin: Annotated[Any, quantity_of("%", positive=True)] = words.MARGIN
    """Largest difference of an equivalent method."""
    unconverged: Annotated[
        str, choice_of("way to count unconverged answers", words.UNCONVERGED)
    ] = "accepted"
    """Answers that have not converged count as they are, or as the reference."""
    select: RowCondition | None = None  # condition on rows


def _condition(rows: bool, text: Any, info: ValidationInfo) -> str:
    """A condition on lines: of cells, or of their joints and kinds of intervals."""
    if not isinstance(text, str):
        raise ValueError(f"a condition is a string; got {text!r}.")
    fields = check_input(info).row_fields | {JOINT, STD_FROM}
    value_of(lambda: Expression.parse(text, fields | set(METRICS if rows else ())))
    return text


def _metric(value: Any, info: ValidationInfo) -> str:
    known = {**METRICS, **check_input(info).metrics}
    levels = ("cell", "joint", "interval")
    there = [name for name, metric in known.items() if metric.level in levels and not metric.text]
    if value not in there and not str(value).startswith("stats."):
        advice = "Or a number that a method returns: stats.NAME, as stats.duality_gap of lmi."
        raise ValueError(str(unknown_name("metric of a claim", str(value), there, advice)))
    return str(value)


def _limits(value: Any) -> tuple[float, ...]:
    limits = list_values(value)
    numbers = [x for x in limits if isinstance(x, (int, float)) and not isinstance(x, bool)]
    if len(numbers) != len(limits) or not all(map(math.isfinite, numbers)):
        raise ValueError(f"a threshold is a number, or [low, high]; got {value!r}.")
    return tuple(map(float, numbers))


_Rows = Annotated[str, PlainValidator(partial(_condition, False))]
_Line = Annotated[str, PlainValidator(partial(_condition, True))]


class Claim(SuiteTable):
    """A claim, tested once for each of its levels, on rows of that plant.

    `ratio` and `difference` pair the rows of `select` with those of `against` that have the same
    labels but for what the two selections compare; `rank` ranks the method of `select` among those
    of `against`; `median` and `coverage` are of a metric, `share` is of the rows that meet `meets`,
    `left-out` of the values of parameters that the 90 % range of all other units holds.
    `over` is what is counted and drawn again: robots, or repeats of a claim on a single robot. Over
    cells there is no interval, and the claim stays open. A `gate` fails unless the claim holds.
    """

    name: Folder  # name in tables
    statement: StrictStr  # the statement in one sentence
    source: StrictStr  # publication
    select: _Rows | None = None  # condition on the rows that it is about
    against: _Rows | None = None  # condition on the rows compared with them
    statistic: Annotated[str, choice_of("statistic of a claim", words.CLAIM_STATISTICS)] = "ratio"
    """Number that is compared with the threshold."""
    metric: Annotated[str, PlainValidator(_metric)] | None = None
    """Metric, or a number that the method counts, as `stats.iterations`."""
    meets: _Line | None = None  # condition whose share is counted
    direction: Annotated[str, choice_of("direction", words.DIRECTIONS)] = "at most"
    """Side of the threshold on which it holds."""
    threshold: Annotated[tuple[float, ...], PlainValidator(_limits)] = ()
    """A number; two for `within`."""
    level: ListOf[Annotated[str, choice_of("level", words.CLAIM_LEVELS)]] = ()
    """Plants that it is tested on, one by one; default: all rows together."""
    over: Annotated[str, choice_of("unit of replication", words.CLAIM_UNITS)] = "robot"
    exact: StrictBool = False
    """A statement of algebra: it holds where every cell meets `meets`, and fails where one does
    not; no interval, no correction."""
    sentence: StrictStr | None = None  # sentence of the source, word for word
    protocol: StrictStr | None = None  # what differs from the source's protocol
    withdrawn: StrictStr | None = None  # reason for which the claim is listed and not tested
    gate: StrictBool = False  # `run --gate` ends with code 1 where it fails
    missing: StrictStr | None = None
    """Requirement of the test that nothing here meets: the claim is not testable."""

    @model_validator(mode="after")
    def _is_complete(self) -> "Claim":
        if self.missing is not None or self.withdrawn is not None:
            if self.gate:
                raise ValueError("a claim that is not tested cannot be a gate.")
            return self
        if self.exact and (self.statistic, self.direction, self.threshold) != (
            "share", "at least", (1.0,),
        ):  # fmt: skip
            raise ValueError(
                "exact = true is a share of 1: statistic = 'share', direction = 'at least', "
                "threshold = 1."
            )
        needed = {
            "select": True,
            "against": self.statistic in words.PAIRED,
            "metric": self.statistic not in ("share", words.LEFT_OUT),
            "meets": self.statistic == "share",
        }
        for key, is_needed in needed.items():
            if (getattr(self, key) is not None) != is_needed:
                verb = "needs" if is_needed else "does not use"
                raise ValueError(f"the statistic {self.statistic!r} {verb} {key!r}.")
        count = 2 if self.direction == "within" else 1
        if len(self.threshold) != count or list(self.threshold) != sorted(self.threshold):
            raise ValueError(
                f"the direction {self.direction!r} needs a threshold of {count} "
                f"number{'s, the lower first' if count > 1 else ''}; got {list(self.threshold)}."
            )
        return self
