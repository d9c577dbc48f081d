"""A payload is one more welded body: names stay, and the composite is the sum of its parts."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.experiments.tasks.task import task_of
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import PAYLOADS, Payload, inertia_of, parse_payload
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.spatial import body_mass_inertia, feasible_margins, inertia_matrix
from sysid_bench.types import Array
from tests.closeness import assert_close
from tests.robots import (
    NAMED,
    cloud_phi,
    named_robot,
    random_mjcf,
    random_rotation,
    robot_of,
    states,
)

LOADS = [name for name in PAYLOADS if name != "none"]
LENGTHS = st.floats(1e-3, 10)


def unit_moments(word: str, sizes: list[float]) -> Array:
    """Inertia (3, 3) of a solid of one kilogram from the mean squares of its x, y and z."""
    x, y, z = {
        "box": [size**2 / 12 for size in sizes],
        "sphere": [size**2 / 5 for size in sizes] * 3,
        "rod": [*(size**2 / 12 for size in sizes), 0.0, 0.0],
        "point": [0.0] * 3,
    }[word]
    return np.diag([y + z, x + z, x + y])


@given(mass=st.floats(0.01, 100), sizes=st.tuples(LENGTHS, LENGTHS, LENGTHS))
@pytest.mark.parametrize(("word", "count"), [("box", 3), ("sphere", 1), ("rod", 1), ("point", 0)])
def test_solids_have_the_moments_of_their_shape(
    word: str, count: int, mass: float, sizes: tuple[float, float, float]
) -> None:
    chosen = list(sizes[:count])
    text = " ".join([word, *map(repr, chosen)])
    expected = mass * unit_moments(word, chosen)
    assert_close(inertia_matrix(np.array(inertia_of(text, mass))), expected, 1e-9)


@pytest.mark.parametrize(
    ("written", "metres"),
    [
        ("sphere 50 mm", "sphere 0.05"),
        ("sphere 50mm", "sphere 0.05 m"),
        ("sphere 5cm", "sphere 0.05"),
        ("box 10cm 80mm 0.12m", "box 0.1 0.08 0.12"),
        ("box 10 8 12 cm", "box 0.1 0.08 0.12 m"),
        ("box 10 8 120mm cm", "box 0.1 0.08 0.12 m"),
        ("rod 300 mm", "rod 0.3"),
    ],
)
def test_a_length_is_the_same_in_any_unit(written: str, metres: str) -> None:
    assert_close(inertia_of(written, 1.0), inertia_of(metres, 1.0), 1e-12)


SOLIDS = ["", "ball 1", "box 1 1", "box", "sphere", "sphere 1 2", "rod -1", "sphere 0", "point 1"]
SOLIDS += ["sphere nan", "sphere inf", "sphere 1e400", "sphere 1e200", "sphere x", "sphere 5 deg"]
SOLIDS += ["sphere 5kg", "sphere 5 %", "box 1 1 1 m m", "sphere 1e-400"]


@pytest.mark.parametrize("text", SOLIDS)
def test_no_solid_is_refused_with_what_was_written(text: str) -> None:
    with pytest.raises(UsageError) as refusal:
        parse_payload({"mass": 1.0, "inertia": text})
    assert repr(text) in str(refusal.value)


WRONG: list[tuple[Any, str]] = [
    ("sphere-2kg", "Did you mean 'sphere-1kg'?"),
    (5, "5 is not a payload"),
    (None, "None is not a payload"),
    ([1.0], "[1.0] is not a payload"),
    ({}, "mass"),
    ({"mass": 1, "comm": [0, 0, 0]}, "Did you mean 'com'?"),
    ({1: 2}, "'1'"),
    ({"mass": 0}, "positive"),
    ({"mass": -1.5}, "-1.5"),
    ({"mass": math.nan}, "finite"),
    ({"mass": math.inf}, "finite"),
    ({"mass": 10**400}, "at most"),
    ({"mass": True}, "True"),
    ({"mass": "1 kg"}, "'1 kg'"),
    ({"mass": 1, "com": [0, 0]}, "3 number"),
    ({"mass": 1, "com": 5}, "3 number"),
    ({"mass": 1, "com": [0, 0, math.nan]}, "finite"),
    ({"mass": 1, "inertia": [1, 1, 1]}, "6 number"),
    ({"mass": 1, "inertia": 5}, "6 number"),
    ({"mass": 1, "inertia": [1, 0, 0, 1, 0, math.inf]}, "finite"),
    ({"mass": 1, "inertia": [1, 0, 0, 1, 0, 2.1]}, "triangle inequality"),
    ({"mass": 1, "inertia": [1, 2, 0, 1, 0, 1]}, "physically impossible"),
    ({"mass": 1, "inertia": [-1, 0, 0, -1, 0, -1]}, "physically impossible"),
]


@pytest.mark.parametrize(("spec", "words"), WRONG)
def test_a_wrong_payload_is_refused(spec: Any, words: str) -> None:
    with pytest.raises(UsageError) as refusal:
        parse_payload(spec)
    assert words in str(refusal.value)


@pytest.mark.parametrize("name", PAYLOADS)
def test_built_in_payloads_are_found_by_name_and_can_exist(name: str) -> None:
    payload = parse_payload(name)
    assert payload.name == name
    assert bool(payload) == (name != "none")
    assert feasible_margins(payload.phi) >= -1e-15
    if payload:
        mass, com, inertia = body_mass_inertia(payload.phi)
        assert f"{mass:g}kg" in name
        assert_close(com, payload.com)
        np.testing.assert_allclose(inertia, inertia_matrix(np.array(payload.inertia)), atol=1e-12)


def check_composite(bare: RobotModel, loaded: RobotModel, payload: Payload) -> None:
    """All that mounting a payload may change, and all that it must not."""
    b = loaded.payload_body
    assert b is not None
    assert tuple(n for i, n in enumerate(loaded.body_names) if i != b) == bare.body_names
    assert loaded.rows == bare.rows
    assert loaded.joints == bare.joints
    assert loaded.body_names[loaded.tool_body] == bare.body_names[bare.tool_body]
    np.testing.assert_array_equal(np.delete(loaded.phi, b, axis=0), bare.phi)
    np.testing.assert_allclose(loaded.phi[b], payload.phi, atol=1e-12)
    for table in ("limits", "joint_terms"):
        for one, other in zip(
            vars(getattr(bare, table)).values(), vars(getattr(loaded, table)).values(), strict=True
        ):
            np.testing.assert_array_equal(one, other)
    # The torque of both is the torque of the robot and that of the payload's masses at the tool.
    motion = states(bare, 3)
    parts = bare.tree.link_parameters(bare.phi)
    carrier = int(bare.tree.carrier[bare.tool_body])
    alone = loaded.tree.link_parameters(
        np.where(np.arange(len(loaded.phi))[:, None] == b, loaded.phi, 0.0)
    )
    if carrier >= 0:
        R, p = tool_pose(bare, loaded)
        points, masses = cloud(payload)
        parts[carrier] += in_carrier(bare, masses, points @ R.T + p)
        assert np.count_nonzero(alone.any(axis=1)) == 1
    np.testing.assert_allclose(loaded.tree.link_parameters(loaded.phi), parts, atol=1e-10)
    tau = newton_euler(loaded.tree, loaded.tree.link_parameters(loaded.phi), motion)
    sum_of_both = newton_euler(bare.tree, bare.tree.link_parameters(bare.phi), motion)
    sum_of_both = sum_of_both + newton_euler(loaded.tree, alone, motion)
    np.testing.assert_allclose(tau, sum_of_both, atol=1e-9 * np.abs(tau).max())


def tool_pose(bare: RobotModel, loaded: RobotModel) -> tuple[Array, Array]:
    """Pose of the tool frame in its body, from the site's own pose where the tool is a site."""
    data = mujoco.MjData(bare.mj)
    mujoco.mj_kinematics(bare.mj, data)
    names = [bare.mj.site(i).name for i in range(bare.mj.nsite)]
    if bare.manifest.tool not in names:
        return np.eye(3), np.zeros(3)
    site, body = names.index(str(bare.manifest.tool)), bare.tool_body + 1
    R_wb, R_ws = data.xmat[body].reshape(3, 3), data.site_xmat[site].reshape(3, 3)
    return R_wb.T @ R_ws, R_wb.T @ (data.site_xpos[site] - data.xpos[body])


