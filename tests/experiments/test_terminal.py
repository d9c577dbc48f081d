"""The torque of the last joint alone: what it identifies, and that its RMSE hides the rest."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import sympy as sp

from sysid_bench import package_folders
from sysid_bench.errors import UnsupportedError
from sysid_bench.evaluation.score import score
from sysid_bench.experiments.cell_data import cell_data
from sysid_bench.experiments.tasks.task import Task, task_of
from sysid_bench.identifiability.base_expressions import parameter_verdict
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.identification.estimators.linear import MinNorm
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.regression import regression
from sysid_bench.regressors.symbolic_regressor import (
    DW,
    D,
    W,
    body_regressor,
    with_point_acceleration,
)
from sysid_bench.types import Array, BaseMap, Trajectory
from tests.experiments.experiment_world import argument, executed, ready, robot_of, solved, spec
from tests.robots import SCARA, named_robot, states
from tests.robots import robot_of as robot_of_text

FRICTION = ("viscous", "coulomb")
REVOLUTE = (
    "ur3_robot", "ur5_robot", "ur10_robot", "ur5_joint_limited_robot", "kinova", "panda", "xarm7",
    "z1", "so100", "so101", "talos_left_arm", "tiago_no_hand", "baxter", "icub",
)  # fmt: skip
SLIDES = (
    "agilex_piper__piper", "arx_l5__arx_l5", "franka_emika_panda__panda", "trossen_vx300s__vx300s",
)  # fmt: skip
LOAD = PAYLOADS["box-2kg"]


def arm(name: str) -> RobotModel:
    if name in package_folders.robots():
        return named_robot(name, "box-2kg")
    path = next(package_folders.robot_data_folder().rglob(f"{name}.urdf"))
    return load_robot(path, LOAD)


def base_of(robot: RobotModel, task: str, terms: tuple[str, ...] = ()) -> tuple[Task, BaseMap]:
    question = task_of(robot, task, terms)
    return question, structural_base(robot, question.parameters, question.rows)


def ranks(robot: RobotModel) -> tuple[int, int, int, int]:
    """Ranks of terminal, terminal with friction, link and payload."""
    wanted = (("terminal", ()), ("terminal", FRICTION), ("link", ()), ("payload", ()))
    a, b, c, d = (base_of(robot, task, terms)[1].rank for task, terms in wanted)
    return a, b, c, d


@pytest.mark.parametrize("name", REVOLUTE)
def test_a_revolute_last_joint_identifies_seven_and_never_the_mass(name: str) -> None:
    robot = arm(name)
    assert ranks(robot) == (7, 9, 10, 10)
    task, base = base_of(robot, "terminal", FRICTION)
    verdict = dict(zip(task.parameters, parameter_verdict(base), strict=True))
    (body,) = task.bodies
    (joint,) = task.rows or ()
    assert len(verdict) == 12
    assert verdict[f"{body.name}.m"] == "none"
    assert verdict[f"{joint}.fv"] == verdict[f"{joint}.fc"] == "identifiable"
    assert base.gap > 1e6
    for whole in ("link", "payload"):
        assert set(parameter_verdict(base_of(robot, whole)[1])) == {"identifiable"}


@pytest.mark.data
@pytest.mark.parametrize("name", SLIDES)
def test_a_slide_identifies_the_mass_and_its_moments(name: str, data_folder: Path) -> None:
    robot = load_robot(data_folder / "robots" / f"{name}.xml", LOAD)
    assert ranks(robot) == (4, 6, 10, 10)
    _, base = base_of(robot, "terminal")
    assert parameter_verdict(base) == ("identifiable",) * 4 + ("none",) * 6


def test_a_scara_identifies_three_and_four() -> None:
    for robot in (robot_of_text(SCARA, LOAD), arm("scara")):
        assert ranks(robot) == (3, 5, 4, 4)


@pytest.mark.parametrize("name", ["ur5", "panda", "z1"])
def test_the_row_is_the_axis_times_the_moment_rows_of_the_body_regressor(name: str) -> None:
    """Y = a' Y_{1:3} of the terminal link, about a point of the joint's axis."""
    robot = named_robot(name, "box-2kg")
    task, _ = base_of(robot, "terminal")
    motion = states(robot, 20)
    (row,) = task.rows or ()
    row_index = robot.rows.index(row)
    Y = regression(robot, task.parameters).dense(motion).Y[:, row_index]
    link = robot.tree.links[int(robot.tree.carrier[robot.tool_body])]
    joint = link.joints[-1]
    assert not joint.anchor.any()
    entries = sp.lambdify([W, DW, D], with_point_acceleration(body_regressor()), "numpy")
    moments = np.array([entries(*state)[:3] for state in _link_states(robot, link.body, motion)])
    seed = np.einsum("i,nij->nj", joint.axis, moments)
    np.testing.assert_allclose(Y, seed, atol=1e-10 * np.abs(seed).max())


def _link_states(robot: RobotModel, body: int, motion: Trajectory) -> Iterator[tuple[Array, ...]]:
    """(w, dw, d) of a body in its axes by MuJoCo; d: acceleration of its origin less gravity."""
    mj, data = robot.mj, mujoco.MjData(robot.mj)
    velocity, acceleration = np.empty(6), np.empty(6)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:] = motion.q[k], motion.v[k]
        mujoco.mj_forward(mj, data)
        data.qacc[:] = motion.a[k]
        mujoco.mj_rnePostConstraint(mj, data)
        kind = mujoco.mjtObj.mjOBJ_XBODY
        mujoco.mj_objectVelocity(mj, data, kind, body + 1, velocity, 1)
        mujoco.mj_objectAcceleration(mj, data, kind, body + 1, acceleration, 1)
        yield velocity[:3].copy(), acceleration[:3].copy(), acceleration[3:].copy()


@pytest.mark.parametrize("payload", ["box-2kg", "sphere-offset-1kg"])
@pytest.mark.parametrize("name", ["ur5", "panda", "kinova", "xarm7"])
def test_rmse_is_at_rounding_level_and_the_mass_is_wrong(name: str, payload: str) -> None:
    made = ready(robot=name, payload=payload, task="terminal", terms=FRICTION)
    _, scores = solved(made, MinNorm())
    assert (scores.rank, scores.parameters) == (9, 12)
    scale = np.abs(made.problem.b).max()
    assert max(scores.rmse_train, scores.rmse_test) < 1e-9 * scale
    assert scores.mass_error > 0.99 * made.source.truth.theta[0] > 0.9
    assert scores.condition is not None


@pytest.mark.parametrize("name", ["ur5", "panda", "scara"])
def test_there_is_no_centre_of_a_mass_that_nothing_determines(name: str) -> None:
    made = ready(robot=name, payload="box-2kg", task="terminal", terms=FRICTION)
    estimate, scores = solved(made, MinNorm())
    assert scores.mass_error == pytest.approx(made.source.truth.theta[0])
    assert scores.com_error is scores.payload_com_error is None
    assert scores.inertia_error is scores.payload_inertia_error is None
    of_prior = replace(estimate, theta=made.source.truth.theta)
    known = score(of_prior, made.problem, made.held_out, made.source.truth)
    assert known.com_error == known.inertia_error == 0.0


@pytest.mark.parametrize("task", ["link", "payload"])
def test_a_mass_that_all_joints_determine_has_one(task: str) -> None:
    made = ready(robot="ur5", payload="box-2kg", task=task)
    _, scores = solved(made, MinNorm())
    assert max(scores.com_error, scores.inertia_error) < 1e-9


def test_the_estimate_is_the_pseudoinverse_of_all_columns() -> None:
    made = ready(robot="ur5", payload="box-2kg", task="terminal", terms=FRICTION)
    theta = solved(made, MinNorm())[0].theta
    columns = regression(made.robot, made.source.task.parameters)
    motion = made.experiment.recording.motion
    row_index = made.robot.rows.index(made.problem.rows[0])
    Y = columns.dense(motion).Y[:, row_index]
    tau = made.experiment.recording.tau[:, row_index] - made.source.known[:, 0]
    np.testing.assert_allclose(theta, np.linalg.pinv(Y, rcond=1e-10) @ tau, atol=1e-9)


@pytest.mark.parametrize("task", ["terminal", "link", "payload"])
def test_rows_show_the_verdict_on_every_parameter(task: str) -> None:
    made = spec(robot="panda", payload="box-2kg", task=task, terms=FRICTION)
    least, short = executed(made, "ols", "min-norm")
    # Beside the link, `link` has two terms of each of nine joints unknown.
    rank, size = {"terminal": (9, 12), "link": (28, 28), "payload": (10, 10)}[task]
    assert (short["rank"], short["parameters"]) == (rank, size)
    table = short["parameters_table"]
    assert len(table) == size
    assert len(least["parameters_table"]) == least["rank"]
    for line in table:
        right = abs(line["estimate"] - line["true"]) < 1e-6
        assert right or line["identifiable"] != "identifiable", line
        assert (line["std"] is None) == (line["identifiable"] != "identifiable")
    mass = next(line for line in table if line["name"] == "m")
    assert (mass["identifiable"] == "identifiable") == (task != "terminal")
    assert short["rmse_train"] == pytest.approx(least["rmse_train"], abs=1e-9)


def test_all_of_a_problem_is_the_rows_that_are_measured() -> None:
    made = ready(robot="ur5", payload="box-2kg", task="terminal")
    assert made.problem.rows == ("wrist_3_joint",)
    assert len(made.problem.factors) == 1
    Y, b = next(made.problem.blocks())
    (regressed,) = list(made.experiment.regress(made.experiment.recording.motion))[:1]
    assert Y.shape[1:] == regressed.shape[1:] == (1, 7)
    assert b.shape[1:] == (1,)
    whole = ready(robot="ur5", payload="box-2kg", task="link")
    row = whole.problem.rows.index("wrist_3_joint")
    every = np.concatenate([b for _, b in whole.problem.blocks()])
    np.testing.assert_allclose(made.problem.b, every[:, row], atol=1e-12)


def test_friction_is_unknown_for_the_terminal_joint_alone_and_known_elsewhere() -> None:
    robot = robot_of("ur5", "box-2kg")
    task = task_of(robot, "terminal", ("viscous",))
    row_index = robot.rows.index("wrist_3_joint")
    assert task.known_terms["viscous"][row_index] == 0.0
    others = np.arange(robot.nv) != row_index
    np.testing.assert_array_equal(
        task.known_terms["viscous"][others], robot.joint_terms.viscous[others]
    )
    np.testing.assert_array_equal(task.known_terms["coulomb"], robot.joint_terms.coulomb)
    assert task.truth.theta[-1] == robot.joint_terms.viscous[row_index]


def test_a_tool_that_stands_still_has_no_terminal_joint() -> None:
    text = """<mujoco><worldbody><body name="base"><body name="arm"><joint/>
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""
    with pytest.raises(UnsupportedError, match="'base' does not move"):
        task_of(robot_of_text(text, tool="base"), "terminal", ())


def test_a_picture_shows_the_measured_row_alone() -> None:
    made = spec(robot="ur5", payload="box-2kg", task="terminal", terms=FRICTION)
    (row,) = executed(made, "min-norm")
    shown = cell_data(argument(made, "min-norm"), row)
    assert shown.rows == ("wrist_3_joint",)
    assert shown.predicted is not None
    assert shown.predicted.shape == shown.measured.shape == (len(shown.motion), 1)
    assert shown.gap_map.shape == (1, len(shown.gap_columns))
    np.testing.assert_allclose(shown.predicted, shown.measured, atol=1e-9)
