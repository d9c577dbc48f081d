"""The ground truth cannot be reached from the inputs of a method."""

import gc
import types
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Oracle, Truth
from tests.experiments.experiment_world import CLOSED_LOOP, RICH, SMOOTH, ready

CODE = (type, types.ModuleType, types.BuiltinFunctionType, types.CodeType)
NOISE = {"q": 1e-5, "tau_relative": 0.01}


def held_by(thing: Any) -> list[Any]:
    """Contents of an object; of a function its closure and defaults, not its module."""
    if isinstance(thing, types.FunctionType):
        return [thing.__closure__, thing.__defaults__, thing.__kwdefaults__]
    if isinstance(thing, np.ndarray):
        return [thing.base]
    return gc.get_referents(thing)


def reachable(*roots: Any) -> Iterator[Any]:
    """Every object that can be walked to, code and classes apart."""
    seen: set[int] = set()
    todo = list(roots)
    kept = []  # ids stay taken while we walk
    while todo:
        thing = todo.pop()
        if thing is None or id(thing) in seen or isinstance(thing, CODE):
            continue
        seen.add(id(thing))
        kept.append(thing)
        yield thing
        todo += held_by(thing)


def numbers(thing: Any) -> list[Array]:
    """The float arrays that an object is or, for the engine's own objects, offers."""
    if isinstance(thing, np.ndarray):
        return [thing] if thing.dtype.kind == "f" else []
    if isinstance(thing, mujoco.MjModel):
        names = [
            n for n in dir(thing) if n.startswith(("body_", "dof_", "jnt_", "geom_", "tendon_"))
        ]
        values = [getattr(thing, name) for name in names]
        return [v for v in values if isinstance(v, np.ndarray) and v.dtype.kind == "f"]
    if isinstance(thing, mujoco.MjSpec):
        out = [np.array([[b.mass, *b.ipos, *b.inertia] for b in thing.bodies])]
        out.append(np.array([[g.mass, g.density, *g.size] for g in thing.geoms]))
        out.append(np.array([np.ravel(j.damping)[0] for j in thing.joints]))
        out.append(np.array([j.frictionloss for j in thing.joints]))
        return out
    if isinstance(thing, list) and thing and all(isinstance(x, float) for x in thing):
        return [np.array(thing)]
    return []


def secrets(made: ExperimentData[SimulatedSource]) -> dict[str, Array]:
    """Arrays that no method may hold, by name: unknown bodies, their masses, the unknowns."""
    robot, theta = made.robot, made.source.truth.theta
    index = {name: i for i, name in enumerate(made.source.truth.parameters)}
    table = np.array([theta[[index[c] for c in b.columns]] for b in made.problem.bodies])
    out = {"theta": theta, "base parameters": made.problem.base.K @ theta, "table": table}
    for body, phi in zip(made.problem.bodies, table, strict=True):
        if phi.any():
            out[f"phi of {body.name}"] = phi
    if made.source.task.name == "robot":
        mj = robot.mj
        out["phi"] = robot.phi
        out["masses"] = np.array(mj.body_mass[1:])
        out["moments"] = np.array(mj.body_inertia[1:])
        for term in robot.manifest.terms:
            value = robot.term_values((term,))
            if value.any() and len(np.unique(value)) > 1:
                out[term] = value
    return out


def holds(array: Array, secret: Array) -> bool:
    """True where an array contains the secret: as it is, as a row, or as a run of numbers."""
    flat, wanted = array.ravel(), secret.ravel()
    if len(wanted) < 2 or len(flat) < len(wanted):
        return False
    starts = np.flatnonzero(np.isclose(flat[: len(flat) - len(wanted) + 1], wanted[0], rtol=1e-9))
    size = np.abs(wanted).max()
    return any(
        np.allclose(flat[s : s + len(wanted)], wanted, rtol=1e-9, atol=1e-12 * size) for s in starts
    )


