"""Specification of an experiment in SI numbers, its id, and the seeds that depend on its parts."""

import hashlib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache, cached_property
from math import inf
from pathlib import Path
from typing import Any, Final

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import read_text
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
    confidence: float | None = None  # level of intervals; None: 0.95
    content: str | None = None  # hash of the robot, of which seeds are made; None: `robot`
    model: str | None = None  # hash of the robot's canonical model without payload
    data: Mapping[str, str] | None = None  # hash of each recording and motion file, by its path

    @cached_property
    def id(self) -> str:
        """12 hex digits: a hash of the specification alone, with the content of files in place of
        their paths."""
        written = self.to_json()
        written.pop("data", None)
        if self.content is not None and self.model is not None:
            del written["robot"]  # the path of a file, which can be written in many ways
        return canonical_hash(self.by_content(written))[:12]

    def by_content(self, value: Any) -> Any:
        """Return a value of the specification with the hashes of `data` in place of their paths."""
        if not self.data:
            return value
        if isinstance(value, Mapping):
            return {key: self.by_content(inner) for key, inner in value.items()}
        if isinstance(value, (list, tuple)):
            return [self.by_content(inner) for inner in value]
        return self.data.get(value, value) if isinstance(value, str) else value

    @property
    def seeded_robot(self) -> str:
        """Identity of the robot for its seeds: its name, or the model of a file that was given by
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
        # Ids are older than these fields, which are left out at their defaults.
        later = {"redrawn": (), "motions": 1} | dict.fromkeys(
            ("free_base", "sensor", "log", "pipeline", "candidate", "confidence", "content",
             "model", "data")
        )  # fmt: skip
        return {k: x for k, x in data.items() if k not in later or x != later[k]}

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


def checks_limits(excitation: Mapping[str, Any]) -> bool:
    """True where a motion beyond a joint limit fails; False where its rows are marked by the field
    `limits_broken`: { use = "file", file = "replay.csv", limits = "mark" }. The plug-in never sees
    this setting. Raises UsageError for another word."""
    written = excitation.get("limits", "refuse")
    if written not in ("refuse", "mark"):
        raise unknown_name("rule for limits of motions", str(written), ("refuse", "mark"))
    return bool(written == "refuse")


def without_limits(excitation: Mapping[str, Any]) -> dict[str, Any]:
    """{use, settings} of an excitation as the plug-in is given them."""
    return {key: value for key, value in excitation.items() if key != "limits"}


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
    noise = {}
    for key, value in written.items():
        if key not in NOISE_UNITS:
            raise unknown_name("kind of noise", key, NOISE_UNITS)
        share = key == "tau" and isinstance(value, str) and parse_quantity(value)[1] == "%"
        number = quantity(value, "%" if share else NOISE_UNITS[key])
        # A first-order autoregression with correlation 1 is a random walk, without finite variance.
        below, most = (1.0, " and below 1") if key == "tau_correlation" else (inf, "")
        if not 0 <= number < below:
            raise UsageError(f"noise.{key} must be 0 or more{most}; got {value!r}.")
        if number != 0.0:
            noise["tau_relative" if share else key] = number
    if not {"tau", "tau_relative"} & set(noise):
        noise.pop("tau_correlation", None)
    return noise


def normal_candidate(written: Mapping[str, Any]) -> dict[str, Any] | None:
    """SI numbers of a suite's table `candidate`; None for the defaults."""
    defaults = {"integrator": "auto", "friction": "sticking"}
    normal = {key: value for key, value in written.items() if defaults.get(key) != value}
    if "step" in normal:
        normal["step"] = quantity(normal["step"], "s")
    return normal or None


