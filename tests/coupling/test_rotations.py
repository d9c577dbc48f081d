"""Closed chains through ball and free joints: rods with ball ends, as in legs of walking robots."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.errors import ModelError, UnsupportedError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.models.coupling.pullback import pullback
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import build
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import plant_of
from sysid_bench.spatial import composed_rotation, inverse_quaternion, rotation_of_quaternion
from tests.coupling.mechanisms import INERTIAL, mjcf
from tests.experiments.experiment_world import executed, spec
from tests.robots import relative_gap, robot_of, states

SHORT = {"use": "fourier", "period": "2 s", "cycles": 1, "harmonics": 4}
KINDS = ("rod", "loose rod", "platform", "hand", "shoulder", "floating hand")


def _text(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def _body(name: str, joint: str, inside: str, rng: np.random.Generator, turned: bool = True) -> str:
    """A body at a random place in any orientation, on a joint (words before its name)."""
    quat = f'quat="{_text(rng.normal(size=4))}"' if turned else ""
    kind = joint if joint != "hinge" else f'hinge" axis="{_text(rng.normal(size=3))}'
    moved = f'<joint name="{name}" type="{kind}"/>' if joint else ""
    place = _text(0.3 * rng.normal(size=3))
    return f'<body name="{name}" pos="{place}" {quat}>{moved}{INERTIAL}{inside}</body>'


def _arm(name: str, count: int, inside: str, rng: np.random.Generator) -> str:
    for k in range(count, 0, -1):
        inside = _body(f"{name}{k}", "hinge", inside, rng)
    return inside


def random_loop(kind: str, seed: int) -> str:
    """A random MJCF, on a fixed or free base, with a rod of ball ends between two arms (`rod`), a
    free body held at both ends in place of it (`loose rod`), a platform on a ball and two rods
    (`platform`), a hand on a ball that is welded to another arm (`hand`), a ball in the middle of a
    closed chain of hinges (`shoulder`), or a free body that carries an arm, held at its end
    (`floating hand`): balls and free joints are first, in the middle and last in a loop."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    anchors = [_text(0.3 * rng.normal(size=3)) for _ in range(2)]
    rods = [_body(f"rod{k}", "ball", "", rng) for k in (1, 2)]
    outside = ""
    if kind == "rod":
        inside = _arm("a", 2, rods[0], rng) + _arm("b", 2, "", rng)
        loops = f'<connect body1="rod1" body2="b2" anchor="{anchors[0]}"/>'
    elif kind == "loose rod":
        inside = _arm("a", 3, "", rng) + _arm("b", 2, "", rng)
        outside = _body("rod", "free", "", rng)
        loops = f'<connect body1="rod" body2="a3" anchor="{anchors[0]}"/>'
        loops += f'<connect body1="rod" body2="b2" anchor="{anchors[1]}"/>'
    elif kind == "platform":
        inside = _body("platform", "ball", "", rng)
        inside += "".join(_arm(f"a{k}", 1, rod, rng) for k, rod in enumerate(rods))
        loops = f'<connect body1="rod1" body2="platform" anchor="{anchors[0]}"/>'
        loops += f'<connect body1="rod2" body2="platform" anchor="{anchors[1]}"/>'
    elif kind == "shoulder":
        inside = _arm("a", 2, _body("ball", "ball", _arm("c", 2, "", rng), rng), rng)
        inside += _arm("b", 2, "", rng)
        loops = f'<connect body1="c2" body2="b2" anchor="{anchors[0]}"/>'
    elif kind == "floating hand":
        inside = _arm("a", 3, "", rng)
        outside = _body("hand", "free", _arm("f", 2, _body("tip", "ball", "", rng), rng), rng)
        loops = f'<connect body1="tip" body2="a3" anchor="{anchors[0]}"/>'
    else:
        inside = _arm("a", 3, _body("hand", "ball", "", rng), rng) + _arm("b", 5, "", rng)
        loops = '<weld body1="hand" body2="b5"/>'
    base = _body("base", "free" if seed % 2 else "", inside, rng)
    return mjcf(base + outside, loops)


@cache
def loop_robot(kind: str, seed: int) -> RobotModel:
    """The robot of a random loop, loaded once."""
    return robot_of(random_loop(kind, seed))


def assert_engines_agree(kind: str, seed: int) -> None:
    """Tree, reduced regressor and constrained dynamics agree between the engines."""
    check = crosscheck(loop_robot(kind, seed), 4)
    assert check.ok(), check.reason()
    assert check.gap <= 1e-12
    assert check.coupling is not None
    assert check.coupling.gap <= 1e-9
    assert check.coupling.closure <= 1e-8
    assert check.coupling.violation <= 1e-11


@pytest.mark.parametrize("kind", KINDS)
def test_engines_agree_on_loops_through_rotations(kind: str) -> None:
    assert_engines_agree(kind, KINDS.index(kind))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("kind", KINDS)
def test_engines_agree_on_many_loops_through_rotations(kind: str, seed: int) -> None:
    if (kind, seed) == ("shoulder", 2):  # this draw is nearly flat, and is refused as such
        with pytest.raises(ModelError, match="not flat or stretched"):
            loop_robot(kind, seed)
    else:
        assert_engines_agree(kind, seed)


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=pytest.mark.long) for kind in KINDS if kind != "rod"] + ["rod"],
)
def test_positions_of_a_motion_have_its_velocity_and_acceleration(kind: str) -> None:
    robot = loop_robot(kind, KINDS.index(kind))
    brief = design_problem(robot, 2000.0)
    motion = build("excitation", SHORT).design(brief, np.random.default_rng(0))
    h = 1.0 / brief.rate
    for joint in robot.joints:
        dofs = slice(joint.vadr, joint.vadr + len(joint.dofs))
        v, a = motion.v[:, dofs], motion.a[:, dofs]
        np.testing.assert_allclose((v[2:] - v[:-2]) / (2 * h), a[1:-1], atol=1e-3 * np.abs(a).max())
        if joint.kind == "ball":
            turn = motion.q[:, joint.qadr : joint.qadr + 4]
            step = composed_rotation(inverse_quaternion(turn[:-2]), turn[2:])
            rate = rotation_of_quaternion(step) / (2 * h)
            np.testing.assert_allclose(rate, v[1:-1], atol=1e-3 * np.abs(v).max())


def test_torque_is_linear_in_all_parameters_along_closed_motions() -> None:
    robot = loop_robot("platform", 2)
    motion = states(robot, 15)
    terms = ("viscous", "armature")
    columns = robot.inertial_columns + robot.term_columns(terms)
    theta = np.concatenate([robot.phi.ravel(), robot.term_values(terms)])
    oracle, _ = Inverse().run(plant_of(robot), motion, np.zeros_like(motion.v))
    Y = torque_regression(robot, columns).dense(motion).Y
    assert relative_gap(Y @ theta, oracle.tau) <= 1e-11


def test_links_are_identified_from_exact_data(tmp_path: Path) -> None:
    file = tmp_path / "rod.xml"
    file.write_text(random_loop("rod", 0))
    (row,) = executed(spec(robot=str(file), excitation=SHORT), "ols")
    assert row["status"] == "ok", row["reason"]
    assert row["crosscheck"] == "ok"
    assert row["torque_error"] <= 1e-8


def test_optimised_motions_are_refused_with_advice() -> None:
    coupling = loop_robot("rod", 0).coupling
    motion = states(loop_robot("rod", 0), 5)
    assert coupling is not None
    slope = np.ones_like(motion.v)
    with pytest.raises(UnsupportedError, match=r"ball or free joints.*fourier"):
        pullback(coupling, motion, (slope, slope, slope))
