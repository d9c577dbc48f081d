"""Entries of a suite that name plug-ins with their settings; plants, their noise and files."""

from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from pydantic import BeforeValidator, ConfigDict, StrictStr, ValidationInfo, model_validator

from sysid_bench import package_folders, plugin_names
from sysid_bench.canonical_json import canonical
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.simulated.composed_plant import (
    COMPOSED,
    KIND_OF,
    plant_entries,
    size_limits,
)
from sysid_bench.experiments.spec import SEALED, checks_limits, without_limits
from sysid_bench.harness.suite.checks import SuiteTable, Value, check_input, quantity_of, value_of
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.metrics import metric_from_record, metric_of_plugin, metric_record
from sysid_bench.plugin_names import resolve_files
from sysid_bench.types import Metric

SCHEMA: Final = 1
"""Version of the format of plant files."""
SIGNALS: Final = plugin_names.RESERVED["plant"]
"""Keys of a plant that hold in place of those of the suite."""

_Entries = Iterable[tuple[str, Mapping[str, Any]]]
"""(kind, {use, settings}) of plug-ins."""


class Plugin(SuiteTable):
    """A plug-in: its name and its settings."""

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)
    kind: ClassVar[str] = ""
    use: StrictStr  # name, `module:object` or `file:mine.py:Class`

    @property
    def spec(self) -> dict[str, Any]:
        """Return {use, settings...}, without a label."""
        return {"use": self.use, **(self.model_extra or {})}

    def _looked_up(self) -> _Entries:
        """Return the plug-ins that this entry needs."""
        return [(self.kind, self.spec)]

    @model_validator(mode="after")
    def known(self, info: ValidationInfo) -> "Plugin":
        value_of(lambda: canonical(self.spec))  # ids are made of JSON: TOML dates are refused
        _check_known(value_of(self._looked_up), info)
        return self


def _check_known(entries: _Entries, info: ValidationInfo) -> None:
    context = check_input(info)
    for kind, spec in entries:
        found = resolve_files(spec, context.folder)
        value_of(partial(context.names.plugin, kind, found))


class Estimator(Plugin):
    kind = "estimator"
    label: StrictStr | None = None  # name in tables

    @model_validator(mode="after")
    def _no_reserved_keys(self) -> "Estimator":
        if "cell" in (self.model_extra or {}):
            raise ValueError("'cell' cannot be a setting of an estimator: it names the row.")
        return self


class Excitation(Plugin):
    kind = "excitation"

    def _looked_up(self) -> _Entries:
        return [(self.kind, without_limits(self.spec))]  # the rule for limits is not the plug-in's

    @model_validator(mode="after")
    def _rule_for_limits(self) -> "Excitation":
        value_of(lambda: checks_limits(self.spec))
        return self


class Simulation(Plugin):
    kind = "simulation"


class Pipeline(Plugin):
    kind = "pipeline"


def _named(value: Any) -> Any:
    return {"use": value} if isinstance(value, str) else value


Named = Annotated[Value, BeforeValidator(_named)]
"""A plug-in by its name alone, or with settings."""


class Noise(SuiteTable):
    """Standard deviations of noise. `quantum` is the step of the encoder, `tau_correlation` the
    correlation of the torque's noise between successive samples (0: white)."""

    q: Annotated[Any, quantity_of("rad|m")] = None  # position
    tau: Annotated[Any, quantity_of("N m|N|%")] = None  # torque or force; % of the RMS of the joint
    quantum: Annotated[Any, quantity_of("rad|m")] = None
    tau_drift: Annotated[Any, quantity_of("N m|N")] = None  # per second
    tau_correlation: Annotated[Any, quantity_of("1", below=1.0)] = None
    force: Annotated[Any, quantity_of("N")] = None  # force/torque sensors, down to `touch`
    moment: Annotated[Any, quantity_of("N m")] = None  # of force/torque sensors, per axis
    force_offset: Annotated[Any, quantity_of("N")] = None  # constant of the sensor, drawn per axis
    moment_offset: Annotated[Any, quantity_of("N m")] = None
    """Constant of the sensor, drawn per axis."""
    force_drift: Annotated[Any, quantity_of("N")] = None  # per second
    moment_drift: Annotated[Any, quantity_of("N m")] = None  # per second
    gain: Annotated[Any, quantity_of("%")] = None  # error of the gain of each axis
    crosstalk: Annotated[Any, quantity_of("%")] = None  # error from the other axes
    mounting: Annotated[Any, quantity_of("rad")] = None  # rotation of the sensor
    touch: Annotated[Any, quantity_of("N")] = None  # on the last body, for the middle third