def normal_prior(written: str | Mapping[str, Any]) -> str | dict[str, Any]:
    """SI numbers of a prior: standard deviations as shares, in metres for com, in rad for axes."""
    if isinstance(written, str):
        return written
    units = {"com": "mm", "axes": "deg", "declared": "1"}  # the other keys are shares
    normal = {
        key: value if value == UNKNOWN else quantity(value, units.get(key, "%"))
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


SEALED: Final = "sealed"
"""Key of a plant: the SHA-256 of its seed in hexadecimal digits."""
SEEDS: Final = "SYSID_BENCH_SEEDS"
"""Environment variable: a file with secret seeds, a line each."""


def check_seed_hash(value: Any) -> None:
    """Raise UsageError for a value that is not a SHA-256 in hexadecimal digits."""
    if not isinstance(value, str) or not re.fullmatch(r"[0-9a-f]{64}", value):
        raise UsageError(
            f"{SEALED} of a plant is the SHA-256 of a secret seed, 64 hexadecimal digits; got "
            f"{value!r}."
        )


def seed_of_hash(seal: str) -> str:
    """Return the seed with this hash from the file that SYSID_BENCH_SEEDS names.

    Raises UsageError where there is no such file or no such seed in it.
    """
    file = os.environ.get(SEEDS)
    if not file:
        raise UsageError(
            f"The plant is sealed ({seal[:12]}...): a maintainer keeps its seed, and runs and "
            f"checks it with {SEEDS} = the file that holds the seed. Leave its cells out of a run "
            "with --select."
        )
    seeds = _seeds(file)
    if seal not in seeds:
        raise UsageError(
            f"No seed of {file!r} has the hash {seal[:12]}... of the sealed plant; there are "
            f"{', '.join(f'{known[:12]}...' for known in seeds) or 'none'}."
        )
    return seeds[seal]


def refuse_beside_seeds(what: str) -> None:
    """Raise UsageError where `what`, code of others that is not confined, could read the file of
    secret seeds."""
    if os.environ.get(SEEDS):
        raise UsageError(
            f"{what} is code of others, and could read the seeds of sealed plants here; with seeds "
            f"estimators of suites alone may be of others: unset {SEEDS}."
        )


@cache
def _seeds(file: str) -> dict[str, str]:
    """Seeds of a file by their hash."""
    try:
        lines = read_text(Path(file)).split()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{SEEDS}: {file!r} cannot be read ({error}).") from error
    # A shorter seed could be found from its hash by trying.
    short = [number for number, line in enumerate(lines, 1) if len(line) < 32]
    if short:
        raise UsageError(
            f"{SEEDS}: seed {short[0]} of {file!r} has fewer than 32 characters; make one "
            "with: python -c 'import secrets; print(secrets.token_hex())'."
        )
    return {hashlib.sha256(line.encode()).hexdigest(): line for line in lines}


def seed_of(suite_seed: int, *parts: Any) -> int:
    """A 128-bit seed from the suite's and any JSON values."""
    return int(canonical_hash([suite_seed, *parts])[:32], 16)


def motion_seed(spec: ExperimentSpec, index: int = 0) -> int:
    """Seed of the training motion number `index`: payloads, tasks and noise share it, and so do all
    repeats unless motions are redrawn."""
    return seed_of(spec.seed, "motion", *_motion_parts(spec, index))


def other_motion_seed(spec: ExperimentSpec, index: int) -> int:
    """Seed of motion number `index` of the training's excitation, never one of the training."""
    return seed_of(spec.seed, "further motion", *_motion_parts(spec, index))


def _motion_parts(spec: ExperimentSpec, index: int) -> tuple[Any, ...]:
    parts: tuple[Any, ...] = (spec.seeded_robot, spec.by_content(spec.excitation))
    if index > 0:
        parts += ({"motion": index},)
    if MOTIONS in spec.redrawn:
        parts += ({"repeat": spec.repeat},)
    return parts


def held_out_seed(spec: ExperimentSpec, index: int) -> int:
    """Seed of the held-out motion number `index`: never the training motion, whatever they are."""
    motion = spec.by_content(spec.held_out[index])
    return seed_of(spec.seed, "held-out", spec.seeded_robot, motion, index)


def noise_seed(spec: ExperimentSpec) -> int:
    """Seed of the sensor noise: the same draw for every payload, level, estimator, prior and plant,
    so that their comparison is paired."""
    # Neither payload nor level: common random numbers reduce the variance of differences.
    motion = spec.by_content(spec.excitation)
    parts = (spec.seeded_robot, spec.task, motion, spec.simulation, spec.rate, spec.repeat)
    return seed_of(spec.seed, "noise", *parts)


def sensor_seed(spec: ExperimentSpec) -> int:
    """Seed of the errors of a force/torque sensor: the same sensor for every payload, motion, task
    and level of its errors; another one for each repeat."""
    return seed_of(spec.seed, "sensor", spec.seeded_robot, spec.sensor, spec.repeat)


def run_seed(spec: ExperimentSpec, run: int) -> int:
    """Seed of the noise of a further recording of the same motion."""
    return seed_of(noise_seed(spec), "run", run)


def motion_noise_seed(spec: ExperimentSpec, index: int) -> int:
    """Seed of the noise in the recording of the training motion number `index`."""
    return noise_seed(spec) if index == 0 else seed_of(noise_seed(spec), "motion", index)


def drift_seed(spec: ExperimentSpec) -> int:
    """Seed of the torque drift: the same in all recordings of an experiment."""
    return seed_of(noise_seed(spec), "drift")


def plant_seed(spec: ExperimentSpec, *channel: Any) -> int:
    """Seed of one random size or direction of a plant: the same for every payload, task, motion and
    level of noise, and for all repeats unless `plant` is redrawn. That of a sealed plant depends
    on its secret, too."""
    parts = (spec.seeded_robot, *channel)
    if PLANT in spec.redrawn:
        parts += (spec.repeat,)
    if spec.plant.get(SEALED):
        parts += (seed_of_hash(str(spec.plant[SEALED])),)
    return seed_of(spec.seed, "plant", *parts)


def known_seed(spec: ExperimentSpec) -> int:
    """Seed of the errors of the known parts of a task, the same for every payload."""
    return seed_of(spec.seed, "known", spec.seeded_robot, spec.task)


def prior_seed(spec: ExperimentSpec) -> int:
    """Seed of the prior: the same for all noise levels, and for all repeats unless the prior is
    `redrawn`."""
    # One prior for all repeats: their scatter is then that of the noise alone.
    parts: tuple[Any, ...] = (spec.seeded_robot, spec.payload, spec.task)
    if not isinstance(spec.prior, str) and spec.prior.get(REDRAWN):
        parts += (spec.repeat,)
    return seed_of(spec.seed, "prior", *parts)
