"""Certificate of a sensor in front of mechanisms: against SVDs, exact data, and by names."""

from functools import cache

import numpy as np
import pytest

from sysid_bench.commands.identify import identify
from sysid_bench.errors import UnsupportedError
from sysid_bench.identifiability.sensor_certificate import SensorCertificate, sensor_certificate
from sysid_bench.identifiability.subspaces import excitation_of, structural_subspaces
from sysid_bench.models.random_robot import MECHANISMS
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree, check_chain, floating_subtree, subtree_at
from sysid_bench.regressors.wrench import floating_subtree_regressor, subtree_drives
from sysid_bench.types import Array, Trajectory
from tests.coupling.mechanisms import mechanism
from tests.robots import named_robot, robot_of, urdf_robot

FINGERS = """
<mujoco><compiler angle="radian"/><worldbody><body name="arm"><joint name="arm" axis="0 1 0"/>
<inertial pos="0 0 .2" mass="2" diaginertia=".02 .02 .01"/>
<body name="palm" pos="0 0 .4"><joint name="wrist" axis="1 0 0"/>
<inertial pos="0 0 .05" mass=".5" diaginertia=".002 .002 .001"/>
<body name="left" pos="0 .03 .1"><joint name="left" axis="1 0 0" range="-1 .5"/>
<inertial pos="0 0 .02" mass=".1" diaginertia="1e-4 1e-4 5e-5"/></body>
<body name="right" pos="0 -.03 .1"><joint name="right" axis="-1 0 0" range="-1 .5"/>
<inertial pos="0 0 .02" mass=".1" diaginertia="1e-4 1e-4 5e-5"/></body>
</body></body></worldbody>
<equality><joint joint1="right" joint2="left" polycoef="0 1 0 0 0"/></equality></mujoco>
"""
"""Two fingers that open symmetrically, about parallel axes."""

FEW = (("random:tendon:0", "mount"), ("fingers", "palm"), ("dvrk_psm", "link1"))
FILES = (
    "panda_description/urdf/panda.urdf",
    "baxter_description/urdf/baxter.urdf",
    "tiago_pro_description/robots/tiago_pro.urdf",
    "pr2_description/urdf/pr2.urdf",
    "romeo_description/urdf/romeo.urdf",
)
ROBOTS = (
    *(f"random:{kind}:{seed}" for kind in MECHANISMS for seed in range(3)),
    *("dvrk_psm", "dvrk_mtm", "fingers", *FILES),
)
CUTS_OF_EACH = 3


@cache
def _robot(name: str) -> RobotModel:
    if name == "fingers":
        return robot_of(FINGERS)
    if name.endswith(".urdf"):
        return urdf_robot(name)
    return mechanism(*name.split(":")[1:]) if name.startswith("random:") else named_robot(name)


def _cuts(robot: RobotModel) -> list[SensorSubtree]:
    """Cuts proximal to couplings, that no closed chain leads past; as many as `CUTS_OF_EACH`."""
    found: list[SensorSubtree] = []
    for name in robot.body_names:
        cut = subtree_at(robot, name, ())
        drives = subtree_drives(robot, cut, random_states(robot, 1, np.random.default_rng(0)).q)
        if not any(drives.followers):
            continue
        try:
            check_chain(robot, cut)
        except UnsupportedError:
            continue
        found.append(cut)
    return found[-CUTS_OF_EACH:]


