"""Torques that cannot be a robot's are reported, and those of a robot pass."""

import pytest

from sysid_bench.commands.identify import identify
from sysid_bench.commands.identify_recorded import friction_warnings
from sysid_bench.commands.values import parse_noise
from sysid_bench.errors import UsageError


def friction(
    viscous: float, coulomb: float, std: float | None = 0.1
) -> dict[str, dict[str, object]]:
    return {
        "viscous": {"value": viscous, "std": std},
        "coulomb": {"value": coulomb, "std": std},
    }


def test_a_sound_answer_raises_no_doubt() -> None:
    joints = {"a": friction(1.0, 2.0), "b": friction(-0.1, -0.1), "c": friction(-5.0, 2.0)}
    assert friction_warnings(joints) == []


@pytest.mark.parametrize("std", [0.1, None])
def test_friction_that_pushes_is_reported(std: float | None) -> None:
    joints = {"elbow": friction(-1.0, -2.0, std), "wrist": friction(1, 1)}
    (said,) = friction_warnings(joints)
    assert "elbow" in said
    assert "wrist" not in said
    assert "wrong sign" in said


@pytest.mark.parametrize("noise", [{"tau": "-1 %"}, {"q": "-1e-4 rad"}, {"tau_correlation": "2"}])
def test_noise_that_cannot_be_is_refused(noise: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="must be 0 or more"):
        identify("scara", noise=noise)


@pytest.mark.parametrize("size", ["1e308 %", "1e-320 %", "1e-40 N m"])
def test_noise_at_the_ends_of_floats_is_refused(size: str) -> None:
    with pytest.raises(UsageError, match="from 1e-30 to 1e\\+30"):
        identify("scara", noise={"tau": size})


def test_noise_is_said_once() -> None:
    with pytest.raises(UsageError, match="twice"):
        parse_noise("tau=1 %,tau=5 %")
