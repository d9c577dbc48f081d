"""Torques that cannot be a robot's are reported, and those of a robot pass."""

import pytest

from sysid_bench.cli.values import parse_noise
from sysid_bench.errors import UsageError
from sysid_bench.verbs.identify import identify
from sysid_bench.verbs.log_warnings import log_warnings

SOUND = {"rms": 3.0, "relative": 0.1}


def friction(
    viscous: float, coulomb: float, std: float | None = 0.1
) -> dict[str, dict[str, object]]:
    return {
        "viscous": {"value": viscous, "std": std},
        "coulomb": {"value": coulomb, "std": std},
    }


def test_a_sound_answer_raises_no_doubt() -> None:
    joints = {"a": friction(1.0, 2.0), "b": friction(-0.1, -0.1), "c": friction(-5.0, 2.0)}
    assert list(log_warnings({"a": SOUND, "b": SOUND, "c": SOUND}, joints)) == []


@pytest.mark.parametrize(
    ("result", "joint", "word"),
    [
        ({"rms": 0.0, "relative": None}, friction(1.0, 1.0), "zero throughout"),
        ({"rms": 1.0, "relative": 1.2}, friction(1.0, 1.0), "120 %"),
        (SOUND, friction(-1.0, -2.0), "wrong sign"),
        (SOUND, friction(-1.0, -2.0, None), "wrong sign"),
    ],
)
def test_what_cannot_be_is_reported(result: dict, joint: dict, word: str) -> None:  # type: ignore[type-arg]
    (said,) = log_warnings(
        {"elbow": result, "wrist": SOUND}, {"elbow": joint, "wrist": friction(1, 1)}
    )
    assert "elbow" in said
    assert "wrist" not in said
    assert word in said


@pytest.mark.parametrize("noise", [{"tau": "-1 %"}, {"q": "-1e-4 rad"}, {"tau_correlation": "2"}])
def test_noise_that_cannot_be_is_refused(noise: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="must be 0 or more"):
        identify("scara", noise=noise)


def test_noise_is_said_once() -> None:
    with pytest.raises(UsageError, match="twice"):
        parse_noise("tau=1 %,tau=5 %")
