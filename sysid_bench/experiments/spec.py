"""Specification of an experiment in SI numbers, and its id."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from math import inf
from typing import Any, Final

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.units import parse_quantity, quantity
from sysid_bench.words import UNKNOWN


@dataclass(frozen=True)
class ExperimentSpec:
    """A simulated recording, or recordings of a real robot (`log`). JSON values only; plug-ins are
    {use, settings...} as written.

    `noise` holds q, quantum (rad, m), tau (N m, N) or tau_relative (share of the joint's RMS
    torque) with its tau_correlation from sample to sample, and the errors of force/torque sensors
    (simulation/wrench_sensors.py); `prior` holds mass, inertia, terms (shares) and com (m), or is
    "truth" or "none".
    """

    seed: int  # root of the suite's seed tree
    robot: str  # as written
    payload: str | Mapping[str, Any]
    task: str
    terms: tuple[str, ...] | None  # None: the robot's own
    plant: Mapping[str, Any]
    prior: str | Mapping[str, Any]
    excitation: Mapping[str, Any]
    held_out: tuple[Mapping[str, Any], ...]
    simulation: Mapping[str, Any]
    rate: float  # Hz
    noise: Mapping[str, float]
    signals: Mapping[str, Any]
    repeat: int
    free_base: bool | None = None  # None: as the robot's manifest has it
    log: Mapping[str, Any] | None = None  # a recording of a real robot, as a suite's [[log]] has it
    pipeline: Mapping[str, Any] | None = None  # {use, settings}; None: `plain`, by `signals`
    sensor: str | None = None  # the force/torque sensor; None: the only one of the manifest
    motions: int = 1  # different training motions, recorded one after the other
    redrawn: tuple[str, ...] = ()  # what each repeat draws anew: "motions", "plant"
    candidate: Mapping[str, Any] | None = None  # {step (s), integrator, friction}; None: defaults
    content: str | None = None  # hash of the robot's files, of which seeds are made; None: `robot`

    @cached_property
    def id(self) -> str:
        """12 hex digits: a hash of the specification alone."""
        return canonical_hash(self.to_json())[:12]

    @property
    def seeded_robot(self) -> str:
        """What seeds depend on for the robot: its name, or the content of a file that was given by
        its path, since a path can be written in many ways."""
        return self.robot if self.content is None else self.content

    @cached_property
    def code_key(self) -> str:
        """Canonical JSON of the parts that decide which code, models and files are used."""
        return canonical([
            self.robot, self.task, self.plant, self.excitation, self.held_out, self.simulation,
            self.pipeline, self.log,
        ])  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """The fields as JSON values; `from_json` reads them back."""
        data = {field.name: getattr(self, field.name) for field in fields(self)}
        for key in ("free_base", "sensor", "log", "pipeline", "candidate", "content"):
            if data[key] is None:  # ids are older than these fields
                del data[key]
        if not data["redrawn"]:
            del data["redrawn"]
        if data["motions"] == 1:
            del data["motions"]
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "ExperimentSpec":
        """Raises UsageError for data of another version of this package."""
        try:
            terms = data["terms"]
            return cls(
                **{
                    **data,
                    "terms": None if terms is None else tuple(terms),
                    "held_out": tuple(data["held_out"]),
                    "redrawn": tuple(data.get("redrawn", ())),
                }
            )
        except (KeyError, TypeError) as error:
            raise UsageError(
                f"Experiment written by another version of sysid_bench ({error}); plan it again "
                "into another folder (-o)."
            ) from error


MOTIONS, PLANT = "motions", "plant"
"""Values of `redrawn`: each repeat draws these anew."""

REDRAWN: Final = "redrawn"
"""Key of a prior that is drawn again with each repeat; the other keys are spreads."""


NOISE_UNITS: Final = {
    "q": "rad|m",
    "tau": "N m|N",
    "quantum": "rad|m",
    "tau_drift": "N m|N",  # per second
    "tau_correlation": "1",
    "force": "N",
    "moment": "N m",
    "force_offset": "N",
    "moment_offset": "N m",
    "force_drift": "N",  # per second
    "moment_drift": "N m",  # per second
    "gain": "%",
    "crosstalk": "%",
    "mounting": "rad",
    "touch": "N",
}
"""Keys of a [noise] table and their units; torque may also be a share, in %."""


def normal_noise(written: Mapping[str, Any]) -> dict[str, float]:
    """SI numbers of a [noise] table; "0.5 %" of torque becomes tau_relative = 0.005.

    Zeros are left out, and so is the correlation of torque without noise: exact signals are {},
    however they are written. Raises UsageError for unknown keys and impossible values.
    """
    if not isinstance(written, Mapping):
        raise UsageError(f"noise must be a table such as {{'tau': '0.5 %'}}; got {written!r}.")
    noise = dict(_noise_level(key, value) for key, value in written.items())
    noise = {key: value for key, value in noise.items() if value != 0.0}
    if not {"tau", "tau_relative"} & set(noise):
        noise.pop("tau_correlation", None)
    return noise


def _noise_level(key: str, written: Any) -> tuple[str, float]:
    """Key and SI number of one entry of a [noise] table."""
    if key not in NOISE_UNITS:
        raise unknown_name("kind of noise", key, NOISE_UNITS)
    share = key == "tau" and _is_share(written)
    number = quantity(written, "%" if share else NOISE_UNITS[key])
    _validate_level(key, number, written)
    return "tau_relative" if share else key, number


def _validate_level(key: str, number: float, written: Any) -> None:
    # A first-order autoregression with correlation 1 is a random walk, without finite variance.
    below, most = (1.0, " and below 1") if key == "tau_correlation" else (inf, "")
    if not 0 <= number < below:
        raise UsageError(f"noise.{key} must be 0 or more{most}; got {written!r}.")


def _is_share(written: Any) -> bool:
    return isinstance(written, str) and parse_quantity(written)[1] == "%"


def normal_candidate(written: Mapping[str, Any]) -> dict[str, Any] | None:
    """SI numbers of a suite's table `candidate`; None for the defaults."""
    defaults = {"integrator": "auto", "friction": "sticking"}
    normal = {key: value for key, value in written.items() if defaults.get(key) != value}
    if "step" in normal:
        normal["step"] = quantity(normal["step"], "s")
    return normal or None


PRIOR_UNITS: Final = {"com": "mm", "axes": "deg", "declared": "1"}
"""Units of the keys of a prior that are not shares."""


def normal_prior(written: str | Mapping[str, Any]) -> str | dict[str, Any]:
    """SI numbers of a prior: standard deviations as shares, in metres for com, in rad for axes."""
    if isinstance(written, str):
        return written
    normal = {
        key: value if value == UNKNOWN else quantity(value, PRIOR_UNITS.get(key, "%"))
        for key, value in written.items()
        if key != REDRAWN and value is not None
    }
    # Exactly known parts are not written: ids are older than the key.
    if not normal.get("known"):
        normal.pop("known", None)
    return normal | ({REDRAWN: True} if written.get(REDRAWN) else {})


def normal_payload(written: str | Mapping[str, Any]) -> str | dict[str, Any]:
    """The table of a payload without its name, numbers as floats."""
    if isinstance(written, str):
        return written
    if not isinstance(written, Mapping):
        raise UsageError(f"a payload is a name or a table {{mass = ...}}; got {written!r}.")
    return {key: _floats(value) for key, value in written.items() if key != "name"}


def _floats(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_floats(inner) for inner in value]
    return float(value) if isinstance(value, (int, float)) else value