class Plant(Plugin):
    """An effect, or {use = "composed"} with lists of effects, model errors and sensor errors; a
    size may be drawn from a range. A plant file is read when the suite is. `simulation`, `noise`
    and `pipeline` hold for this plant in place of those of the suite."""

    kind = "plant"
    simulation: Named[Simulation | None] = None
    noise: Noise | None = None
    pipeline: Named[Pipeline | None] = None

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, value: Any, info: ValidationInfo) -> Any:
        context = check_input(info)
        if context.names.frozen:  # plant files were read when the suite was planned
            return value
        read = value_of(lambda: with_plant_file(value, context.folder))
        if isinstance(read, Mapping) and not read.keys().isdisjoint(SIGNALS):
            # Before these keys are read as the plant's own: an effect may mean something else.
            own = {key: x for key, x in read.items() if key not in (*SIGNALS, "label")}
            _check_known(value_of(lambda: _parts(own)), info)
        return read

    def _looked_up(self) -> _Entries:
        return _parts(self.spec)


def _parts(plant: Mapping[str, Any]) -> _Entries:
    """Each effect and error of a plant, ranges at either limit."""
    return [
        (kind, settings) for kind, spec in plant_entries(plant) for settings in size_limits(spec)
    ]


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

        def metric() -> Metric:
            thing = None
            if record is None or not context.names.frozen:
                spec = {key: setting for key, setting in value.items() if key != "record"}
                thing = context.names.plugin("metric", resolve_files(spec, context.folder))
            if thing is None or isinstance(thing, Mapping):  # its code runs in another process
                return context.add_metric(metric_from_record(thing or record or {}))
            return context.add_metric(metric_of_plugin(thing))

        return {**value, "record": metric_record(value_of(metric))}

    @property
    def metric(self) -> Metric:
        """The metric without its code."""
        return metric_from_record(self.record or {})


def with_plant_file(written: Any, folder: Path | None) -> Any:
    """Return the plant of a suite with the keys of the file that it names; keys beside `use`
    replace those of the file. Anything else is returned as it is.

    Relative paths are found from `folder`. Raises UsageError for a file that cannot be read, for
    unknown keys, and for a name of neither a plant file nor an effect.
    """
    if not isinstance(written, Mapping) or not isinstance(written.get("use"), str):
        return written
    use, files = written["use"], package_folders.plant_files()
    if use.startswith("file:") and use.endswith(".toml"):
        data = read_plant((folder or Path()) / use.removeprefix("file:"))
    elif use in files:
        data = read_plant(files[use])
    else:
        # "module:object" and "file:path.py:object" are looked up elsewhere.
        names = (*files, COMPOSED, *plugin_names.known("plant"))
        if ":" not in use and use not in names:
            raise unknown_name("plant", use, names)
        return written
    own = {key: value for key, value in written.items() if key != "use"}
    allowed = (*KIND_OF, *SIGNALS, "label")
    for key in own:
        if key not in allowed:
            raise unknown_name("key of a plant file", key, allowed)
    # The file's content, not its name: cells keep their meaning when the file changes.
    table = {key: value for key, value in data.items() if key not in ("schema", "title")}
    return {**table, **own, "use": COMPOSED}


def read_plant(file: Path) -> dict[str, Any]:
    """Return the keys of a plant file, its name among them.

    Raises UsageError where it cannot be read, for another schema and for unknown keys.
    """
    try:
        data = parse_toml(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"The plant file {str(file)!r} cannot be read: {error}.") from error
    known = ("schema", "name", "title", SEALED, *KIND_OF, *SIGNALS)
    for key in data:
        if key not in known:
            raise UsageError(f"{file}: {unknown_name('key of a plant file', key, known)}")
    if data.get("schema") != SCHEMA:
        raise UsageError(f"{file}: schema = {data.get('schema')!r}; this version reads {SCHEMA}.")
    return {"name": file.stem, **data}
