"""Plausible bodies, distinguished from implausible ones."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.evaluation.score import body_plausibility, plausibility_findings, score
from sysid_bench.identification.estimators.feasible import LMI
from sysid_bench.models.shape import body_extents
from sysid_bench.spatial import phi_of
from sysid_bench.types import BodyExtents, Estimate, Score
from tests.experiments.experiment_world import SHIPPED, ready, ready_once
from tests.robots import named_robot

BOX = BodyExtents(np.array([-0.2, -0.2, -0.2]), np.array([0.2, 0.2, 0.6]), 0.01)
SOLID = np.diag([0.02, 0.02, 0.02])


@pytest.mark.parametrize("name", SHIPPED)
def test_every_body_of_a_shipped_robot_is_plausible(name: str) -> None:
    robot = named_robot(name)
    boxes = body_extents(robot)
    assert set(boxes) == set(robot.body_names)
    assert all((box.low < box.high).all() and box.volume > 0 for box in boxes.values())
    assert plausibility_findings(dict(zip(robot.body_names, robot.phi, strict=True)), boxes) == {}


@pytest.mark.parametrize("name", SHIPPED)
def test_a_tonne_in_a_link_is_seen_and_named(name: str) -> None:
    robot = named_robot(name)
    heavy = dict.fromkeys(robot.body_names, 2000.0)
    bodies = {body: phi_of(mass, np.zeros(3), mass * SOLID) for body, mass in heavy.items()}
    said = plausibility_findings(bodies, body_extents(robot))
    assert all("denser than steel" in words for words in said.values())
    assert len(said) > 0.5 * len(bodies)


def test_what_is_odd_is_said() -> None:
    centre = np.array([0.0, 0.1, 0.5])
    assert body_plausibility(phi_of(3.0, centre, SOLID), BOX) == ""
    assert "0.3 m outside" in body_plausibility(phi_of(3.0, np.array([0.0, 0.5, 0.0]), SOLID), BOX)
    assert "denser than steel" in body_plausibility(phi_of(100.0, centre, SOLID), BOX)
    assert "not physically feasible" in body_plausibility(phi_of(3.0, centre, -SOLID), BOX)
    assert body_plausibility(phi_of(100.0, 9 * centre, SOLID), None) == ""  # nothing is known of it
    assert body_plausibility(np.zeros(10), BOX) == ""  # a frame


def test_a_payload_has_no_extent() -> None:
    robot = named_robot("ur5", "box-2kg")
    assert robot.payload_body is not None
    assert set(body_extents(robot)) == set(robot.body_names) - {
        robot.body_names[robot.payload_body]
    }


def test_the_score_says_what_is_feasible_and_what_is_plausible() -> None:
    made = ready_once("ur5")
    boxes = body_extents(made.robot)

    def figures(factor: float, boxes: Mapping[str, BodyExtents] | None) -> Score:
        theta = factor * made.source.truth.theta
        estimate = Estimate(theta=theta, beta=made.problem.base.K @ theta)
        return score(estimate, made.problem, made.held_out, made.source.truth, boxes)

    assert figures(1, None).plausible is None
    assert (figures(1, boxes).feasible, figures(1, boxes).plausible) == (True, True)
    assert (figures(1000, boxes).feasible, figures(1000, boxes).plausible) == (True, False)


def test_a_feasible_fit_without_a_prior_may_be_implausible() -> None:
    """The reason to distinguish the two."""
    found = set()
    for robot in ("ur5", "z1", "panda"):
        made = ready(robot=robot, noise={"tau_relative": 0.3})
        problem = replace(made.problem, prior=None)
        estimate = LMI().solve(problem)
        assert estimate.theta is not None
        estimate = replace(estimate, beta=problem.base.K @ estimate.theta)
        figures = score(
            estimate, problem, made.held_out, made.source.truth, body_extents(made.robot)
        )
        assert figures.feasible
        found.add(figures.plausible)
    assert False in found
