"""Tasks ask different questions of one robot: the known and the asked are all there is."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.experiments.tasks.prior import PriorSpread, prior_of
from sysid_bench.experiments.tasks.task import Task, task_of
from sysid_bench.models.manifest import TERMS
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.regression import regression
from sysid_bench.simulation.plant import contact_free
from sysid_bench.spatial import body_mass_inertia, feasible_margins
from sysid_bench.types import Array, Trajectory
from tests.robots import named_robot, random_mjcf, relative_gap, robot_of, states

ROBOTS = ("ur5", "panda", "solo12", "xarm7", "tree 1", "tree 2", "tree 7")
SETS: tuple[tuple[str, ...], ...] = ((), ("viscous", "coulomb"), TERMS)


@pytest.fixture(scope="module", params=ROBOTS)
def loaded(request: pytest.FixtureRequest) -> RobotModel:
    if request.param.startswith("tree"):
        text = random_mjcf(int(request.param.split()[1]))
        return robot_of(text, PAYLOADS["sphere-offset-1kg"])
    return named_robot(request.param, "sphere-offset-1kg")


def tasks(robot: RobotModel) -> list[Task]:
    wanted = [("robot", terms) for terms in SETS] + [("payload", ())]
    if robot.tree.carrier[robot.tool_body] >= 0:
        wanted.append(("link", ()))
    return [task_of(robot, name, terms) for name, terms in wanted]


def plant_torque(robot: RobotModel, motion: Trajectory) -> Array:
    """MuJoCo's inverse dynamics with its own springs, dampers and armature; what it does not know
    as a smooth force (Coulomb friction, offsets) is added by its definition."""
    mj = contact_free(robot.spec.copy().compile())
    mj.dof_frictionloss[:] = 0.0  # a constraint in MuJoCo
    data = mujoco.MjData(mj)
    tau = np.empty_like(motion.v)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        mujoco.mj_inverse(mj, data)
        tau[k] = data.qfrc_inverse
    return np.asarray(
        tau + robot.joint_terms.coulomb * np.sign(motion.v) + robot.joint_terms.offset
    )


def known_torque(robot: RobotModel, task: Task, motion: Trajectory) -> Array:
    tau = newton_euler(robot.tree, task.known_links, motion)
    for term, values in task.known_terms.items():
        columns = robot.term_columns((term,))
        tau += regression(robot, columns).torque(motion, values[robot.scalar_dofs])
    # Joint terms of balls and free bases have no parameters: they are known wherever they are.
    rest = np.setdiff1d(np.arange(robot.nv), robot.scalar_dofs)
    v, a = motion.v[:, rest], motion.a[:, rest]
    for term, motions in (("viscous", v), ("coulomb", np.sign(v)), ("armature", a)):
        tau[:, rest] += task.known_terms[term][rest] * motions
    return tau


def test_known_and_unknown_together_are_the_plant(loaded: RobotModel) -> None:
    motion = states(loaded, 5)
    truth = plant_torque(loaded, motion)
    for task in tasks(loaded):
        asked = regression(loaded, task.parameters).torque(motion, task.truth.theta)
        assert relative_gap(known_torque(loaded, task, motion) + asked, truth) < 1e-11


def test_the_truths_of_all_tasks_are_one(loaded: RobotModel) -> None:
    """The robot's composite, lumped, is the link's truth, and the payload is the difference."""
    robot, payload = task_of(loaded, "robot", ()), task_of(loaded, "payload", ())
    phi = np.zeros_like(loaded.phi)
    own = [i for i in range(len(phi)) if i != loaded.payload_body]
    phi[own] = robot.truth.theta.reshape(-1, 10)
    np.testing.assert_allclose(
        loaded.tree.link_parameters(phi), loaded.tree.link_parameters(loaded.phi), atol=1e-10
    )
    np.testing.assert_array_equal(payload.truth.theta, loaded.phi[loaded.payload_body])
    if loaded.tree.carrier[loaded.tool_body] < 0:
        return
    link = task_of(loaded, "link", ())
    carrier = int(loaded.tree.carrier[loaded.tool_body])
    np.testing.assert_allclose(
        link.truth.theta, loaded.tree.link_parameters(phi)[carrier], atol=1e-10
    )
    with_link = link.known_links.copy()
    with_link[carrier] += link.truth.theta
    np.testing.assert_allclose(with_link, loaded.tree.link_parameters(loaded.phi), atol=1e-10)


def test_a_task_is_well_formed(loaded: RobotModel) -> None:
    for task in tasks(loaded):
        names = task.parameters
        assert len(set(names)) == len(names) == len(task.truth.theta)
        bodies = [column for body in task.bodies for column in body.columns]
        assert tuple(bodies) == names[: len(bodies)]
        assert all(name.split(".")[-1] in SUFFIX.values() for name in names[len(bodies) :])
        assert set(task.known_terms) <= set(TERMS)


@pytest.mark.parametrize("terms", SETS)
def test_a_term_is_asked_or_known_and_never_both(terms: tuple[str, ...]) -> None:
    robot = named_robot("ur5")
    task = task_of(robot, "robot", terms)
    asked = {f"{joint}.{SUFFIX[term]}" for term in terms for joint in robot.rows}
    assert asked <= set(task.parameters)
    for term, known in task.known_terms.items():
        reported = 0.0 if term in terms else getattr(robot.joint_terms, term)
        np.testing.assert_array_equal(known, np.broadcast_to(reported, known.shape))
    values = dict(zip(task.parameters, task.truth.theta, strict=True))
    for term in terms:
        for joint, value in zip(robot.rows, getattr(robot.joint_terms, term), strict=True):
            assert values[f"{joint}.{SUFFIX[term]}"] == value


def test_only_a_bare_robot_asked_whole_knows_nothing() -> None:
    robot = named_robot("ur5")
    assert not task_of(robot, "robot", TERMS).has_known_part
    assert task_of(robot, "robot", ()).has_known_part  # its friction
    assert task_of(robot, "link", ()).has_known_part


def test_what_cannot_be_asked_is_refused() -> None:
    robot = named_robot("ur5")
    with pytest.raises(UnsupportedError, match="No payload is mounted"):
        task_of(robot, "payload", ())
    with pytest.raises(UsageError, match="Did you mean 'payload'"):
        task_of(robot, "payloads", ())
    with pytest.raises(UsageError, match="Did you mean 'viscous'"):
        task_of(robot, "robot", ("viscos",))


def test_a_tool_that_stands_still_has_no_link_task() -> None:
    text = """<mujoco><worldbody><body name="base"><body name="arm"><joint/>
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""
    with pytest.raises(UnsupportedError, match="'base' does not move"):
        task_of(robot_of(text, tool="base"), "link", ())


