"""tx40 and rv2sq against the tables they were written from (BIRDy; Leboutet et al. 2021): the MJCF
files hold turned numbers, so the tables are turned here by other formulas."""

import mujoco
import numpy as np
import pytest

from sysid_bench.experiments.tasks.task import task_of
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.spatial import feasible_margins
from sysid_bench.types import Array
from tests.robots import named_robot

HALF = np.pi / 2
DH = {  # modified (Craig): alpha, a, d, offset of theta; height of the base
    "tx40": (
        [0, -HALF, 0, HALF, -HALF, HALF],
        [0, 0, 0.225, 0, 0, 0],
        [0, 0, 0.035, 0.225, 0, 0],
        [0, -HALF, HALF, 0, 0, np.pi],
        0.32,
    ),
    "rv2sq": (
        [0, -HALF, 0, HALF, -HALF, HALF],
        [0, 0, 0.23, -0.05, 0, 0],
        [0.295, 0, 0, 0.27, 0, 0.07],
        [0, -HALF, HALF, 0, 0, 0],
        0.0,
    ),
}
MASSES = {"tx40": [8.61, 4.85, 4.07, 3.62, 1.02, 0.2], "rv2sq": [4, 5.3, 4.1, 2.8, 0.8, 0.7]}
TX40_FIRST_MOMENTS = [
    [0, 0, -0.05 * 8.61],
    [0.392, -0.0072, 0.162],
    [0.0326, 0.0244, 0.265],
    [0.0145, -0.00724, -0.586],
    [0, -0.00306, -0.00102],
    [0, 0, 0.0084],
]
TX40_INERTIAS = [  # XX XY XZ YY YZ ZZ about the DH frames' origins
    [0.424, 0, 0, 0.424, 0, 0.352],
    [0.0163, 7.85e-4, -0.0157, 0.0881, 3.24e-4, 0.0828],
    [0.0223, -1.95e-4, -1.16e-3, 0.0224, -2.22e-3, 4.41e-3],
    [0.109, 2.9e-5, 1.35e-3, 0.108, -1.17e-3, 4.07e-3],
    [1.01e-3, 0, 0, 1e-3, -3.06e-6, 1.01e-3],
    [3.53e-3, 0, 0, 3.53e-3, 0, 3.53e-4],
]
SMALLEST = {  # eigenvalues: pseudo-inertias about the frames; density covariances
    "tx40": [0.176, 0.0052, 0.0012, 0.0014, 0.0005, 0.00018],
    "rv2sq": [0.0076, 0.0499, 0.0212, 0.0166, 0.0116, 0.0008],
}


def turned(axis: int, angle: float) -> Array:
    """A homogeneous rotation (4, 4) about x (0) or z (2)."""
    T, (i, j) = np.eye(4), {0: (1, 2), 2: (0, 1)}[axis]
    T[[i, j], [i, j]] = np.cos(angle)
    T[i, j], T[j, i] = -np.sin(angle), np.sin(angle)
    return T


def moved(x: float = 0.0, z: float = 0.0) -> Array:
    T = np.eye(4)
    T[[0, 2], 3] = x, z
    return T


@pytest.mark.parametrize("name", DH)
def test_frames_lie_where_the_dh_table_has_them(name: str) -> None:
    robot, (alpha, a, d, offset, height) = named_robot(name), DH[name]
    data = mujoco.MjData(robot.mj)
    for seed in range(3):
        q = np.random.default_rng(seed).uniform(-2, 2, 6)
        data.qpos[:] = q
        mujoco.mj_kinematics(robot.mj, data)
        T = moved(z=height)
        for i in range(6):
            T = (
                T
                @ turned(0, alpha[i])
                @ moved(x=a[i])
                @ turned(2, q[i] + offset[i])
                @ moved(z=d[i])
            )
            np.testing.assert_allclose(data.xpos[i + 1], T[:3, 3], atol=1e-12)
            np.testing.assert_allclose(data.xmat[i + 1].reshape(3, 3), T[:3, :3], atol=1e-12)


@pytest.mark.parametrize("name", DH)
def test_there_are_52_base_parameters_with_rotors_and_friction(name: str) -> None:
    robot = named_robot(name)
    assert robot.manifest.terms == ("viscous", "coulomb", "armature")
    task = task_of(robot, "robot", robot.manifest.terms)
    base = structural_base(robot, task.parameters, None)
    assert base.rank == 52
    assert base.gap > 1e6
    np.testing.assert_allclose(robot.phi[:, 0], MASSES[name], rtol=1e-12)


def test_the_tx40_has_the_published_inertias() -> None:
    phi = named_robot("tx40").phi
    np.testing.assert_allclose(phi[:, 1:4], TX40_FIRST_MOMENTS, atol=1e-12)
    np.testing.assert_allclose(phi[:, 4:], TX40_INERTIAS, atol=1e-12)
    np.testing.assert_allclose(feasible_margins(phi), SMALLEST["tx40"], rtol=0.05)


def test_the_rv2sq_has_the_published_density_covariances() -> None:
    mj = named_robot("rv2sq").mj
    moments = np.array(mj.body_inertia[1:])
    smallest = 0.5 * moments.sum(axis=1) - moments.max(axis=1)
    np.testing.assert_allclose(smallest, SMALLEST["rv2sq"], rtol=0.05)
