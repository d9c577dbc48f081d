"""Entries of a suite on recordings: logs, and data sets that stand for a table of them."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import (
    BeforeValidator,
    Discriminator,
    PlainValidator,
    StrictBool,
    StrictStr,
    Tag,
    ValidationInfo,
)

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.harness.suite.checks import (
    ListOf,
    ListSweep,
    SuiteTable,
    Sweep,
    check_input,
    choice_of,
    list_of,
    list_values,
    plugin_kind,
    quantity_of,
    value_of,
)
from sysid_bench.harness.suite.data_entries import (
    Filter,
    Length,
    ModelShare,
    Pipelines,
    check_robot,
    check_task,
    check_term,
)
from sysid_bench.models.data_sets import SCHEME, DataSet, find_dataset, find_motion
from sysid_bench.plugin_names import known
from sysid_bench.signals.log_description import log_description, name_of
from sysid_bench.signals.log_keys import ControllerKeys
from sysid_bench.units import quantity
from sysid_bench.words import FINDINGS, PUBLISHED

DATASET: Final = "dataset"


class ModelSpread(SuiteTable):
    """Standard deviations of a model file's inertial parameters as the prior of a recording; of the
    centre of mass a share of the body's size, and of joint terms a wide one, unless stated."""

    mass: ModelShare = "20 %"  # of each body
    com: Length = None  # of each centre of mass; default: a share of the body's size
    inertia: ModelShare = "30 %"  # of principal moments
    terms: ModelShare = None  # of joint terms; default: wide


def _log_prior(value: Any) -> str:
    if isinstance(value, str) and value.startswith(PUBLISHED) and value != PUBLISHED:
        return value
    known = ("model", "none", f"{PUBLISHED}NAME")
    if value not in known[:2]:
        raise ValueError(str(unknown_name("prior of a recording", str(value), known)))
    return str(value)


LogPrior = Annotated[
    Annotated[ModelSpread, Tag("table")] | Annotated[str, PlainValidator(_log_prior), Tag("word")],
    Discriminator(plugin_kind),
]


def _share(value: Any) -> float:
    """Return a part of a recording, 0.1 of "10 %" and of 0.1."""
    number = value_of(lambda: quantity(value, "1"))
    if not 0 < number <= 1:
        raise ValueError(f"must be above 0 and at most 1 or 100 %; got {value!r}.")
    return number


def _term(value: Any) -> Any:
    """A joint term, or one of the features that recordings may have in its place."""
    return value if value in known("term") else check_term(value)


def _candidate(value: Any) -> Any:
    if not isinstance(value, str):
        raise ValueError(f"a term or feature is a word, as 'play' or 'offset'; got {value!r}.")
    return value


def _log(value: Any, info: ValidationInfo) -> Any:
    if not isinstance(value, (str, Mapping)):
        raise ValueError(f"a log is a file of its own, or a table with its keys; got {value!r}.")
    context = check_input(info)
    if context.names.frozen:  # the files of a frozen suite were checked when it was planned
        return value
    use = value if isinstance(value, str) else str(value.get("use", ""))
    folder = context.folder or Path()
    if use.startswith(SCHEME):  # the recordings of a data set need not be here
        value_of(lambda: find_motion(use, folder))
    else:
        value_of(lambda: log_description(value, folder))
    return value


Terms = tuple[Annotated[str, BeforeValidator(_term)], ...] | None
Choices = tuple[Annotated[str, PlainValidator(_candidate)], ...]
Log = Annotated[Any, PlainValidator(_log)]


class LogEntry(SuiteTable):
    """Recordings of a real robot; `filter`, `moving`, `pipeline`, `prior`, `terms`, `choose` and
    `share` may be sweeps. `share`: the first part of each training log that is used. A table with
    `dataset` in place of `robot`, `train` and `test` becomes one for each data set."""

    robot: Annotated[Any, PlainValidator(check_robot)]
    """Name or path of the robot that was recorded."""
    name: StrictStr | None = None  # label of its rows; default: its training logs
    train: Sweep[Log]  # log descriptions that are identified from
    test: ListOf[Log] = ()  # log descriptions of the scores
    task: Annotated[str, PlainValidator(partial(check_task, recorded=True))] = "robot"
    """`robot`, `payload`, `wrench` or `actuators`."""
    terms: ListSweep[Terms] = (None,)
    """Joint terms and features; default: the robot's own."""
    choose: ListSweep[Choices] = ((),)
    """Candidates of terms and features, taken where they reduce the error on parts left out."""
    filter: Sweep[Filter] = ("default",)
    """Filter of positions and torques; `default` chooses by the rate."""
    derivatives: Annotated[str, choice_of("way to differentiate", ("from q", "from v"))] | None = (
        None
    )
    """Rates from positions, or from recorded velocities; default: by what is recorded."""
    moving: Sweep[float] = (0.0,)
    """Rows of a slower joint are left out (rad/s, m/s)."""
    pipeline: Pipelines | None = None  # from signals to rows of the regressor; default: `parallel`
    prior: Sweep[LogPrior] = ("model",)
    """A table of spreads about the model file's values, `model` or `none`; of actuators also
    "published:NAME"."""
    share: Sweep[Annotated[float, PlainValidator(_share)]] = (1.0,)
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


