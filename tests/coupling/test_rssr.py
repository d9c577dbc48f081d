"""A spatial four-bar RSSR: hinge, two spherical joints, hinge; the loop is closed by `connect`."""

from pathlib import Path

import numpy as np
import pytest

from sysid_bench import crosscheck, identify


def rssr(seed: int, tilt: float = 0.0) -> str:
    """MJCF of a loop with random lengths, axes and bodies, whose crank leans by `tilt` degrees."""
    random = np.random.default_rng(seed)
    a, pivot = random.uniform(0.1, 0.25), random.uniform([0.5, -0.3, -0.1], [1.0, 0.3, 0.1])
    axis, across = random.normal(size=(2, 3))
    arm = np.cross(axis, across)
    arm *= random.uniform(0.35, 0.5) / np.linalg.norm(arm)
    length = pivot + arm - [a, 0, 0]

    def words(numbers: np.ndarray) -> str:
        return " ".join(f"{x:.6f}" for x in numbers)

    def inertial(end: np.ndarray) -> str:
        covariance = np.cov(random.normal(size=(3, 5))) * 0.004
        tensor = np.trace(covariance) * np.eye(3) - covariance
        six = words(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
        com, mass = words(0.5 * end + 0.02 * random.normal(size=3)), random.uniform(0.5, 2.0)
        return f'<inertial pos="{com}" mass="{mass:.4f}" fullinertia="{six}"/>'

    return f"""<mujoco model="rssr"><worldbody>
    <body euler="{90 + tilt} 0 0"><body name="base" euler="-90 0 0"><geom size=".05" mass="1"/>
    <body name="crank"><joint name="crank" axis="0 0 1"/>{inertial(np.array([a, 0, 0]))}
    <body name="coupler" pos="{a:.6f} 0 0"><joint name="ball" type="ball"/>{inertial(length)}
    <site name="end" pos="{words(length)}"/></body></body>
    <body name="rocker" pos="{words(pivot)}"><joint name="rocker" axis="{words(axis)}"/>
    {inertial(arm)}<site name="tip" pos="{words(arm)}"/></body></body></body></worldbody>
    <equality><connect site1="end" site2="tip"/></equality></mujoco>"""


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("tilt", [0.0, -0.0002])
def test_exact_data_are_answered_to_rounding_or_the_reason_is_said(
    seed: int, tilt: float, tmp_path: Path
) -> None:
    """A crank that leans by the rounding of an angle (1.5708) has directions of almost no torque,
    which the rank rule drops: the torque error is theirs."""
    file = tmp_path / "rssr.xml"
    file.write_text(rssr(seed, tilt))
    (check,) = crosscheck(file)
    assert check.ok, check.reason
    assert check.coupling is not None
    result = identify(file)
    rank, dropped = (check.coupling[f"coupled_{k}"] for k in ("base_parameters", "near_degenerate"))
    assert (result.rank, result.near_degenerate) == (rank, dropped)
    assert (dropped > 0) == (tilt != 0)
    said = [text for text in result.warnings if "rank rule drops" in text]
    assert len(said) == (2 if dropped else 0)
    assert result.torque_error <= (1e-4 if dropped else 1e-9)
    assert (f"{dropped} near-degenerate direction" in check.summary()) == (dropped > 0)