def cloud(payload: Payload) -> tuple[Array, Array]:
    """Six point masses with the payload's mass, centre and inertia."""
    inertia = inertia_matrix(np.array(payload.inertia))
    covariance = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    values, axes = np.linalg.eigh(covariance)
    arms = (axes * np.sqrt(np.maximum(values, 0) * 3 / payload.mass)).T
    points = np.array(payload.com) + np.concatenate([arms, -arms])
    return points, np.full(6, payload.mass / 6)


def in_carrier(bare: RobotModel, masses: Array, points: Array) -> Array:
    """Ten numbers, in the link's frame, of point masses given in the frame of the tool's body."""
    data = mujoco.MjData(bare.mj)
    mujoco.mj_kinematics(bare.mj, data)
    link = bare.tree.links[int(bare.tree.carrier[bare.tool_body])].body + 1
    body = bare.tool_body + 1
    R_wl, R_wb = data.xmat[link].reshape(3, 3), data.xmat[body].reshape(3, 3)
    world = points @ R_wb.T + data.xpos[body]
    return cloud_phi(masses, (world - data.xpos[link]) @ R_wl)


@pytest.mark.parametrize("payload", LOADS)
@pytest.mark.parametrize("name", NAMED)
def test_every_payload_on_every_robot(name: str, payload: str) -> None:
    check_composite(named_robot(name), named_robot(name, payload), PAYLOADS[payload])


