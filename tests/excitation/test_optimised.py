"""Laws of designed motions: better than random ones, within all limits, the same for a seed."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.design_cost import DesignCost
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.design_space import FAMILIES, curves_of
from sysid_bench.excitation.information import information_model, torque_model
from sysid_bench.excitation.limits import smooth_bound
from sysid_bench.excitation.optimised import Optimised, design_criterion, excitation_parameters
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.models.random_robot import RandomRobot, random_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Trajectory
from tests.robots import named_robot, robot_of

QUICK = {"harmonics": 2, "period": 5.0, "iterations": 6}
TREES = RandomRobot(bodies=(4, 4), ball=0.0, free_root=0.0, welded=0.0)


def brief(robot: RobotModel, rate: float = 100.0, terms: tuple[str, ...] = ()) -> DesignProblem:
    base = structural_base(robot, robot.inertial_columns + robot.term_columns(terms))
    return replace(
        design_problem(robot, rate),
        regress=information_model(robot, base.names),
        torque=torque_model(robot),
        scene=partial(collision_model, robot),
    )


def test_families_are_the_derivatives_of_themselves() -> None:
    t = np.linspace(0.3, 9.7, 50)
    h = 1e-5
    for kind in FAMILIES:
        curves = curves_of(kind, 10.0, 4)
        x, dx, ddx = curves.at(t)
        up, down = curves.at(t + h), curves.at(t - h)
        np.testing.assert_allclose((up[0] - down[0]) / (2 * h), dx, atol=1e-7)
        np.testing.assert_allclose((up[1] - down[1]) / (2 * h), ddx, atol=1e-6)
        assert x.shape == (50, curves.size) == (50, 9)
        assert np.linalg.matrix_rank(x) == 9
        np.testing.assert_allclose(x[:, 0], 1.0)


@pytest.mark.parametrize("kind", ["fourier-polynomial", "b-spline"])
@pytest.mark.parametrize("harmonics", [1, 3, 7])
def test_families_for_hardware_rest_at_both_ends(kind: str, harmonics: int) -> None:
    _, dx, ddx = curves_of(kind, 7.0, harmonics).at(np.array([0.0, 7.0]))
    np.testing.assert_allclose(dx, 0.0, atol=1e-10)
    np.testing.assert_allclose(ddx, 0.0, atol=1e-9)


def test_a_smooth_maximum_lies_above_and_near() -> None:
    use = np.random.default_rng(0).uniform(-1, 1, (100, 4))
    value, slope = smooth_bound(use, 60.0)
    top = np.abs(use).max(axis=0)
    assert (value >= top).all()
    assert (value <= top + np.log(200) / 60.0).all()
    assert (np.abs(slope).sum(axis=0) <= 1.0 + 1e-12).all()


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("objective", ["cond", {"D": 1.0, "A": 0.5}])
@pytest.mark.parametrize("seed", [1, 5])
def test_slopes_of_a_search_are_its_differences(family: str, objective: object, seed: int) -> None:
    """Criterion and limits alike, by the coefficients."""
    robot = robot_of(random_robot(seed, TREES))
    given = replace(brief(robot, terms=("viscous", "coulomb")), tau=np.full(robot.nv, 30.0))
    made = Optimised(objective=objective, family=family, **QUICK)  # type: ignore[arg-type]
    space, rng = made.space(given), np.random.default_rng(seed)
    draws = [space.random(rng, 0.5) for _ in range(8)]
    assert given.regress is not None
    asked = excitation_parameters(space, given.regress, draws).smooth
    criterion = design_criterion(objective, asked, space, draws)  # type: ignore[arg-type]
    evaluation = DesignCost(space, asked, criterion, made.limits(given))
    C, step = draws[0], 1e-6
    slope = evaluation.gradient(C)
    _, limits = evaluation.smooth_limits(C, 60.0)
    for i, j in [(0, 0), (1, 0), (3, -1), (4, -1)]:
        up, down = C.copy(), C.copy()
        up[i, j] += step
        down[i, j] -= step
        difference = (evaluation.value(up) - evaluation.value(down)) / (2 * step)
        assert abs(slope[i, j] - difference) <= 1e-4 * np.abs(slope).max() + 1e-6
        differences = (
            evaluation.smooth_limits(up, 60.0)[0] - evaluation.smooth_limits(down, 60.0)[0]
        ) / 2e-6
        pulled = limits.reshape(-1, *C.shape)[:, i, j]
        near = evaluation.smooth_limits(C, 60.0)[0] > 0.6  # farther ones are not looked at closer
        np.testing.assert_allclose(pulled[near], differences[near], atol=1e-4)


@pytest.mark.parametrize("name", ["xarm7", pytest.param("ur5", marks=pytest.mark.long)])
def test_a_design_beats_random_motions_and_keeps_every_limit(name: str) -> None:
    robot = named_robot(name, "box-2kg")
    given = brief(robot)
    tau = np.abs(torque_model(robot).of(_random(given))).max(axis=0) * 2.5
    given = replace(given, tau=tau)
    made = Optimised("D", harmonics=2, period=5.0, iterations=15, clearance=0.01)
    design = made.solve(given, np.random.default_rng(0))
    assert design.value < design.start - 0.3  # per parameter: exp(0.15) in every standard deviation
    fine = made.motion(design.C, given.at(2000.0))
    assert (np.abs(fine.v) <= robot.limits.v).all()
    assert (np.abs(fine.a) <= robot.limits.a).all()
    assert (np.abs(torque_model(robot).of(fine)) <= tau).all()
    scalar = [joint.qadr for joint in robot.joints]
    assert (fine.q[:, scalar] >= robot.limits.q_low).all()
    assert (fine.q[:, scalar] <= robot.limits.q_high).all()
    used = made.report(design.C, given)
    assert set(used) == {"position", "velocity", "acceleration", "torque", "collision"}
    assert all(one.use <= 1.0 and one.margin >= 0.0 for one in used.values())
    assert used["collision"].value >= 0.01


def _random(given: DesignProblem) -> Trajectory:
    space = Optimised(**QUICK).space(given)  # type: ignore[arg-type]
    return space.motion(space.random(np.random.default_rng(9), 0.7), np.linspace(0, 5, 50))


def test_a_design_is_its_seed_whatever_the_rate() -> None:
    given = brief(named_robot("ur5"))
    made = Optimised(**QUICK)  # type: ignore[arg-type]
    one = made.design(given, np.random.default_rng(3))
    same = made.design(given.at(500.0), np.random.default_rng(3))
    other = made.design(given, np.random.default_rng(4))
    np.testing.assert_array_equal(one.q, same.q[::5])
    assert np.abs(one.q - other.q).max() > 0.1


def test_joints_that_are_not_named_hold_still() -> None:
    robot = named_robot("ur5")
    given = brief(robot)
    made = Optimised(joints=("elbow_joint", "wrist_1_joint"), **QUICK)  # type: ignore[arg-type]
    motion = made.design(given, np.random.default_rng(0))
    moving = [robot.rows.index(name) for name in made.joints]
    held = [i for i in range(robot.nv) if i not in moving]
    assert (motion.v[:, held] == 0).all()
    assert (np.abs(motion.v[:, moving]).max(axis=0) > 0.1).all()


def test_boxes_hold_a_named_body() -> None:
    robot = named_robot("ur5")
    given = brief(robot)
    body = robot.body_names[robot.tool_body]
    box = {body: [[-2, 2], [-2, 2], [0.1, 2]]}
    made = Optimised(boxes=box, **QUICK)  # type: ignore[arg-type]
    design = made.solve(given, np.random.default_rng(0))
    scene = collision_model(robot)
    motion = made.motion(design.C, given)
    place = [robot.body_names.index(body) + 1]
    assert min(scene.positions(q, place)[0][0, 2] for q in motion.q) >= 0.1


def test_what_was_recorded_changes_what_to_run_next() -> None:
    given = brief(named_robot("ur5"))
    made = Optimised(objective="D", **QUICK)  # type: ignore[arg-type]
    first = made.design(given, np.random.default_rng(0))
    after = made.solve(given, np.random.default_rng(0), known=[first])
    assert np.abs(after.C - made.solve(given, np.random.default_rng(0)).C).max() > 1e-3


def test_an_interrupt_leaves_the_best_feasible_so_far() -> None:
    given = brief(named_robot("ur5"))
    made = Optimised(objective="D", harmonics=2, period=5.0, iterations=200)

    def stop(count: int, value: float) -> None:
        if count >= 25:
            raise KeyboardInterrupt

    design = made.solve(given, np.random.default_rng(0), progress=stop)
    assert design.interrupted
    assert design.evaluations <= 26
    assert max(used.use for used in made.report(design.C, given).values()) <= 1.0


@pytest.mark.parametrize(
    "bad",
    [
        {"objective": "best"},
        {"family": "taylor"},
        {"harmonics": 0},
        {"harmonics": 101},
        {"period": -1.0},
        {"torque_share": 1.5},
        {"iterations": 0},
    ],
)
def test_settings_that_make_no_design_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        Optimised(**bad)  # type: ignore[arg-type]


def test_what_cannot_be_designed_is_said() -> None:
    robot = named_robot("ur5")
    given = brief(robot)
    with pytest.raises(UsageError, match="needs a regressor"):
        Optimised(**QUICK).design(design_problem(robot, 100.0), np.random.default_rng(0))  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="elbow_joint"):
        Optimised(joints=("elbo_joint",)).design(given, np.random.default_rng(0))
    weak = replace(given, tau=np.full(robot.nv, 1e-3))
    with pytest.raises(UnsupportedError, match="torque"):
        Optimised(harmonics=1, period=2.0, iterations=1).design(weak, np.random.default_rng(0))


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.long)])
def test_a_start_outside_of_its_bounds_is_brought_inside(seed: int) -> None:
    """Short curves that rest at their ends may begin beyond what one coefficient may be."""
    given = brief(named_robot("panda"))
    made = Optimised("cond", family="fourier-polynomial", iterations=3, clearance=0.01)
    assert np.isfinite(made.solve(given, np.random.default_rng(seed)).value)


@pytest.mark.parametrize(("name", "height"), [("ur10", 0.1), ("ur5", 0.05), ("ur3", 0.1)])
def test_a_floor_is_watched_by_all_that_can_leave_it(name: str, height: float) -> None:
    """An arm that lies on it in the reference configuration is not there by construction."""
    robot = named_robot(name)
    scene = collision_model(robot, height)
    excused = {b for a, b in scene.ignored if a == "world"}
    moving = [robot.body_names[link.body] for link in robot.tree.links]
    assert excused.isdisjoint(moving[2:])
    low = np.array(robot.mj.qpos0)
    assert any("world" in pair for _, pair, _ in scene.contact_list(low))


@pytest.mark.parametrize("seed", range(3))
def test_more_starts_never_make_a_motion_worse(seed: int) -> None:
    given = brief(named_robot("scara"))
    values = [
        replace(Optimised("cond", **QUICK), starts=starts).solve(given, np.random.default_rng(seed))  # type: ignore[arg-type]
        for starts in (1, 2, 4)
    ]
    first, *others = [design.value for design in values]
    assert all(value <= first for value in others)
