"""Forward kinematics: frames of bodies and tool against Pinocchio and against a DH chain."""

import json

import numpy as np
import pinocchio as pin
import pytest

import sysid_bench
from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.types import Array

from .conftest import Run


@pytest.mark.parametrize("name", ["ur5", "kinova", "icub", "panda"])
def test_frames_are_those_of_pinocchio(name: str) -> None:
    robot = load_robot(name)
    model = pin.buildModelFromXML(robot.text)
    rng = np.random.default_rng(3)
    names = [joint.name for joint in robot.joints if joint.kind in ("hinge", "slide")]
    at = {joint: float(rng.uniform(-1, 1)) for joint in names}
    q = pin.neutral(model)
    for joint, value in at.items():
        place = model.joints[model.getJointId(joint)]
        turn = [np.cos(value), np.sin(value)] if place.nq == 2 else [value]
        q[place.idx_q : place.idx_q + place.nq] = turn
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    found = sysid_bench.frames(name, at)
    shared = [body for body in found.frames if model.existBodyName(body)]
    assert len(shared) >= len(names)
    for body in shared:
        T = data.oMf[model.getBodyId(body)].homogeneous
        np.testing.assert_allclose(found.frames[body], T, atol=1e-9)
    assert found.gravity == [0, 0, -9.81]


def dh(a: float, alpha: float, d: float, theta: float) -> Array:
    """Transformation of a row of a standard DH table."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1.0]]
    )


def test_frames_of_the_psm_are_those_of_its_dh_chain() -> None:
    """Table I of Fontanelli et al. (2017), with the constants that the manifest's table states: the
    frame of a link that turns has the origin of the DH frame before it, and its own axes."""
    q1, q2, q3, q4, q5, q6 = 0.3, -0.4, 0.15, 0.7, -0.2, 0.5
    at = {"j1": q1, "j2": q2, "j3": q3, "j4": q4, "j5": q5, "j6": q6}
    half = np.pi / 2
    chain = {
        "link1": dh(0, -half, 0, q1), "link2": dh(0.2, 0, 0, q2),
        "link2p": dh(0.5, 0, 0, -q2 + half), "link2pp": dh(0, -half, 0, q2),
        "link3": dh(0, 0, q3, 0), "link4": dh(0, half, 0, q4), "link5": dh(0.009, -half, 0, q5),
        "link6": dh(0, -half, 0, q6),
    }  # fmt: skip
    found = sysid_bench.frames("dvrk_psm", at)
    T = np.eye(4)
    T[:3, :3] = pin.rpy.rpyToMatrix(0, -half, 0)
    for name, step in chain.items():
        before, T = T, T @ step
        frame = np.array(found.frames[name])
        origin = T if name == "link3" else before
        np.testing.assert_allclose(frame[:3, 3], origin[:3, 3], atol=1e-9)
        np.testing.assert_allclose(frame[:3, :3], T[:3, :3], atol=1e-9)


@pytest.mark.parametrize(
    ("robot", "at", "words"),
    [
        ("dvrk_psm", {"j2p": 0.1}, "'j2p' is a dependent joint; it follows j2"),
        ("dvrk_mtm", {"j2p": 0.1}, "it follows j2, j3"),
        ("ur5", {"elbow": 0.1}, "elbow_joint"),
        ("ur5", {"elbow_joint": float("nan")}, "finite number"),
    ],
)
def test_what_cannot_be_placed_is_named(robot: str, at: dict[str, float], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        sysid_bench.frames(robot, at)


def test_the_command_prints_every_frame(cli: Run) -> None:
    done = cli("frames", "dvrk_mtm", "--at", "j1=0.2")
    assert done.returncode == 0
    assert "gravity in the world: 0 0 -9.81" in done.stdout
    answer = json.loads(cli("frames", "dvrk_mtm", "--at", "j1=0.2", "--json").stdout)
    assert all(f"\n{name} " in done.stdout for name in [*answer["frames"], "tool"])
    assert cli("frames", "ur5", "--at", "elbow_joint").returncode == 2
