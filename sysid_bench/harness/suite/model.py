"""Keys of a suite file. Values stay as written; units and names are checked."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainValidator,
    StrictBool,
    StrictFloat,
    StrictInt,
    StrictStr,
    ValidationInfo,
    model_validator,
)

from sysid_bench.errors import unknown_name
from sysid_bench.evaluation.intervals import LEVEL
from sysid_bench.experiments.spec import MOTIONS, PLANT
from sysid_bench.harness.suite.checks import (
    check_input,
    check_list,
    choice_of,
    condition,
    key_list,
    list_of,
    list_values,
    quantity_of,
    value_of,
)
from sysid_bench.harness.suite.data_entries import (
    Candidate,
    Estimator,
    Excitation,
    Filters,
    Load,
    LogPrior,
    Named,
    Noise,
    Pipeline,
    Plant,
    Plugin,
    Prior,
    PriorChoice,
    Signals,
    Simulation,
)
from sysid_bench.harness.suite.dataset_tables import Share, check_log, dataset_tables
from sysid_bench.harness.suite.names import PlannedTask
from sysid_bench.harness.suite.report_entries import (
    CellMetric,
    Claim,
    Folder,
    Label,
    MacroEntry,
    Paper,
    RankingEntry,
    RowCondition,
    SuiteTable,
    TableEntry,
)
from sysid_bench.metrics import METRICS, metric_from_record, metric_of_plugin, metric_record
from sysid_bench.models.manifest import TERM_ADVICE, TERMS, is_term
from sysid_bench.plugin_names import known, resolve_files
from sysid_bench.signals.log_description import name_of
from sysid_bench.signals.log_keys import ControllerKeys
from sysid_bench.types import Metric
from sysid_bench.words import FINDINGS

MOST_MOTIONS: Final = 1000

PlanCondition = Annotated[str, PlainValidator(partial(condition, False))]


Sweep = BeforeValidator(list_of)
ListSweep = BeforeValidator(key_list)


Pipelines = Annotated[tuple[Annotated[Pipeline, Named], ...], Sweep]


def _term(value: Any) -> Any:
    if not isinstance(value, str) or not is_term(value):
        raise ValueError(str(unknown_name("joint term", str(value), TERMS, TERM_ADVICE)))
    return value


Terms = tuple[Annotated[str, BeforeValidator(_term)], ...] | None


def _recorded_term(value: Any) -> Any:
    return value if value in known("term") else _term(value)


RecordedTerms = tuple[Annotated[str, BeforeValidator(_recorded_term)], ...] | None
"""Joint terms, and the features that recordings may have in their place."""


def _motions(value: Any) -> Any:
    values = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    if not values:
        raise ValueError("scores need at least one held-out motion, as 'ptp'.")
    return values


def _definition(value: Any, info: ValidationInfo) -> PlannedTask:
    if not isinstance(value, str):
        raise ValueError(
            f"a task is a name, 'module:Class' or 'file:mine.py:Class'; got {value!r}."
        )
    context = check_input(info)
    return value_of(lambda: context.names.task(value, context.folder))


def _task(value: Any, info: ValidationInfo) -> str:
    _definition(value, info)
    return str(value)


def _task_of_recordings(value: Any, info: ValidationInfo) -> str:
    if not _definition(value, info).supports_recordings:
        raise ValueError(
            f"the task {value!r} cannot be identified from recordings; 'robot', 'payload', "
            "'wrench' and 'actuators' can."
        )
    return str(value)


class DefaultSettings(SuiteTable):
    """Sweeps: each key but `candidate` holds a tuple of values."""

    task: Annotated[tuple[Annotated[str, PlainValidator(_task)], ...], Sweep] = ("robot",)
    """What is unknown: `sysid-bench list tasks`."""
    plant: Annotated[tuple[Annotated[Plant, Named], ...], Sweep] = Field(
        default=("matched",), validate_default=True
    )
    """What moves: an effect, a realism level L0 to L4, a file of your own."""
    terms: Annotated[tuple[Terms, ...], ListSweep] = (None,)
    """Joint terms that are identified; default: the robot's own."""
    prior: Annotated[tuple[PriorChoice, ...], Sweep] = (Prior(),)
    """What methods are told of the parameters beforehand: a table, `truth` or `none`."""
    excitation: Annotated[tuple[Annotated[Excitation, Named], ...], Sweep] = Field(
        default=("fourier",), validate_default=True
    )
    """The training motion: `sysid-bench list excitations`."""
    motions: Annotated[tuple[Annotated[StrictInt, Field(ge=1, le=MOST_MOTIONS)], ...], Sweep] = (1,)
    """Different training motions, recorded one after the other."""
    redrawn: Annotated[
        tuple[Annotated[str, choice_of("part that repeats draw anew", (MOTIONS, PLANT))], ...],
        BeforeValidator(list_values),
    ] = ()
    """What differs from repeat to repeat besides the noise."""
    held_out: Annotated[
        tuple[Annotated[tuple[Annotated[Excitation, Named], ...], BeforeValidator(_motions)], ...],
        ListSweep,
    ] = Field(default=(("fourier-other", "ptp"),), validate_default=True)
    """Motions of the scores, which no method sees."""
    simulation: Annotated[tuple[Annotated[Simulation, Named], ...], Sweep] = Field(
        default=("inverse",), validate_default=True
    )
    """`inverse`: the motion is followed exactly; `closed-loop`: under a controller."""
    rate: Annotated[tuple[Annotated[Any, quantity_of("Hz", positive=True)], ...], Sweep] = (
        "200 Hz",
    )
    """Sampling rate of the recording."""
    noise: Annotated[tuple[Noise, ...], Sweep] = (Noise(),)
    """Noise of the recorded signals; `{}` is none."""
    signals: Annotated[tuple[Signals, ...], Sweep] = (Signals(),)
    """Filter and derivatives, and what else is done to the recorded signals."""
    pipeline: Pipelines | None = None
    """From signals to rows of the regressor; default: by `signals` and noise, else `parallel`."""
    candidate: Candidate = Candidate()  # simulator of the methods that simulate

    def of(self, plant: Plant) -> tuple[
        tuple[Simulation, ...], tuple[Noise, ...], tuple[Pipeline | None, ...]
    ]:  # fmt: skip
        """Return the simulations, kinds of noise and pipelines of a plant: its own, else these; a
        pipeline is None where none is named."""
        return (
            self.simulation if plant.simulation is None else (plant.simulation,),
            self.noise if plant.noise is None else (plant.noise,),
            self.pipeline or (None,) if plant.pipeline is None else (plant.pipeline,),
        )