def _rows(robot: RobotModel, cut: SensorSubtree, seed: int) -> tuple[Array, Array]:
    """Y_n (6 N, p) and the torques (N, d, p) of the drives at admissible states of this seed."""
    rng = np.random.default_rng([seed, 99])
    states = random_states(robot, 60 + 3 * len(cut.bodies), rng, 1.0)
    q = rng.normal(size=(len(states), 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    free = np.hstack([rng.normal(size=(len(states), 3)), q])
    v, a = rng.normal(size=(2, len(states), 6))
    motion = Trajectory(
        states.t,
        np.hstack([states.q, free]),
        np.hstack([states.v, v]),
        np.hstack([states.a, a]),
        "admissible states",
    )
    made = floating_subtree_regressor(robot, floating_subtree(robot, cut), motion)
    drives = subtree_drives(robot, cut, motion.q)
    return made.Y_n.reshape(-1, made.Y_n.shape[-1]), drives.reduced(made.Y_c)


def assert_certificate(robot: RobotModel, cut: SensorSubtree, found: SensorCertificate) -> None:
    """The certificate equals the row-space test of an SVD at other states. Exact wrenches predict
    the torques that it calls predictable; others are wrong, along the directions it states."""
    Y, torques = _rows(robot, cut, 1)
    other_Y, other = _rows(robot, cut, 2)
    _, values, Vt = np.linalg.svd(Y, full_matrices=False)
    V = Vt[values > 1e-12 * values[0]].T
    if np.abs(np.log10(values[: V.shape[1]] / values[0]) + 5).min() > 0.5:
        assert (values > 1e-5 * values[0]).sum() == found.rank
    rng = np.random.default_rng(0)
    phi = np.array(rng.normal(size=V.shape[0]))
    fitted = np.linalg.lstsq(Y, Y @ phi, rcond=1e-12)[0]
    for k, drive in enumerate(found.drives):
        g = np.vstack([torques[:, k], other[:, k]])
        left = np.linalg.norm(g - g @ V @ V.T, axis=1).max() / np.linalg.norm(g, axis=1).max()
        assert drive.predictable == (left < 1e-9), (drive, left)
        error = np.abs(other[:, k] @ (fitted - phi)).max() / np.abs(other[:, k] @ phi).max()
        if drive.predictable:
            assert error < 1e-9, (drive, error)
            continue
        assert error > 1e-7, (drive, error)
        x = np.zeros(V.shape[0])
        for name, value in (drive.direction or {}).items():
            x[[c for body in cut.bodies for c in robot.bodies[body].columns].index(name)] = value
        assert np.abs(other_Y @ x).max() < 1e-8 * np.abs(other_Y).max() * np.abs(x).max()
        assert np.abs(other[:, k] @ x).max() > 1e-3 * drive.effect > 0.0


@pytest.mark.parametrize(("name", "at"), FEW)
def test_certificate_is_the_row_space_test_of_an_svd(name: str, at: str) -> None:
    robot = _robot(name)
    cut = subtree_at(robot, at, ())
    assert_certificate(robot, cut, sensor_certificate(robot, cut))


@pytest.mark.long
@pytest.mark.parametrize("name", ROBOTS)
def test_certificates_of_many_robots_with_couplings(name: str) -> None:
    robot = _robot(name)
    cuts = _cuts(robot)
    assert cuts
    for cut in cuts:
        assert_certificate(robot, cut, sensor_certificate(robot, cut))


def test_symmetric_fingers_need_their_own_torque_or_a_sensor_at_one() -> None:
    """Turning against each other, the fingers load the wrist with the difference of their moments
    of inertia, and their drive with the sum, which the wrist cannot separate from the palm's."""
    robot = _robot("fingers")
    found = sensor_certificate(robot, subtree_at(robot, "palm", ()))
    assert found.coupled
    assert found.unpredictable == ("left",)
    (drive,) = found.drives
    assert (drive.unit, drive.followers) == ("N m", ("right",))
    assert drive.residual > 0.05
    added = {(entry.kind, entry.name): entry for entry in found.additions}
    assert added["torque", "left"].rank == 1
    assert added["torque", "left"].predicts == ("left",)
    assert added["sensor", "left"].predicts == ("left",)


def test_a_tree_keeps_proposition_1() -> None:
    robot = _robot("fingers").without_coupling
    found = sensor_certificate(robot, subtree_at(robot, "palm", ()))
    assert not found.coupled
    assert found.predictable == ("left", "right")
    assert max(drive.residual for drive in found.drives) < 1e-12
    assert found.additions == ()


def test_a_drive_on_both_sides_of_the_sensor_is_named() -> None:
    robot = mechanism("tendon", 0)
    found = sensor_certificate(robot, subtree_at(robot, "first", ()))
    assert found.unpredictable == ("second",) == found.partial
    cut = subtree_at(robot, "first", ())
    excited = excitation_of(_rows(robot, cut, 3)[0], structural_subspaces(robot, cut))
    assert "second" in excited.unpredictable
    assert "second" in excited.warning


def test_data_never_excite_an_unpredictable_torque() -> None:
    robot = _robot("fingers")
    cut = subtree_at(robot, "palm", ())
    Y, _ = _rows(robot, cut, 3)
    excited = excitation_of(Y, structural_subspaces(robot, cut))
    assert excited.rank == excited.structural
    assert (excited.predictable, excited.unpredictable) == ((), ("left",))
    assert "left" in excited.warning
    assert excited.unpredictable_wrench == ()


def test_the_answer_names_joints_and_the_theorem() -> None:
    result = identify("random:tendon:0", task="wrench", sensor="mount")
    text, sensor = result.summary(), result["sensor"]
    assert sensor["certificate"]["unpredictable"] == ["first", "second"] == sensor["unpredictable"]
    assert "which assumes independent joints, does not apply" in text
    assert "not predictable: first (with third)" in text
    assert "adding the torque of first: 1 more base parameters" in text
    assert "Proposition 1)" in identify("ur5", task="wrench", sensor="forearm_link").summary()


def test_a_chain_past_the_sensor_is_refused() -> None:
    robot = mechanism("four-bar", 1)
    with pytest.raises(UnsupportedError, match="past the sensor crank"):
        check_chain(robot, subtree_at(robot, "crank", ()))
