"""Keys of a suite file. Values stay as written; units and names are checked."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    PlainValidator,
    StrictFloat,
    StrictInt,
    StrictStr,
    model_validator,
)

from sysid_bench.evaluation.intervals import LEVEL
from sysid_bench.harness.suite.checks import (
    Folder,
    RowCondition,
    SuiteTable,
    choice_of,
    condition,
    quantity_of,
)
from sysid_bench.harness.suite.data_entries import DefaultSettings, RobotEntry
from sysid_bench.harness.suite.log_entries import LogEntry, dataset_tables
from sysid_bench.harness.suite.plugin_entries import Estimator, MetricEntry
from sysid_bench.harness.suite.report_entries import (
    CellMetric,
    Claim,
    Label,
    MacroEntry,
    Paper,
    RankingEntry,
    TableEntry,
)
from sysid_bench.metrics import METRICS
from sysid_bench.types import Metric


def _some(value: Any) -> Any:
    # Not min_length of pydantic: it reports a second error where all elements are wrong.
    if isinstance(value, (list, tuple)) and not value:
        raise ValueError("a suite needs at least one.")
    return value


class _Exclude(SuiteTable):
    when: Annotated[
        str, PlainValidator(partial(condition, False))
    ]  # condition on cells that are not run
    reason: StrictStr  # reason, counted and shown


class Crosscheck(SuiteTable):
    tolerance: Annotated[Any, quantity_of("1", positive=True)] = 1e-12  # largest gap to Pinocchio
    on_fail: Annotated[
        str, choice_of("answer to a failed cross-check", ("skip-robot", "continue"))
    ] = "skip-robot"
    """Treatment of a robot beyond it."""


class _Worst(SuiteTable):
    metric: CellMetric  # metric by which cells are the worst
    count: StrictInt = Field(default=1, ge=1)  # how many are recorded
    per: Label | None = None  # a label: so many for each of its values


class Record(SuiteTable):
    when: RowCondition | None = None  # condition on rows that are recorded
    worst: _Worst | None = None  # cells with the largest value of a metric
    max_hz: Annotated[Any, quantity_of("Hz", positive=True)] = 50.0  # largest rate of a recording


class Run(SuiteTable):
    timeout: Annotated[Any, quantity_of("s", positive=True)] = "60 s"
    """Hard limit of a cell; its worker is ended."""
    memory: Annotated[Any, quantity_of("B", positive=True)] = "4 GB"  # hard limit of a worker
    threads: StrictInt = Field(default=1, ge=1)  # BLAS threads of a worker
    repeats: StrictInt = Field(default=1, ge=1)  # draws of the noise


class Origin(SuiteTable):
    """Origin of a suite: its folder, the user's robots, the typed command, and the words of this
    command that chose some of the cells."""

    folder: StrictStr  # folder that paths are relative to
    robots: StrictStr | None = None  # folder of the user's robots
    command: StrictStr | None = None  # the command as typed
    selection: tuple[StrictStr, ...] = ()  # words of the command that chose cells
    rows: Literal["hashed"] | None = None  # "hashed": a row without its hash is refused


class Suite(SuiteTable):
    """A suite with every key filled in, sweeps as tuples, quantities as written."""

    schema_: Annotated[Literal[1], Field(alias="schema")]  # version of the keys
    name: Folder  # name of the run folder
    title: StrictStr = ""  # one line about the suite
    seed: StrictInt = Field(default=0, ge=0)  # root of all random numbers
    confidence: StrictFloat = Field(default=LEVEL, gt=0, lt=1)  # level of all intervals
    origin: Origin | None = None  # written when a suite is frozen in its run folder
    run: Run = Run()  # limits and repeats
    defaults: DefaultSettings = Field(default={}, validate_default=True)  # what is swept
    robot: tuple[RobotEntry, ...] = ()  # robots and their payloads
    log: Annotated[tuple[LogEntry, ...], BeforeValidator(dataset_tables)] = ()
    """Recordings of real robots."""
    estimator: Annotated[tuple[Estimator, ...], BeforeValidator(_some)]  # methods
    metric: tuple[MetricEntry, ...] = ()  # metrics of your own
    exclude: tuple[_Exclude, ...] = ()  # cells that are left out, with the reason
    crosscheck: Crosscheck = Crosscheck()  # check of each robot before its cells
    table: tuple[TableEntry, ...] = ()  # tables of the report
    paper: tuple[Paper, ...] = ()  # tables and figures as papers print them
    ranking: tuple[RankingEntry, ...] = ()  # comparisons of methods over robots
    claim: tuple[Claim, ...] = ()  # published statements to test
    macro: tuple[MacroEntry, ...] = ()  # numbers of a paper's prose
    record: Record | None = None  # cells whose recordings are written

    @model_validator(mode="after")
    def _not_empty(self) -> "Suite":
        if self.log:
            return self
        if not self.robot:
            raise ValueError(
                "robot: this key is missing, and so is log; a suite needs at least one [[robot]] "
                "to simulate, or a [[log]] of a real one."
            )
        figures = [entry.name for entry in self.paper if entry.show == "torques"]
        if figures:
            raise ValueError(
                f"paper: {', '.join(figures)} shows torques along a test log; this suite has no "
                "[[log]]."
            )
        return self

    @property
    def folder(self) -> Path:
        """Folder from which relative robots and plug-in files are found."""
        return Path(self.origin.folder) if self.origin else Path()

    @property
    def metrics(self) -> dict[str, Metric]:
        """All metrics that tables may name: built-in ones and those of [[metric]]."""
        return {**METRICS, **{entry.metric.name: entry.metric for entry in self.metric}}

    @property
    def robots_folder(self) -> Path | None:
        """Folder of the user's own robots, with which the run was started."""
        return Path(self.origin.robots) if self.origin and self.origin.robots else None

    @property
    def robots(self) -> tuple[tuple[RobotEntry, str], ...]:
        """Pairs of a [[robot]] table and each robot that it names."""
        return tuple((entry, source) for entry in self.robot for source in entry.use)
