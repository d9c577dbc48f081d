"""Entries of a suite: plug-ins with their settings, payloads, noise, prior, signals."""

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Annotated, Any, ClassVar

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Discriminator,
    PlainValidator,
    StrictBool,
    StrictStr,
    Tag,
    ValidationInfo,
    model_validator,
)

from sysid_bench.canonical_json import canonical
from sysid_bench.errors import unknown_name
from sysid_bench.experiments.simulated.composed_plant import plant_entries, size_limits
from sysid_bench.experiments.spec import checks_limits, without_limits
from sysid_bench.harness.suite.checks import (
    CheckInput,
    check_input,
    choice_of,
    plugin_kind,
    quantity_of,
    to_plugin,
    value_of,
)
from sysid_bench.harness.suite.dataset_tables import SIGNALS, with_plant_file
from sysid_bench.harness.suite.report_entries import SuiteTable
from sysid_bench.plugin_names import resolve_files
from sysid_bench.signals.filter import filter_of
from sysid_bench.units import interval, quantity
from sysid_bench.words import INTEGRATORS, PUBLISHED, UNKNOWN

FRICTION = ("sticking", "smooth")

Share = Annotated[Any, quantity_of("%")]
Length = Annotated[Any, quantity_of("mm")]


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


class Candidate(SuiteTable):
    """Simulator of the methods that simulate: time step (none: the control period), integrator,
    and Coulomb friction that sticks, or the smooth tanh(v / v0)."""

    step: Annotated[Any, quantity_of("s", positive=True)] = None
    """Time step; default: the control period."""
    integrator: Annotated[str, choice_of("integrator", INTEGRATORS)] = "auto"
    """Integrator of MuJoCo."""
    friction: Annotated[str, choice_of("friction of a candidate", FRICTION)] = "sticking"
    """Coulomb friction that sticks, or tanh(v / v0)."""


def _friction(value: Any) -> Any:
    """A share, or "unknown"."""
    if value != UNKNOWN:
        value_of(lambda: quantity(value, "%"))
    return value


class Prior(SuiteTable):
    """Standard deviations of the prior around the truth; `known` those of the parameters that the
    task takes as given, which are exact without it. `declared`: methods are given the deviations
    times this factor."""

    mass: Share = "20 %"  # of each body
    com: Length = "15 mm"  # of each centre of mass, per axis
    inertia: Share = "30 %"  # of principal moments
    terms: Share = "30 %"  # of joint terms
    axes: Annotated[Any, quantity_of("deg")] = None  # of inertias; none: half of `inertia`, in rad
    friction: Annotated[Any, PlainValidator(_friction)] = None  # "unknown"; none: as `terms`
    declared: Annotated[Any, quantity_of("1", positive=True)] = None
    known: Share = None
    redrawn: StrictBool | None = None  # true: another draw with each repeat


class ModelSpread(SuiteTable):
    """Standard deviations of a model file's inertial parameters as the prior of a recording; of the
    centre of mass a share of the body's size, and of joint terms a wide one, unless stated."""

    mass: Share = "20 %"  # of each body
    com: Length = None  # of each centre of mass; default: a share of the body's size
    inertia: Share = "30 %"  # of principal moments
    terms: Share = None  # of joint terms; default: wide


def _filter(value: Any) -> str:
    text = str(value)
    if text == "default":  # recordings choose a filter by their rate
        return text
    value_of(lambda: filter_of(text))
    return text


Filters = tuple[Annotated[str | None, PlainValidator(_filter)], ...]


def _payload(value: Any, info: ValidationInfo) -> Any:
    if not isinstance(value, (str, Mapping)):
        raise ValueError(f"a payload is a name or a table {{ mass = ... }}; got {value!r}.")
    value_of(lambda: check_input(info).names.payload(value))
    return value


Load = Annotated[Any, PlainValidator(_payload)]
Loads = tuple[Load, ...] | None


def _runs(value: Any) -> Any:
    if not isinstance(value, str) or not value or set(value) - {"A", "B"} or "B" not in value:
        raise ValueError(
            "runs are recordings of the same motion in the order taken, A without and B with the "
            f"payload, one B at least: 'B', 'AB', 'ABBA'; got {value!r}."
        )
    return value


def _contacts(value: Any) -> Any:
    if value != "detect":
        texts = [value] if isinstance(value, str) else list(value)
        value_of(lambda: [interval(text) for text in texts])
        return texts
    return value