@pytest.mark.parametrize("seed", range(12))
def test_payloads_on_random_trees_of_nameless_bodies(seed: int) -> None:
    text = random_mjcf(seed)
    bare, loaded = robot_of(text), robot_of(text, PAYLOADS["sphere-offset-1kg"])
    check_composite(bare, loaded, PAYLOADS["sphere-offset-1kg"])


@pytest.mark.parametrize("seed", range(12))
def test_any_possible_payload_can_be_mounted(seed: int) -> None:
    """Laminae and rods at any angle lie on the border of what can exist."""
    rng = np.random.default_rng(seed)
    R = random_rotation(rng)
    squares = rng.uniform(0.01, 1, 3) * (rng.random(3) < 0.6)
    covariance = R @ np.diag(squares) @ R.T
    inertia = np.trace(covariance) * np.eye(3) - covariance
    six = inertia[(0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)].tolist()
    payload = parse_payload({"mass": 2.0, "com": rng.normal(size=3).tolist(), "inertia": six})
    loaded = load_robot("ur5", payload)
    check_composite(named_robot("ur5"), loaded, payload)


SITE = """<mujoco><worldbody><body name="a"><joint axis="0 1 0"/>
<inertial pos=".1 .2 .3" mass="1" diaginertia="1 1 1"/>
<body name="payload" pos=".1 .2 .3" quat="1 2 3 4"><site name="tip" pos=".3 .2 .1" quat="4 3 2 1"/>
<inertial pos=".1 .2 .3" mass="1" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""


def test_a_site_carries_payloads_in_its_own_axes() -> None:
    payload = PAYLOADS["sphere-offset-1kg"]
    bare, loaded = robot_of(SITE, tool="tip"), robot_of(SITE, payload, tool="tip")
    check_composite(bare, loaded, payload)
    assert loaded.body_names == ("a", "payload", "payload_")  # the name was taken


def test_no_payload_mounts_nothing() -> None:
    robot = load_robot("ur5", PAYLOADS["none"])
    assert robot.payload_body is None
    assert robot.body_names == named_robot("ur5").body_names


@pytest.mark.parametrize("payload", LOADS)
def test_the_truth_of_the_composite_has_its_mass_and_centre(payload: str) -> None:
    bare, loaded = (task_of(named_robot("ur5", p), "robot", ()).truth for p in ("none", payload))
    assert bare.parameters == loaded.parameters
    changed = np.flatnonzero(bare.theta != loaded.theta)
    assert {loaded.parameters[i].split(".")[0] for i in changed} == {"tool0"}
    at = loaded.parameters.index("tool0.m")
    np.testing.assert_allclose(
        loaded.theta[at : at + 10] - bare.theta[at : at + 10], PAYLOADS[payload].phi, atol=1e-12
    )


def test_payloads_move_as_the_tool_does() -> None:
    """Random states are the same with and without a payload: comparisons are paired."""
    one, other = (
        random_states(named_robot("ur5", p), 5, np.random.default_rng(0))
        for p in ("none", "box-2kg")
    )
    np.testing.assert_array_equal(one.q, other.q)
    np.testing.assert_array_equal(one.a, other.a)
