"""Limits come from the manifest, then from the model, then from what is usual; states keep them."""

import numpy as np
import pytest

from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.models.joint_terms import FLOATING, USUAL
from sysid_bench.models.manifest import Limits, Manifest
from sysid_bench.models.random_states import LARGEST, random_states
from sysid_bench.models.robot import RobotModel
from tests.coupling.mechanisms import four_bar
from tests.robots import NAMED, named_robot, random_robot, robot_of, states, urdf_files, urdf_robot

EVERY = [*NAMED, *range(8)]


@pytest.fixture(scope="module", params=EVERY)
def robot(request: pytest.FixtureRequest) -> RobotModel:
    name = request.param
    return random_robot(name) if isinstance(name, int) else named_robot(name)


def check_limits(robot: RobotModel) -> None:
    limits, dofs = robot.limits, robot.scalar_dofs
    for values in vars(limits).values():
        assert values.shape == (robot.nv,)
        assert not np.isnan(values).any()
    assert (limits.q_low[dofs] < limits.q_high[dofs]).all()
    assert np.isfinite([limits.q_low[dofs], limits.q_high[dofs]]).all()
    assert (limits.v > 0).all()
    assert (limits.a > 0).all()
    assert (limits.tau > 0).all()
    assert np.isfinite([limits.v, limits.a]).all()
    others = np.setdiff1d(np.arange(robot.nv), dofs)
    assert np.isinf(limits.q_low[others]).all()
    assert (limits.v[others] == FLOATING[0]).all()


def check_states(robot: RobotModel) -> None:
    """Limits hold for independent joints; dependent ones go where these put them."""
    motion = states(robot.without_coupling, 50)
    for joint in robot.joints:
        at = joint.qadr
        if joint.kind in ("hinge", "slide"):
            low, high = (getattr(robot.limits, key)[joint.vadr] for key in ("q_low", "q_high"))
            q = motion.q[:, at]
            assert ((low <= q) & (q <= high)).all()
            assert np.ptp(q) > 0.5 * min(high - low, 2 * LARGEST)
        else:
            start = at + (3 if joint.kind == "free" else 0)
            lengths = np.linalg.norm(motion.q[:, start : start + 4], axis=1)
            np.testing.assert_allclose(lengths, 1.0, atol=1e-14)


def test_limits_are_whole_and_states_keep_them(robot: RobotModel) -> None:
    check_limits(robot)
    check_states(robot)


@pytest.mark.parametrize("file", urdf_files())
def test_limits_of_every_urdf(file: str) -> None:
    robot = urdf_robot(file)
    check_limits(robot)
    check_states(robot)


@pytest.mark.parametrize("name", NAMED)
def test_the_manifest_has_the_first_word(name: str) -> None:
    robot = named_robot(name)
    declared = robot.manifest.limits
    for joint in robot.joints:
        if joint.kind not in ("hinge", "slide"):
            continue
        for key in ("v", "a", "tau"):
            own = getattr(declared.get(joint.name, Limits()), key)
            wanted = own if own is not None else getattr(declared.get("all", Limits()), key)
            if wanted is not None:
                assert getattr(robot.limits, key)[joint.vadr] == wanted


def text(joint: str) -> str:
    return f"""<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
    <joint name="j" {joint}<parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>"""


def test_the_model_has_the_second_word() -> None:
    limit = '<limit lower="-0.5" upper="0.25" effort="7" velocity="3"/>'
    limits = robot_of(text(f'type="revolute">{limit}')).limits
    assert (limits.q_low[0], limits.q_high[0]) == (-0.5, 0.25)
    assert (limits.v[0], limits.tau[0]) == (3.0, 7.0)


@pytest.mark.parametrize(("kind", "word"), [("hinge", "continuous"), ("slide", "prismatic")])
def test_the_usual_has_the_last_word(kind: str, word: str) -> None:
    limits = robot_of(text(f'type="{word}">')).limits
    reach, v, a = USUAL[kind]
    assert (limits.q_low[0], limits.q_high[0]) == (-reach, reach)
    assert (limits.v[0], limits.a[0]) == (v, a)
    assert np.isinf(limits.tau[0])


@pytest.mark.parametrize("velocity", ["0", "1000"])
def test_a_placeholder_is_no_velocity_limit(velocity: str) -> None:
    limit = f'<limit lower="-1" upper="1" effort="7" velocity="{velocity}"/>'
    limits = robot_of(text(f'type="revolute">{limit}')).limits
    assert limits.v[0] == USUAL["hinge"][1]


@pytest.mark.parametrize("low", [-9.0, -3.0, 0.0, 1.9999999, 1.5, 5.0])
def test_no_joint_stands_still_in_random_states(low: float) -> None:
    """Ranks are asked with them: the window may not shrink where the range only touches it."""
    robot = robot_of(
        f"""<mujoco><compiler angle="radian"/><worldbody><body><joint axis="0 0 1"/>
        <inertial pos=".1 .2 .3" mass="1" diaginertia="1 1 1"/>
        <body pos="1 0 0"><joint axis="0 0 1" range="{low} {low + 7}" limited="true"/>
        <inertial pos=".1 .2 .3" mass="1" diaginertia="1 1 1"/></body></body>
        </worldbody></mujoco>"""
    )
    check_states(robot)
    assert structural_base(robot, robot.inertial_columns).rank == 4


def test_a_range_far_from_the_reference_is_kept() -> None:
    """States within 2 rad of the reference do not exist there: the range itself is taken."""
    robot = robot_of(
        """<mujoco><compiler angle="radian"/><worldbody><body><joint range="5 6" limited="true"/>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
    )
    check_states(robot)


def test_states_are_drawn_by_the_generator_alone() -> None:
    robot = named_robot("solo12")
    one, again, other = (random_states(robot, 5, np.random.default_rng(s)) for s in (0, 0, 1))
    np.testing.assert_array_equal(one.q, again.q)
    assert (one.q != other.q).any()


def test_a_manifest_of_ones_own_needs_only_a_file() -> None:
    manifest = Manifest("r", named_robot("ur5").manifest.path)
    assert manifest.tool is None
    assert manifest.terms == ()


@pytest.mark.parametrize("seed", [1, 2])
def test_a_floating_base_of_a_mechanism_turns_in_all_directions(seed: int) -> None:
    robot = robot_of(four_bar(), free_base=True)
    assert robot.coupling is not None
    coupled, free = (
        random_states(one, 200, np.random.default_rng(seed))
        for one in (robot, robot.without_coupling)
    )
    np.testing.assert_array_equal(coupled.q[:, :7], free.q[:, :7])
    down = 1 - 2 * (coupled.q[:, 4] ** 2 + coupled.q[:, 5] ** 2)  # z of the base in the world
    assert down.min() < -0.9
    assert down.max() > 0.9