class Signals(SuiteTable):
    """Settings of the pipeline `plain` (`filter`, `derivatives`, `torque`), and what is done to
    signals besides. A frozen suite keeps None: written settings choose `plain`."""

    filter: Annotated[str | None, PlainValidator(_filter)] = None  # "none"
    derivatives: Annotated[str, choice_of("way to differentiate", ("from q", "exact"))] | None = (
        None  # "exact"
    )
    torque: Annotated[str, choice_of("way to take torque", ("filtered", "raw"))] | None = (
        None  # "filtered"
    )
    runs: Annotated[str, BeforeValidator(_runs)] = "B"  # A without, B with the payload
    contacts: Annotated[Any, PlainValidator(_contacts)] = None
    """Periods that are left out: "10 s to 25 s", a list of them, or "detect"."""
    calibration: Loads = None  # of force/torque sensors in situ, with these known payloads


def _log_prior(value: Any) -> str:
    if isinstance(value, str) and value.startswith(PUBLISHED) and value != PUBLISHED:
        return value
    known = ("model", "none", f"{PUBLISHED}NAME")
    if value not in known[:2]:
        raise ValueError(str(unknown_name("prior of a recording", str(value), known)))
    return str(value)


PriorChoice = Annotated[
    Annotated[Prior, Tag("table")]
    | Annotated[str, choice_of("prior", ("truth", "none")), Tag("word")],
    Discriminator(plugin_kind),
]

LogPrior = Annotated[
    Annotated[ModelSpread, Tag("table")] | Annotated[str, PlainValidator(_log_prior), Tag("word")],
    Discriminator(plugin_kind),
]


class Plugin(SuiteTable):
    """A plug-in: its name and its settings."""

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)
    kind: ClassVar[str] = ""
    use: StrictStr  # name, `module:object` or `file:mine.py:Class`

    @property
    def spec(self) -> dict[str, Any]:
        """Return {use, settings...}, without a label."""
        return {"use": self.use, **(self.model_extra or {})}

    def _looked_up(self) -> Iterable[tuple[str, Mapping[str, Any]]]:
        """Return (kind, {use, settings}) of each plug-in that this entry needs."""
        return [(self.kind, self.plugin_spec)]

    @model_validator(mode="after")
    def known(self, info: ValidationInfo) -> "Plugin":
        value_of(lambda: canonical(self.spec))  # ids are made of JSON: TOML dates are refused
        context = check_input(info)
        for kind, spec in value_of(self._looked_up):
            value_of(partial(context.names.plugin, kind, resolve_files(spec, context.folder)))
        return self

    @property
    def plugin_spec(self) -> dict[str, Any]:
        """Return {use, settings...} as the plug-in is given them."""
        return self.spec


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

    @property
    def plugin_spec(self) -> dict[str, Any]:
        """Return the specification without the rule for limits, which is not the plug-in's."""
        return without_limits(self.spec)

    @model_validator(mode="after")
    def _rule_for_limits(self) -> "Excitation":
        value_of(lambda: checks_limits(self.spec))
        return self


class Simulation(Plugin):
    kind = "simulation"


class Pipeline(Plugin):
    kind = "pipeline"


Named = BeforeValidator(to_plugin)


def _check_parts(plant: Mapping[str, Any], context: CheckInput) -> None:
    """Look up each effect and error of a plant, ranges at either limit."""
    for kind, spec in value_of(partial(plant_entries, plant)):
        for settings in value_of(partial(size_limits, spec)):
            found = resolve_files(settings, context.folder)
            value_of(partial(context.names.plugin, kind, found))


class Plant(Plugin):
    """An effect, or {use = "composed"} with lists of effects, model errors and sensor errors; a
    size may be drawn from a range. A plant file is read when the suite is. `simulation`, `noise`
    and `pipeline` hold for this plant in place of those of the suite."""

    kind = "plant"
    simulation: Annotated[Simulation | None, Named] = None
    noise: Noise | None = None
    pipeline: Annotated[Pipeline | None, Named] = None

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
            _check_parts(own, context)
        return read

    def _looked_up(self) -> Iterable[tuple[str, Mapping[str, Any]]]:
        """Return (kind, {use, settings}) of each effect and error, ranges at either limit."""
        return [
            (kind, settings)
            for kind, spec in plant_entries(self.spec)
            for settings in size_limits(spec)
        ]


def prior_table(prior: Prior | ModelSpread | str) -> str | dict[str, Any]:
    """Return a prior as its words or keys."""
    return prior if isinstance(prior, str) else prior.model_dump(exclude_none=True)
