"""Entries of a suite on simulated data: robots, payloads, and the axes of its sweeps."""

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    PlainValidator,
    StrictBool,
    StrictInt,
    StrictStr,
    Tag,
    ValidationInfo,
)

from sysid_bench.errors import unknown_name
from sysid_bench.experiments.spec import MOTIONS, PLANT
from sysid_bench.harness.suite.checks import (
    ListOf,
    ListSweep,
    SuiteTable,
    Sweep,
    check_input,
    choice_of,
    list_values,
    plugin_kind,
    quantity_of,
    value_of,
)
from sysid_bench.harness.suite.plugin_entries import (
    Excitation,
    Named,
    Noise,
    Pipeline,
    Plant,
    Simulation,
)
from sysid_bench.models.manifest import TERM_ADVICE, TERMS, is_term
from sysid_bench.signals.filter import filter_of
from sysid_bench.units import interval, quantity
from sysid_bench.words import INTEGRATORS, UNKNOWN

ModelShare = Annotated[Any, quantity_of("%")]
Length = Annotated[Any, quantity_of("mm")]


class Candidate(SuiteTable):
    """Simulator of the methods that simulate: time step (none: the control period), integrator,
    and Coulomb friction that sticks, or the smooth tanh(v / v0)."""

    step: Annotated[Any, quantity_of("s", positive=True)] = None
    """Time step; default: the control period."""
    integrator: Annotated[str, choice_of("integrator", INTEGRATORS)] = "auto"
    """Integrator of MuJoCo."""
    friction: Annotated[str, choice_of("friction of a candidate", ("sticking", "smooth"))] = (
        "sticking"
    )
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

    mass: ModelShare = "20 %"  # of each body
    com: Length = "15 mm"  # of each centre of mass, per axis
    inertia: ModelShare = "30 %"  # of principal moments
    terms: ModelShare = "30 %"  # of joint terms
    axes: Annotated[Any, quantity_of("deg")] = None  # of inertias; none: half of `inertia`, in rad
    friction: Annotated[Any, PlainValidator(_friction)] = None  # "unknown"; none: as `terms`
    declared: Annotated[Any, quantity_of("1", positive=True)] = None
    known: ModelShare = None
    redrawn: StrictBool | None = None  # true: another draw with each repeat


PriorChoice = Annotated[
    Annotated[Prior, Tag("table")]
    | Annotated[str, choice_of("prior", ("truth", "none")), Tag("word")],
    Discriminator(plugin_kind),
]


def _filter(value: Any) -> str:
    text = str(value)
    if text == "default":  # recordings choose a filter by their rate
        return text
    value_of(lambda: filter_of(text))
    return text


Filter = Annotated[str | None, PlainValidator(_filter)]


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
        # Checked and kept as texts, since ids are of what is written.
        texts = [value] if isinstance(value, str) else list(value)
        value_of(lambda: [interval(text) for text in texts])
        return texts
    return value


class Signals(SuiteTable):
    """Settings of the pipeline `plain` (`filter`, `derivatives`, `torque`), and what is done to
    signals besides. A frozen suite keeps None: written settings choose `plain`."""

    filter: Filter = None  # "none"
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


Pipelines = Sweep[Named[Pipeline]]


def check_term(value: Any) -> Any:
    if not isinstance(value, str) or not is_term(value):
        raise ValueError(str(unknown_name("joint term", str(value), TERMS, TERM_ADVICE)))
    return value


Terms = tuple[Annotated[str, BeforeValidator(check_term)], ...] | None


def _motions(value: Any) -> Any:
    values = list_values(value)
    if not values:
        raise ValueError("scores need at least one held-out motion, as 'ptp'.")
    return values


def check_task(value: Any, info: ValidationInfo, recorded: bool = False) -> str:
    if not isinstance(value, str):
        raise ValueError(
            f"a task is a name, 'module:Class' or 'file:mine.py:Class'; got {value!r}."
        )
    context = check_input(info)
    task = value_of(lambda: context.names.task(value, context.folder))
    if recorded and not task.supports_recordings:
        raise ValueError(
            f"the task {value!r} cannot be identified from recordings; 'robot', 'payload', "
            "'wrench' and 'actuators' can."
        )
    return value


class DefaultSettings(SuiteTable):
    """Sweeps: each key but `candidate` holds a tuple of values."""

    task: Sweep[Annotated[str, PlainValidator(check_task)]] = ("robot",)
    """Unknown parameters: `sysid-bench list tasks`."""
    plant: Sweep[Named[Plant]] = Field(default=("matched",), validate_default=True)
    """Simulated plant: an effect, a realism level L0 to L4, a file of your own."""
    terms: ListSweep[Terms] = (None,)
    """Joint terms that are identified; default: the robot's own."""
    prior: Sweep[PriorChoice] = (Prior(),)
    """Prior knowledge of the parameters given to methods: a table, `truth` or `none`."""
    excitation: Sweep[Named[Excitation]] = Field(default=("fourier",), validate_default=True)
    """The training motion: `sysid-bench list excitations`."""
    motions: Sweep[Annotated[StrictInt, Field(ge=1, le=1000)]] = (1,)
    """Different training motions, recorded one after the other."""
    redrawn: ListOf[Annotated[str, choice_of("part that repeats draw anew", (MOTIONS, PLANT))]] = ()
    """Quantities drawn anew in each repeat besides the noise."""
    held_out: ListSweep[Annotated[tuple[Named[Excitation], ...], BeforeValidator(_motions)]] = (
        Field(default=(("fourier-other", "ptp"),), validate_default=True)
    )
    """Motions of the scores, which no method sees."""
    simulation: Sweep[Named[Simulation]] = Field(default=("inverse",), validate_default=True)
    """`inverse`: the motion is followed exactly; `closed-loop`: under a controller."""
    rate: Sweep[Annotated[Any, quantity_of("Hz", positive=True)]] = ("200 Hz",)
    """Sampling rate of the recording."""
    noise: Sweep[Noise] = (Noise(),)
    """Noise of the recorded signals; `{}` is none."""
    signals: Sweep[Signals] = (Signals(),)
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


def check_robot(value: Any, info: ValidationInfo) -> str:
    if not isinstance(value, str):
        raise ValueError(f"a robot is a name or a path; got {value!r}.")
    context = check_input(info)
    value_of(lambda: context.names.robot(value, context.folder))
    return value


def _sensor(value: str | None, info: ValidationInfo) -> str | None:
    context = check_input(info)
    if value is not None:
        for source in info.data.get("use", ()):
            value_of(partial(context.names.sensor, source, context.folder, value))
    return value


class RobotEntry(SuiteTable):
    use: Sweep[Annotated[str, PlainValidator(check_robot)]]
    """Robots by name, path or package, as the command line takes them."""
    payloads: Sweep[Load] = ("none",)
    """Names, or tables with `mass`, `com` and `inertia`."""
    free_base: StrictBool | None = None  # None: as the robot's manifest has it
    sensor: Annotated[StrictStr | None, AfterValidator(_sensor)] = None
    """Of the manifest, or a fixed joint, site or body to cut at; several: "left, right"."""
