"""Placeholder inertias: recognised in any robot that has them, in none that was modelled."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.models.model_checks import placeholder_reason
from sysid_bench.models.robot import RobotModel
from sysid_bench.spatial import phi_of
from tests.robots import NAMED, named_robot

UNEQUAL = ("ur5", "panda", "xarm7", "kinova")
"""Arms whose links differ in length."""


def with_phi(robot: RobotModel, phi: np.ndarray) -> RobotModel:
    return replace(robot, phi=phi)


@pytest.mark.parametrize("name", NAMED)
def test_modelled_robots_are_believed(name: str) -> None:
    assert placeholder_reason(named_robot(name)) == ""


@pytest.mark.parametrize("name", UNEQUAL)
@pytest.mark.parametrize(("mass", "moment"), [(1.0, 1.0), (2.0, 0.01), (1.0, 1e-3)])
def test_the_same_numbers_on_all_links_are_not_believed(
    name: str, mass: float, moment: float
) -> None:
    robot = named_robot(name)
    same = phi_of(mass, np.zeros(3), moment * np.eye(3))
    phi = np.tile(same, (len(robot.phi), 1))
    # Bodies welded to others add to their links; the links themselves are equal.
    links = {robot.tree.carrier.tolist().index(k) for k in set(robot.tree.carrier.tolist())}
    phi[[b not in links for b in range(len(phi))]] = 0.0
    assert "same mass" in placeholder_reason(with_phi(robot, phi))


@pytest.mark.parametrize("name", UNEQUAL)
def test_links_without_mass_and_links_too_wide_are_not_believed(name: str) -> None:
    robot = named_robot(name)
    assert "none" in placeholder_reason(with_phi(robot, 1e-6 * robot.phi))
    wide = robot.phi.copy()
    last = int(np.flatnonzero(robot.tree.carrier >= 0)[-1])  # not welded to the world
    wide[last] = phi_of(0.5, np.zeros(3), 50.0 * np.eye(3))
    assert "beyond" in placeholder_reason(with_phi(robot, wide))


@pytest.mark.parametrize("name", UNEQUAL)
def test_scaled_and_partly_copied_numbers_are_believed(name: str) -> None:
    robot = named_robot(name)
    assert placeholder_reason(with_phi(robot, 3.0 * robot.phi)) == ""
    copied = robot.phi.copy()
    copied[-1] = copied[-2]
    assert placeholder_reason(with_phi(robot, copied)) == ""
