"""Inverse simulation against two engines that it does not use, and its stated terms."""

import numpy as np
import pinocchio as pin
import pytest

from sysid_bench.errors import EstimationError, SimulationError
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.inverse import Inverse, inverse_torque
from sysid_bench.simulation.plant import Plant, plant_of, set_inertia
from sysid_bench.types import Array, Trajectory
from tests.experiments.experiment_world import OWN, RICH, SHIPPED, Law, robot_of


def motion_of(robot: RobotModel, count: int = 40) -> Trajectory:
    return random_states(robot, count, np.random.default_rng(7))


def torque(plant: Plant, motion: Trajectory) -> Array:
    oracle, controller = Inverse().run(plant, motion, np.zeros_like(motion.v))
    assert controller is None
    assert oracle.motion is motion
    return oracle.tau


def stated_terms(robot: RobotModel, motion: Trajectory) -> Array:
    """The joint terms (N, nv) as `JointTerms` states them, dof by dof."""
    terms = robot.joint_terms
    tau = motion.v @ terms.viscous_coupling.T
    for joint in robot.joints:
        for dof in range(joint.vadr, joint.vadr + len(joint.dofs)):
            v = motion.v[:, dof]
            tau[:, dof] += terms.viscous[dof] * v + terms.coulomb[dof] * np.sign(v)
            tau[:, dof] += terms.offset[dof]
            if joint.kind in ("hinge", "slide"):
                deflection = motion.q[:, joint.qadr] - terms.spring_reference[dof]
                tau[:, dof] += terms.spring[dof] * deflection
    return np.asarray(tau)


def by_pinocchio(robot: RobotModel, motion: Trajectory) -> Array:
    """Rigid-body torque (N, nv) by `rnea`, in MuJoCo's coordinates, with the armature."""
    pairing = robot.pairing
    data = pairing.model.createData()
    q = pairing.positions_to_pinocchio(motion.q)
    v, a = pairing.rates(motion.q, motion.v, motion.a)
    tau = np.array([pin.rnea(pairing.model, data, *state) for state in zip(q, v, a, strict=True)])
    return np.asarray(pairing.rows_to_mujoco(motion.q, tau) + robot.joint_terms.armature * motion.a)


@pytest.mark.parametrize("payload", ["none", "sphere-offset-1kg"])
@pytest.mark.parametrize("name", SHIPPED + OWN)
def test_two_engines_and_the_stated_terms_give_the_torque(name: str, payload: str) -> None:
    robot = robot_of(name, payload)
    motion = motion_of(robot)
    tau = torque(plant_of(robot), motion)
    terms = stated_terms(robot, motion)
    for reference in (inverse_torque(robot.without_coupling, motion), by_pinocchio(robot, motion)):
        wanted = robot.reduced(motion.q, reference + terms)
        assert np.abs(tau - wanted).max() <= 1e-11 * np.abs(tau).max()


def test_every_stated_term_is_felt() -> None:
    robot = robot_of(RICH)
    terms = robot.joint_terms
    for name in ("viscous", "offset", "armature", "spring"):
        assert getattr(terms, name).all(), name
    assert np.abs(stated_terms(robot, motion_of(robot))).min(axis=0).max() > 0


def test_long_motions_are_the_same_in_chunks() -> None:
    robot = robot_of("file:ball.xml")
    motion = motion_of(robot, 1100)  # more than two chunks
    tau = torque(plant_of(robot), motion)
    for k in (0, 511, 512, 1023, 1024, 1099):
        one = Trajectory(
            motion.t[k : k + 1],
            motion.q[k : k + 1],
            motion.v[k : k + 1],
            motion.a[k : k + 1],
        )
        np.testing.assert_allclose(torque(plant_of(robot), one)[0], tau[k], rtol=0, atol=1e-12)


def test_effects_are_added_on_top() -> None:
    robot = robot_of("file:arm.xml")
    motion = motion_of(robot)
    laws = [Law(lambda t, q, v: 0.3 * v**3), Law(None), Law(lambda t, q, v: 2.0 * np.cos(q))]
    with_effects = torque(plant_of(robot, laws), motion)
    added = 0.3 * motion.v**3 + 2.0 * np.cos(motion.q)
    np.testing.assert_allclose(with_effects - torque(plant_of(robot), motion), added, atol=1e-12)


def test_a_torque_that_is_not_finite_names_its_first_sample() -> None:
    robot = robot_of("file:arm.xml")
    motion = motion_of(robot)
    broken = Law(lambda t, q, v: np.where(t[:, None] >= 17, np.nan, 0.0) * v)
    with pytest.raises(SimulationError, match="from sample 17 of 40"):
        torque(plant_of(robot, [broken]), motion)


@pytest.mark.parametrize("payload", ["none", "rod-1kg", "point-1kg"])
@pytest.mark.parametrize("name", ["ur5", "icub", "file:free.xml", RICH])
def test_inertias_written_into_a_model_are_those_it_had(name: str, payload: str) -> None:
    robot = robot_of(name, payload)
    motion = motion_of(robot)
    written = Plant(robot, robot.joint_terms, (), robot.phi)
    exact = torque(plant_of(robot), motion)
    assert np.abs(torque(written, motion) - exact).max() <= 1e-11 * np.abs(exact).max()


@pytest.mark.parametrize(
    ("column", "value"), [(0, -1.0), (4, -0.5), (5, 40.0)], ids=["mass", "Ixx", "Ixy"]
)
def test_a_body_that_cannot_exist_is_named(column: int, value: float) -> None:
    robot = robot_of("file:arm.xml")
    phi = robot.phi.copy()
    phi[1, column] = value
    with pytest.raises(EstimationError, match="fore"):
        set_inertia(plant_of(robot).contact_free_model, phi)