def bodies(task: Task) -> set[str]:
    return {column for body in task.bodies for column in body.columns}


@pytest.mark.parametrize("seed", range(5))
def test_priors_can_exist_and_are_not_the_truth(loaded: RobotModel, seed: int) -> None:
    for task in tasks(loaded):
        prior = prior_of(task, PriorSpread(), np.random.default_rng(seed))
        assert np.isfinite(prior.theta).all()
        assert (prior.std >= 0).all()
        places = {name: i for i, name in enumerate(task.parameters)}
        for body in task.bodies:
            at = [places[column] for column in body.columns]
            truth, reported = task.truth.theta[at], prior.theta[at]
            assert feasible_margins(reported) >= -1e-12 * max(np.abs(reported).max(), 1e-12)
            if truth[0] > 0:
                assert (reported != truth).any()
                assert reported[0] > 0
                assert (prior.std[at][[0, 1, 2, 3]] > 0).all()
            else:
                np.testing.assert_array_equal(reported, truth)
        terms = [i for name, i in places.items() if name not in bodies(task)]
        truth, reported = task.truth.theta[terms], prior.theta[terms]
        signs = np.sign(reported)
        np.testing.assert_array_equal(signs[truth != 0], np.sign(truth[truth != 0]))
        offsets = np.array(
            [name.endswith(".offset") for name in places if name not in bodies(task)], dtype=bool
        )
        assert (signs[~offsets] > 0).all()  # also where the truth is zero
        assert (reported != truth).all()