def _robot_name(value: Any, info: ValidationInfo) -> str:
    if not isinstance(value, str):
        raise ValueError(f"a robot is a name or a path; got {value!r}.")
    value_of(lambda: check_input(info).names.robot(value, check_input(info).folder))
    return value


def _sensor(value: str | None, info: ValidationInfo) -> str | None:
    names, folder = check_input(info).names, check_input(info).folder
    if value is not None:
        for source in info.data.get("use", ()):
            value_of(partial(names.sensor, source, folder, value))
    return value


class RobotEntry(SuiteTable):
    use: Annotated[tuple[Annotated[str, PlainValidator(_robot_name)], ...], Sweep]
    """Robots by name, path or package, as the command line takes them."""
    payloads: Annotated[tuple[Load, ...], Sweep] = ("none",)
    """Names, or tables with `mass`, `com` and `inertia`."""
    free_base: StrictBool | None = None  # None: as the robot's manifest has it
    sensor: Annotated[StrictStr | None, AfterValidator(_sensor)] = None
    """Of the manifest, or a fixed joint, site or body to cut at; several: "left, right"."""


def _log(value: Any, info: ValidationInfo) -> Any:
    if not isinstance(value, (str, Mapping)):
        raise ValueError(f"a log is a file of its own, or a table with its keys; got {value!r}.")
    if not check_input(
        info
    ).names.frozen:  # the files of a frozen suite were checked when it was planned
        folder = check_input(info).folder
        value_of(lambda: check_log(value, folder or Path()))
    return value


Logs = tuple[Annotated[Any, PlainValidator(_log)], ...]


def _candidate(value: Any) -> Any:
    if not isinstance(value, str):
        raise ValueError(f"a term or feature is a word, as 'play' or 'offset'; got {value!r}.")
    return value


Choices = tuple[Annotated[str, PlainValidator(_candidate)], ...]


