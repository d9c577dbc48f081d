"""The mass of a payload by several joints: how far they disagree, whatever their deviations."""

import numpy as np
import pytest

from sysid_bench.experiments.recorded.payload import _disagreement, _row_mass
from sysid_bench.types import Factor


def variance(masses: list[float], std: list[float]) -> float:
    names = [f"j{k}" for k in range(len(masses))]
    return _disagreement(dict(zip(names, zip(masses, std, strict=True), strict=True)))


@pytest.mark.parametrize("seed", range(5))
def test_the_unit_of_mass_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    masses, std = rng.uniform(0.5, 2.0, 6), 10.0 ** rng.uniform(-4, -1, 6)
    found = variance([*masses], [*std])
    assert found > 0
    for unit in (1e-6, 1e3):
        assert variance([*(unit * masses)], [*(unit * std)]) == pytest.approx(unit**2 * found)


@pytest.mark.parametrize("smallest", [1e-4, 1e-9, 1e-12, 1e-60, 1e-200])
def test_one_joint_with_far_the_smallest_deviation_hides_no_disagreement(smallest: float) -> None:
    """As of a joint along whose axis the stated centre of mass lies: its torque has no noise."""
    found = variance([0.0, 0.9, 0.97], [smallest, 4e-3, 4e-3])
    assert found == pytest.approx(variance([0.0, 0.9, 0.97], [1e-6, 4e-3, 4e-3]), rel=2e-2)


def test_joints_that_agree_have_no_disagreement() -> None:
    assert variance([1.0, 1.001, 0.999], [0.01, 0.01, 0.01]) == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_a_column_of_rounding_errors_takes_no_part_in_the_mass_of_a_joint(seed: int) -> None:
    """As of an axis along which a body's inertia has no torque: zero but for the last bits."""
    rng = np.random.default_rng(seed)
    W, noise = rng.standard_normal((20, 4)), rng.standard_normal((20, 1))
    b = W @ [1.0, 0.5, -2.0, 0.3] + 0.1 * noise[:, 0]

    def mass(*columns: np.ndarray) -> float:
        R = np.column_stack([*columns, b])
        return _row_mass(Factor("j1", np.arange(len(columns)), R, 20), 0)

    alone = mass(W)
    assert alone != pytest.approx(1.0, rel=1e-4)
    assert mass(W, 1e-14 * noise) == pytest.approx(alone)
    assert mass(W, 1e-6 * noise) == pytest.approx(1.0)  # a small column that does act