def dataset_tables(value: Any, info: ValidationInfo) -> Any:
    """Return the [[log]] tables with one of its own for each data set that a table names."""
    if not isinstance(value, (list, tuple)):
        return value
    entries: list[Any] = []
    for written in value:
        if not isinstance(written, Mapping) or DATASET not in written:
            entries.append(written)
            continue
        for source in list_of(written[DATASET]):
            entries += value_of(partial(_tables_of_set, written, str(source), info))
    return tuple(entries)


def _tables_of_set(
    written: Mapping[str, Any], source: str, info: ValidationInfo
) -> list[dict[str, Any]]:
    """Return the table of a data set; of a payload task one for each known payload."""
    if both := [key for key in ("robot", "train", "test") if key in written]:
        raise UsageError(
            f"a data set gives {' and '.join(both)}; name the motions of one as a log, "
            f'train = ["{SCHEME}{source}/MOTION"], or drop the keys.'
        )
    described = find_dataset(source, check_input(info).folder).described
    place = f"{SCHEME}{source}"
    keys = {key: value for key, value in written.items() if key != DATASET}
    common = _common_keys(keys, place, described)
    if keys.get("task") != "payload":
        # The label of a test says how it is related to the training.
        test = [
            {"use": f"{place}/{motion}", "name": f"{motion} ({described.split})"}
            for motion in described.test
        ]
        train = [f"{place}/{motion}" for motion in described.train]
        return [{**common, "train": train, "test": test}]
    if not described.payload:
        raise UsageError(f"the data set {source!r} has no recording with a known payload.")
    return [
        {
            **common,
            "train": [f"{place}/{pair.empty}", f"{place}/{pair.loaded}"],
            "true_mass": pair.mass,
        }
        for pair in described.payload
    ]


def _common_keys(keys: Mapping[str, Any], place: str, described: DataSet) -> dict[str, Any]:
    """The keys that all tables of a data set have: those written, with what the set says."""
    accept = list(dict.fromkeys([*list_values(keys.get("accept", ())), *described.accept]))
    # Rows of data sets have one label: their robot is that of the set.
    common = {"name": "training motions", **keys, "robot": place, "accept": accept}
    if described.pipeline is not None and "pipeline" in keys:
        own, use = described.pipeline, described.pipeline["use"]
        named = list_of(keys["pipeline"])
        common["pipeline"] = [own if one in (use, {"use": use}) else one for one in named]
    if described.choose:
        common["choose"] = _with_terms(keys.get("choose", []), described.choose)
    return common


def _with_terms(written: Any, terms: Sequence[str]) -> Any:
    """The sweep of lists of terms, each with `terms` besides."""
    if not isinstance(written, (list, tuple)):
        return written  # not a list: refused as it is
    lists = list(written)
    sweep = lists if lists and all(isinstance(one, (list, tuple)) for one in lists) else [lists]
    return [list(dict.fromkeys([*one, *terms])) for one in sweep]


def with_dataset(suite: Mapping[str, Any], sources: Sequence[Any]) -> dict[str, Any]:
    """Return a suite with these data sets, names or folders from the current one, in the place of
    those that its [[log]] tables name; of a payload task the sets with a known payload alone.

    Raises UsageError for an unknown set, and for a suite without a table of data sets.
    """
    # Names of sets stay; a place of one's own is found from the current folder now.
    found = [(str(source), find_dataset(str(source))) for source in sources]
    places = [name if one.has_name else f"file:{one.file.resolve()}" for name, one in found]
    tables = list_values(suite.get("log", ()))
    if not any(isinstance(one, Mapping) and DATASET in one for one in tables):
        raise UsageError(
            f"--set {DATASET}: no [[log]] of this suite names a data set; write one with "
            f'{DATASET} = "{sources[0] if sources else "NAME"}".'
        )

    def replaced(written: Any) -> Iterator[Any]:
        """Yield a table with these sets, or nothing where none of them serves its task."""
        if not isinstance(written, Mapping) or DATASET not in written:
            yield written
            return
        loaded = written.get("task") == "payload"
        serve = [one for one in places if not loaded or find_dataset(one).described.payload]
        if serve:
            yield {**written, DATASET: serve}

    return {**suite, "log": [one for table in tables for one in replaced(table)]}