CASES: dict[str, dict[str, Any]] = {
    "ur5": {"robot": "ur5"},
    "panda, loaded, closed loop": {
        "robot": "panda",
        "payload": "sphere-offset-1kg",
        "simulation": CLOSED_LOOP,
    },
    "UR5 without friction, closed loop": {"robot": SMOOTH, "simulation": CLOSED_LOOP},
    "own MJCF": {"robot": RICH, "simulation": CLOSED_LOOP},
    "ball joints": {"robot": "file:ball.xml"},
    "floating": {"robot": "solo12", "payload": "box-2kg"},
    "no prior": {"robot": "ur10", "prior": "none"},
    "payload": {"robot": "ur5", "payload": "box-2kg", "task": "payload"},
    "link": {"robot": "ur5", "payload": "box-2kg", "task": "link", "simulation": CLOSED_LOOP},
}


@pytest.mark.parametrize("case", CASES)
def test_the_truth_is_out_of_reach(case: str) -> None:
    made = ready(**{"noise": NOISE, **CASES[case]})
    hidden = secrets(made)
    clean = made.held_out["ptp"]
    count = 0
    for thing in reachable(made.problem, made.experiment):
        count += 1
        assert not isinstance(thing, (Oracle, Truth, Task, ExperimentData)), type(thing)
        assert thing is not made.robot
        assert thing is not clean
        for array in numbers(thing):
            for name, secret in hidden.items():
                assert not holds(array, secret), f"{name} in {type(thing)} {array.shape}"
    assert count > 200


@pytest.mark.parametrize("case", ["ur5", "UR5 without friction, closed loop", "own MJCF"])
def test_noise_free_signals_are_out_of_reach(case: str) -> None:
    changes = {**CASES[case], "signals": {"filter": "average 3", "derivatives": "from q"}}
    noisy = ready(**{**changes, "noise": {"tau_relative": 0.01}})
    clean = ready(**{**changes, "noise": {}})
    secret = clean.experiment.raw.tau
    assert np.abs(secret - noisy.experiment.raw.tau).max() > 0
    for thing in reachable(noisy.problem, noisy.experiment):
        for array in numbers(thing):
            if array.shape == secret.shape:
                assert np.abs(array - secret).max() > 1e-9


def test_the_robot_that_methods_simulate_is_bare() -> None:
    made = ready(robot="panda", payload="box-2kg", simulation=CLOSED_LOOP)
    found = [x for x in reachable(made.experiment) if isinstance(x, RobotModel)]
    assert found
    for robot in found:
        assert not robot.phi.any()
        assert robot.payload.mass == 0.0
        assert robot.text == b""
        for term in ("viscous", "coulomb", "offset", "armature", "spring"):
            assert not getattr(robot.joint_terms, term).any()
        assert not robot.manifest.joints


def test_the_walk_finds_what_is_there() -> None:
    """The guard itself: a truth in a closure, a bound method, a view or an engine's object."""
    made = ready(robot="ur5")
    truth, robot = made.source.truth, made.robot

    class Holder:
        __slots__ = ("kept",)

        def __init__(self, kept: Any) -> None:
            self.kept = kept

        def method(self) -> None: ...

    def closure() -> Any:
        return truth

    for root in (closure, Holder(truth).method, {"a": [(truth,)]}, lambda x=truth: x):
        assert any(isinstance(thing, Truth) for thing in reachable(root))
    phi = robot.phi
    table = np.concatenate([np.zeros(3), phi.ravel(), np.ones(5)])
    view = table[-5:]  # what an array is a view of counts as well
    assert any(holds(a, phi) for thing in reachable([view]) for a in numbers(thing))
    masses = np.array(robot.mj.body_mass[1:])
    assert any(holds(a, masses) for thing in reachable([robot.mj]) for a in numbers(thing))
    spec_masses = np.array([b.mass for b in robot.spec.bodies][1:])
    assert any(np.allclose(a[1:, 0], spec_masses) for a in numbers(robot.spec)[:1])


def test_given_the_truth_a_method_has_it() -> None:
    made = ready(robot="ur5", prior="truth")
    found = [holds(a, made.source.truth.theta) for t in reachable(made.problem) for a in numbers(t)]
    assert any(found)


def test_the_prior_is_drawn_around_the_truth_and_no_body_is_the_true_one() -> None:
    made = ready(robot="panda")
    prior = made.problem.prior
    assert prior is not None
    moving = made.source.truth.theta != 0
    assert (prior.theta[moving] != made.source.truth.theta[moving]).all()
    distance = (
        np.abs(prior.theta - made.source.truth.theta)[prior.std > 0] / prior.std[prior.std > 0]
    )
    assert np.median(distance) < 2.0
