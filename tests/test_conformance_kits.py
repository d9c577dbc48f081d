"""Kits of excitations, plant effects and simulations: built-in plug-ins pass, each broken one is
found by the law that it violates."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from sysid_bench.apps.conformance import check_plugin_of, failed_checks
from sysid_bench.apps.conformance.error_checks import model_error_cases, sensor_error_cases
from sysid_bench.apps.conformance.findings import robots_in_motion
from sysid_bench.apps.conformance.motion_checks import design_cases
from sysid_bench.apps.conformance.pipeline import pipeline_cases
from sysid_bench.errors import UsageError
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.models.offset_robot import with_gravity
from sysid_bench.plugin_names import BUILTIN, build
from sysid_bench.pytest_plugin import assert_conforms
from sysid_bench.signals.pipelines import Plain
from sysid_bench.signals.row_processing import ProcessedSignals, RowProcessing
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.model_errors import BaseTilt

QUICK = sorted(set(BUILTIN["excitation"]) - {"file", "optimised"})
"""A motion from a file has the limits of its file; an optimised one takes most of a minute."""


SETTINGS: dict[str, dict[str, Any]] = {
    "fourier-other": {"harmonics": 3, "period": "4 s"},
    "static": {"moves": 3},
}
BUILT_IN = [
    *(("excitation", {"use": name, **SETTINGS.get(name, {})}) for name in QUICK),
    *(
        (kind, {"use": name})
        for kind in ("plant", "model_error", "sensor_error", "simulation", "pipeline")
        for name in BUILTIN[kind]
    ),
    *(
        ("pipeline", {"use": name, "standstill": 0.2, "weight": 0.5})
        for name in BUILTIN["pipeline"]
    ),
]


@pytest.mark.parametrize(("kind", "plugin"), BUILT_IN)
def test_built_in_plugins_conform(kind: str, plugin: dict[str, Any]) -> None:
    assert_conforms(plugin, kind)


@pytest.mark.long
def test_an_optimised_motion_conforms() -> None:
    excitation = {"use": "optimised", "period": "5 s", "iterations": 10}
    assert_conforms(excitation, "excitation")


def test_an_assertion_names_the_laws() -> None:
    with pytest.raises(AssertionError, match=r"violates \d+ laws:\n.*its torque at rest"):
        assert_conforms(BrokenEffect("offset"), "plant")


def test_every_kind_with_a_kit_is_a_kind_of_plug_in() -> None:
    with pytest.raises(UsageError, match="Did you mean 'excitation'"):
        check_plugin_of("exitation", build("excitation", "fourier"))


# --- Broken excitations -------------------------------------------------------------------------


@dataclass(frozen=True)
class BrokenExcitation:
    """A Fourier series with one mistake."""

    mistake: str

    def design(self, brief: Any, rng: np.random.Generator) -> Any:
        motion = Fourier(period=2.0, cycles=1).design(brief, rng)
        N, nv = motion.v.shape
        match self.mistake:
            case "far":
                return replace(motion, q=motion.q + 3.0)
            case "fast":
                return replace(motion, t=motion.t[: N // 2], q=motion.q[::2], v=2 * motion.v[::2],
                               a=4 * motion.a[::2])  # fmt: skip
            case "degrees":
                return replace(motion, v=motion.v * 180 / np.pi)
            case "no acceleration":
                return replace(motion, a=np.zeros_like(motion.a))
            case "random":
                return Fourier(period=2.0, cycles=1).design(brief, np.random.default_rng())
            case "backwards":
                return replace(motion, t=motion.t[::-1])
            case "narrow":
                return replace(motion, v=motion.v[:, : nv - 1], a=motion.a[:, : nv - 1])
            case "nan":
                return replace(motion, a=np.where(motion.t[:, None] > 1, np.nan, motion.a))
            case "tuple":
                return motion.t, motion.q
            case "changing":
                brief.q0[0] += 0.1
        return motion


EXCITATIONS = {
    "far": "its limit is",
    "fast": "keeps the limits",
    "degrees": "v of .* differs from the differences of q",
    "no acceleration": "a of .* differs from the differences of v",
    "random": "is reproducible .* same random generator state",
    "backwards": "its times do not increase",
    "narrow": "v has the shape",
    "nan": "a has values that are not finite",
    "tuple": "design returned tuple, not a Trajectory",
    "changing": "it changed an array of the design problem",
}


@dataclass(frozen=True)
class RateDependent:
    """A Fourier series whose length or content depends on the rate."""

    mistake: str

    def design(self, brief: Any, rng: np.random.Generator) -> Any:
        if self.mistake == "length":
            return Fourier(period=200.0 / brief.rate, cycles=1).design(brief, rng)
        return Fourier(harmonics=int(brief.rate / 80), period=2.0, cycles=1).design(brief, rng)


RATE_DEPENDENT = {
    "length": "at 100 Hz it takes 1.99 s",
    "content": "q at 100 Hz differs from that at 400",
}


# --- Broken model errors and sensor errors ------------------------------------------------------


@dataclass(frozen=True)
class BrokenModelError:
    """Tilted gravity with one mistake."""

    mistake: str
    angle: float = 0.01
    sizes = ("angle",)

    def apply(self, robot: Any, rng: np.random.Generator) -> Any:
        match self.mistake:
            case "truth":
                return replace(robot, phi=1.1 * robot.phi)
            case "random":
                return BaseTilt(self.angle).apply(robot, np.random.default_rng())
            case "size":
                return BaseTilt(self.angle + 0.01).apply(robot, rng)
            case "bodies":
                return replace(robot, body_names=robot.body_names[::-1])
            case "nan":
                return with_gravity(robot, np.full(3, np.nan))
            case "tree":
                return robot.tree
        robot.phi[:] *= 1.1
        return robot


MODEL_ERRORS = {
    "truth": "keeps the true parameters",
    "random": "is deterministic",
    "size": "vanishes at size zero",
    "bodies": "its bodies are not those of the model",
    "nan": "moves along a motion of the model",
    "tree": "it is a Tree",
    "changing": "it changed the model's robot",
}


@dataclass(frozen=True)
class BrokenStage:
    """A torque reading with one mistake."""

    mistake: str
    gain: float

    def torque_reading(self, signal: Any, rng: np.random.Generator) -> Any:
        match self.mistake:
            case "narrow":
                return signal.tau[:, 1:]
            case "nan":
                return signal.tau * np.nan
            case "random":
                return signal.tau + np.random.default_rng().normal(size=signal.tau.shape)
            case "size":
                return signal.tau + 0.1
            case "changing":
                signal.tau[0] += self.gain
        return (1.0 + self.gain) * signal.tau

    def stored(self, count: int, rng: np.random.Generator) -> Any:
        return np.arange(count) + (self.mistake == "future")


@dataclass(frozen=True)
class BrokenSensorError:
    """A gain error with one mistake."""

    mistake: str
    gain: float = 0.1
    sizes = ("gain",)

    def prepare(self, robot: Any, rng: np.random.Generator) -> Any:
        return object() if self.mistake == "nothing" else BrokenStage(self.mistake, self.gain)


SENSOR_ERRORS = {
    "narrow": "torque_reading has the shape",
    "nan": "not finite",
    "random": "is deterministic",
    "size": "with its sizes zero, torque_reading is not exact",
    "future": "was not taken yet",
    "nothing": "without encoder_error, torque_reading",
    "changing": "it changed the robot or a signal",
}


# --- Broken effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class BrokenEffect:
    """Viscous friction with one mistake."""

    mistake: str
    vanishes_at_rest = True

    def prepare(self, robot: Any) -> Any:
        calls = []
        noise = np.random.default_rng().uniform()

        def law(t: Any, q: Any, v: Any) -> Any:
            calls.append(t)
            match self.mistake:
                case "scalar":
                    return float(np.sum(v))
                case "nan":
                    return np.full_like(v, np.nan)
                case "memory":
                    return 0.1 * len(calls) * v
                case "random":
                    return noise * v
                case "mean":
                    return v - v.mean(axis=0)
                case "offset":
                    return 0.1 + 0.0 * v
                case "writing":
                    v[:] = 0.0
            return 0.1 * v

        if self.mistake == "robot":
            robot.mj.dof_damping[0] += 1e-3
        return "torque" if self.mistake == "text" else law


EFFECTS = {
    "scalar": "its torque has the shape",
    "nan": "its torque has values that are not finite",
    "memory": "a force law has no memory",
    "random": "prepared twice it gives two torques",
    "mean": "sample 0 alone gives another torque",
    "offset": "its torque at rest is up to 0.1",
    "writing": "it changed the robot or the motion",
    "robot": "it changed the robot or the motion",
    "text": "prepares a force law .* it is a str",
}


@dataclass(frozen=True)
class BrokenStates:
    """Play with one mistake."""

    mistake: str
    coulomb: float = 1.0
    sizes = ("coulomb",)
    vanishes_at_rest = True
    dissipates = True

    def prepare(self, robot: Any) -> Any:
        coulomb = np.zeros(robot.nv)
        coulomb[robot.scalar_dofs] = self.coulomb
        return BrokenStateLaw(self.mistake, coulomb)


@dataclass(frozen=True, eq=False)
class BrokenStateLaw:
    mistake: str
    coulomb: Any

    def start(self, q: Any, v: Any) -> Any:
        return q - 1e-3 * np.sign(v)

    def step(self, state: Any, h: float, t: float, q: Any, v: Any, load: Any) -> Any:
        p = np.clip(state, q - 1e-3, q + 1e-3)
        torque = self.coulomb * (q - p) / 1e-3
        match self.mistake:
            case "states":
                return torque, p[1:]
            case "nan":
                return torque * np.nan, p
            case "writing":
                state[:] = p
            case "random":
                return torque * np.random.default_rng().uniform(), p
            case "driving":
                return -10 * torque - 100 * self.coulomb * v, p
            case "offset":
                return torque + 0.1 * self.coulomb, p
            case "size":
                return torque + 0.1 * np.sign(v), p
        return torque, p


STATES = {
    "states": "its states has the shape",
    "nan": "its torque has values that are not finite",
    "writing": "a step changed its arguments",
    "random": "two steps from one state differ",
    "driving": "friction drives .* over a closed cycle",
    "offset": "its torque at rest is up to 0.1",
    "size": "with its sizes zero, torques are not bit for bit",
}


def test_a_law_with_states_conforms_without_a_kind() -> None:
    assert_conforms(BrokenStates("none"), "plant")


# --- Broken simulations -------------------------------------------------------------------------


@dataclass(frozen=True)
class Result:
    motion: Any
    tau: Any


@dataclass(frozen=True)
class BrokenSimulation:
    """The inverse simulation with one mistake."""

    mistake: str

    def design_rate(self, recording: float) -> float:
        return 1.5 * recording if self.mistake == "rate" else recording

    def run(self, plant: Any, commanded: Any, encoder: Any) -> Any:
        done, controller = Inverse().run(plant, commanded, encoder)
        motion, tau = done.motion, np.array(done.tau)
        match self.mistake:
            case "single":
                return done
            case "short":
                tau = tau[1:]
            case "nan":
                tau[3] = np.nan
            case "no gravity":
                tau = tau - tau.mean(axis=0)
            case "random":
                tau = tau * np.random.default_rng().uniform(0.999, 1.001)
            case "changing":
                commanded.v[:] *= 1.0 + 1e-9
            case "controller":
                controller = "PD"  # type: ignore[assignment]
        return Result(motion, tau), controller


SIMULATIONS = {
    "rate": "design_rate is 1.5 times the recording rate",
    "single": "run returned Oracle, not a pair",
    "short": "tau has the shape",
    "nan": "tau has values that are not finite",
    "no gravity": "differs from inverse dynamics along the simulated motion",
    "random": "tau differs from call to call",
    "changing": "it changed the plant or the commanded motion",
    "controller": "its controller is a str",
}


# --- Broken pipelines ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Delay:
    """A filter that delays by one sample."""

    def smooth(self, x: Any, rate: float) -> Any:
        return np.concatenate([x[:1], x[:-1]])


@dataclass(frozen=True)
class Squares(Delay):
    """A filter that is not linear."""

    def smooth(self, x: Any, rate: float) -> Any:
        return x * np.abs(x)


class Forgetful(RowProcessing):
    """Rows at standstill are counted, but not left out."""

    def apply(self, x: Any, weights: Any, rate: float) -> Any:
        return super().apply(x, np.ones(len(x)), rate)


class Generous(RowProcessing):
    """Rows at standstill are left out, but counted."""

    def count(self, weights: Any) -> int:
        return len(weights)


@dataclass(frozen=True)
class BrokenPipeline:
    """Plain filtering with one mistake."""

    mistake: str
    ideal_rates = True

    def process(self, recording: Any, joints: Any) -> Any:
        if self.mistake == "writing":
            recording.q[:] += 1e-9
        done = Plain(standstill=0.2).process(recording, joints)
        given: Any = done.recording
        late: Any = Delay()
        squares: Any = Squares()
        rows = {
            "late rows": RowProcessing(late),
            "squares": RowProcessing(squares),
            "forgetful": Forgetful(standstill=0.2),
            "generous": Generous(standstill=0.2),
        }
        signals: dict[str, dict[str, Any]] = {
            "late": {"tau": np.concatenate([given.tau[:1], given.tau[:-1]])},
            "nan": {"a": np.where(given.t[:, None] > 1, np.nan, given.a)},
            "gain": {"tau": 1.01 * given.tau},
            "random": {"q": given.q + 1e-12 * np.random.default_rng().normal(size=given.q.shape)},
            "shifted": {"t": given.t + 1e-3},
            "no rates": {"v": None},
        }
        if self.mistake == "tuple":
            return given, rows
        given = replace(given, **signals.get(self.mistake, {}))
        return ProcessedSignals(given, rows.get(self.mistake, done.rows))


PIPELINES = {
    "late": "played backwards, tau differs",
    "late rows": "played backwards, the rows differs",
    "squares": "its rows break W beta = b",
    "forgetful": "rows with weight zero still have an influence",
    "generous": "it counts 2000 rows",
    "nan": "a has values that are not finite",
    "gain": "at rest tau changes by",
    "random": "q differs from one call to the next",
    "shifted": "its samples are not those of the recording",
    "no rates": "its recording has no v and a",
    "tuple": "process returned tuple, not ProcessedSignals",
    "writing": "it changed the recording",
}


# --- Each is found ------------------------------------------------------------------------------

BROKEN: dict[str, tuple[str, Callable[[str], Any], dict[str, str]]] = {
    "excitation": ("excitation", BrokenExcitation, EXCITATIONS),
    "motion at another rate": ("excitation", RateDependent, RATE_DEPENDENT),
    "model error": ("model_error", BrokenModelError, MODEL_ERRORS),
    "sensor error": ("sensor_error", BrokenSensorError, SENSOR_ERRORS),
    "effect": ("plant", BrokenEffect, EFFECTS),
    "effect with states": ("plant", BrokenStates, STATES),
    "simulation": ("simulation", BrokenSimulation, SIMULATIONS),
    "pipeline": ("pipeline", BrokenPipeline, PIPELINES),
}


@pytest.fixture
def restored_cases() -> Iterator[None]:
    """The shared inputs of the kits are put right after a plug-in that changes them."""
    kept = [case.robot.phi.copy() for case in model_error_cases()]
    yield
    for cases in (design_cases, robots_in_motion, sensor_error_cases, pipeline_cases):
        cases.cache_clear()
    for case, phi in zip(model_error_cases(), kept, strict=True):
        case.robot.phi[:] = phi


@pytest.mark.parametrize(
    ("plugin", "mistake"), [(name, key) for name, (*_, found) in BROKEN.items() for key in found]
)
@pytest.mark.usefixtures("restored_cases")
def test_a_broken_plugin_is_found(plugin: str, mistake: str) -> None:
    kind, broken, found = BROKEN[plugin]
    lines = failed_checks(check_plugin_of(kind, broken(mistake)))
    assert re.search(found[mistake], "\n".join(lines)), lines