def test_priors_spread_as_they_are_declared() -> None:
    """Over many draws the mass scatters by the declared share and the centre by its length."""
    task = task_of(named_robot("ur5", "box-2kg"), "payload", ())
    spread = PriorSpread(mass=0.1, com=0.01)
    rng = np.random.default_rng(0)
    drawn = np.array([prior_of(task, spread, rng).theta for _ in range(2000)])
    truth = task.truth.theta
    assert np.std(np.log(drawn[:, 0] / truth[0])) == pytest.approx(0.1, rel=0.1)
    centres = drawn[:, 1:4] / drawn[:, :1] - truth[1:4] / truth[0]
    np.testing.assert_allclose(centres.std(axis=0), 0.01, rtol=0.1)
    np.testing.assert_allclose(centres.mean(axis=0), 0, atol=0.001)


def test_the_truth_is_reported_where_it_is_asked_for() -> None:
    task = task_of(named_robot("ur5"), "robot", TERMS)
    prior = prior_of(task, None, np.random.default_rng(0))
    np.testing.assert_array_equal(prior.theta, task.truth.theta)
    assert prior.theta is not task.truth.theta
    assert not prior.std.any()


def test_a_prior_does_not_change_the_truth_and_is_the_same_again() -> None:
    task = task_of(named_robot("ur5"), "robot", TERMS)
    before = task.truth.theta.copy()
    one, other = (prior_of(task, PriorSpread(), np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(task.truth.theta, before)
    np.testing.assert_array_equal(one.theta, other.theta)
    np.testing.assert_array_equal(one.std, other.std)


def test_inertias_of_a_prior_are_turned() -> None:
    """A CAD model gets the axes wrong as well: by half the share of the inertia, in rad."""
    task = task_of(named_robot("ur5", "box-2kg"), "payload", ())
    _, _, inertia = body_mass_inertia(task.truth.theta)
    spreads = {
        0.0: PriorSpread(inertia=0.0),
        0.1: PriorSpread(inertia=0.0, axes=0.1),
        0.025: PriorSpread(inertia=0.05),
    }
    for expected, spread in spreads.items():
        rng, angles = np.random.default_rng(0), []
        for _ in range(300):
            _, _, drawn = body_mass_inertia(prior_of(task, spread, rng).theta)
            # The principal axes, in the order of the moments, as a small rotation.
            R = np.linalg.eigh(inertia)[1].T @ np.linalg.eigh(drawn)[1]
            R *= np.sign(np.diag(R))
            angles.append([R[2, 1], R[0, 2], R[1, 0]])
        assert float(np.std(angles)) == pytest.approx(expected, rel=0.1, abs=1e-6)


def test_unknown_friction_does_not_follow_the_joints_own() -> None:
    """Drawn about the size of all joints: neither their order nor their zeros show."""
    task = task_of(named_robot("ur5"), "robot", TERMS)
    kind = [i for i, name in enumerate(task.parameters) if name.endswith(".fc")]
    truth = np.array([0.5, 8.0, 2.0, 0.0, 4.0, 1.0])
    theta = task.truth.theta.copy()
    theta[kind] = truth
    task = replace(task, truth=replace(task.truth, theta=theta))
    rng = np.random.default_rng(1)
    known, unknown = (
        np.log([prior_of(task, PriorSpread(friction=f), rng).theta[kind] for _ in range(200)])
        for f in (None, "unknown")
    )
    typical = np.log(truth[truth > 0]).mean()
    np.testing.assert_allclose(unknown.mean(axis=0), typical, atol=0.2)
    np.testing.assert_allclose(unknown.std(axis=0), 1.0, atol=0.1)
    at = truth > 0
    np.testing.assert_allclose(known.mean(axis=0)[at], np.log(truth[at]), atol=0.1)
    np.testing.assert_allclose(known.std(axis=0)[at], 0.3, atol=0.05)
    assert (known[:, ~at] < np.log(0.05 * truth.max())).all()


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_misdeclared_prior_is_the_same_draw(factor: float) -> None:
    task = task_of(named_robot("ur5"), "robot", TERMS)
    one, other = (
        prior_of(task, PriorSpread(declared=declared), np.random.default_rng(3))
        for declared in (1.0, factor)
    )
    np.testing.assert_array_equal(one.theta, other.theta)
    np.testing.assert_allclose(other.std, factor * one.std)


def test_exact_terms_stay_exact() -> None:
    task = task_of(named_robot("ur5"), "robot", TERMS)
    at = [i for i, name in enumerate(task.parameters) if name not in bodies(task)]
    prior = prior_of(task, PriorSpread(terms=0.0), np.random.default_rng(3))
    np.testing.assert_array_equal(prior.theta[at], task.truth.theta[at])