class LogEntry(SuiteTable):
    """Recordings of a real robot; `filter`, `moving`, `pipeline`, `prior`, `terms`, `choose` and
    `share` may be sweeps. `share`: the first part of each training log that is used. A table with
    `dataset` in place of `robot`, `train` and `test` becomes one for each data set."""

    robot: Annotated[Any, PlainValidator(_robot_name)]
    """Name or path of the robot that was recorded."""
    name: StrictStr | None = None  # label of its rows; default: its training logs
    train: Annotated[Logs, Sweep]  # log descriptions that are identified from
    test: Annotated[Logs, BeforeValidator(list_values)] = ()  # log descriptions of the scores
    task: Annotated[str, PlainValidator(_task_of_recordings)] = "robot"
    """`robot`, `payload`, `wrench` or `actuators`."""
    terms: Annotated[tuple[RecordedTerms, ...], ListSweep] = (None,)
    """Joint terms and features; default: the robot's own."""
    choose: Annotated[tuple[Choices, ...], ListSweep] = ((),)
    """Candidates of terms and features, taken where they reduce the error on parts left out."""
    filter: Annotated[Filters, Sweep] = ("default",)
    """Filter of positions and torques; `default` chooses by the rate."""
    derivatives: Annotated[str, choice_of("way to differentiate", ("from q", "from v"))] | None = (
        None
    )
    """Rates from positions, or from recorded velocities; default: by what is recorded."""
    moving: Annotated[tuple[float, ...], Sweep] = (0.0,)
    """Rows of a slower joint are left out (rad/s, m/s)."""
    pipeline: Pipelines | None = None  # from signals to rows of the regressor; default: `parallel`
    prior: Annotated[tuple[LogPrior, ...], Sweep] = ("model",)
    """A table of spreads about the model file's values, `model` or `none`; of actuators also
    "published:NAME"."""
    share: Annotated[tuple[Share, ...], Sweep] = (1.0,)
    """First part of each training log that is used."""
    controller: ControllerKeys | None = None  # of the training logs; None: as each declares
    feasible: Annotated[str, choice_of("choice of feasibility", ("terms", "bodies"))] = "terms"
    """`bodies` leaves the signs of joint terms free."""
    accept: tuple[Annotated[str, choice_of("finding", FINDINGS)], ...] = ()
    """Findings that are no error for these logs."""
    position_given: StrictBool = False  # task `payload`: the mass alone is unknown
    true_mass: Annotated[Any, quantity_of("kg", positive=True)] = None
    """Mass of the payload on a scale, for scores."""

    @property
    def label(self) -> str:
        """Label of its rows: its name, or its training logs."""
        return self.name or " + ".join(name_of(log) for log in self.train)


class _Exclude(SuiteTable):
    when: PlanCondition  # condition on cells that are not run
    reason: StrictStr  # reason, counted and shown


class Crosscheck(SuiteTable):
    tolerance: Annotated[Any, quantity_of("1", positive=True)] = 1e-12  # largest gap to Pinocchio
    on_fail: Annotated[
        str, choice_of("answer to a failed cross-check", ("skip-robot", "continue"))
    ] = "skip-robot"
    """What happens to a robot beyond it."""


def _metric(thing: object, record: Mapping[str, Any] | None) -> Metric:
    """Metric of a look-up, which gives its record where its code runs in another process."""
    if thing is None or isinstance(thing, Mapping):
        return metric_from_record(thing or record or {})
    return metric_of_plugin(thing)


class MetricEntry(Plugin):
    """A metric of the user's own; `record` (title, unit, direction) is written when the suite is
    frozen, so that reports need no plug-in."""

    kind = "metric"
    record: dict[str, Any] | None = None

    @model_validator(mode="before")
    @classmethod
    def _recorded(cls, value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, Mapping) or "use" not in value:
            return value
        context, record = check_input(info), value.get("record")
        found: list[Metric] = []

        def register() -> None:
            spec = {key: setting for key, setting in value.items() if key != "record"}
            thing = None
            if record is None or not context.names.frozen:
                thing = context.names.plugin("metric", resolve_files(spec, context.folder))
            found.append(context.add_metric(_metric(thing, record)))

        value_of(register)
        return {**value, "record": metric_record(found[0])}

    @property
    def metric(self) -> Metric:
        """The metric without its code."""
        return metric_from_record(self.record or {})


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
    estimator: Annotated[tuple[Estimator, ...], BeforeValidator(check_list)]  # methods
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
