"""Mechanisms of public humanoids at random sizes: legs with rods between ball joints, one at the
heel and two at the toe (as Digit's), and a body of gears, differentials and redundant rods (as
Toddlerbot's)."""

import numpy as np
import pytest

from sysid_bench.evaluation.crosscheck import crosscheck
from tests.coupling.mechanisms import INERTIAL, hinge, mjcf
from tests.coupling.test_redundant import neck
from tests.robots import robot_of

ROUNDED = 2.7e-8
"""m: error of sites with eight decimals."""


def _body(name: str, joint: str, place: np.ndarray, inside: str) -> str:
    where = " ".join(repr(float(x)) for x in place)
    return f'<body name="{name}" pos="{where}">{joint}{INERTIAL}{inside}</body>'


def leg(side: str, rng: np.random.Generator) -> tuple[str, str]:
    """Bodies and equalities of a leg: hip of three hinges, knee, sprung heel, two motors with rods
    that turn the toe about two axes. The rods have a ball at one end and a point at the other."""

    def size(*nominal: float) -> np.ndarray:
        return np.array(nominal) * rng.uniform(0.9, 1.1, 3) + 0.002 * rng.normal(size=3)

    def turning(name: str, axis: str, place: np.ndarray, inside: str) -> str:
        joint = f'<joint name="{side}{name}" axis="{axis}"/>'
        return _body(side + name, joint, place, inside)

    def rod(name: str, place: np.ndarray) -> str:
        return _body(side + name, f'<joint name="{side}{name}" type="ball"/>', place, "")

    roll = turning("toe-roll", "1 0 0", size(0.01, 0, 0), "")
    pitch = turning("toe-pitch", "0 1 0", size(0.02, 0, -0.4), roll)
    motors = "".join(
        turning(f"toe-{k}", "0 1 0", size(0.02, y, z), rod(f"toe-{k}-rod", size(-0.06, y, 0.01)))
        for k, y, z in (("a", 0.04, -0.15), ("b", -0.04, -0.2))
    )
    heel = turning("heel-spring", "0 1 0", size(-0.01, 0.01, -0.02), "")
    tarsus = turning("tarsus", "0 1 0", size(0.03, 0, -0.25), heel + motors + pitch)
    shin = turning("shin", "0 1 0", size(0.06, 0, -0.05), tarsus)
    knee = turning("knee", "0 1 0", size(0.02, 0, -0.2), shin)
    thigh = turning(
        "hip-pitch", "0 1 0", size(0, 0, -0.05), rod("achilles-rod", size(0, 0.03, -0.02)) + knee
    )
    yaw = turning("hip-yaw", "0 0 1", size(0.02, 0, -0.03), thigh)
    hip = turning("hip-roll", "1 0 0", size(0, 0.1 if side == "l" else -0.1, -0.05), yaw)
    ends = (("achilles-rod", "heel-spring"), ("toe-a-rod", "toe-roll"), ("toe-b-rod", "toe-roll"))
    loops = "".join(
        f'<connect body1="{side}{rod_}" body2="{side}{end}" '
        f'anchor="{" ".join(map(str, size(0.02, 0.01, -0.3)))}"/>'
        for rod_, end in ends
    )
    return hip, loops


def biped(seed: int) -> str:
    """Two such legs below a floating pelvis."""
    rng = np.random.default_rng(seed)
    (left, loops), (right, more) = leg("l", rng), leg("r", rng)
    return mjcf(_body("pelvis", "<freejoint/>", np.array([0, 0, 1.0]), left + right), loops + more)


def geared(seed: int, error: float) -> str:
    """A neck of redundant rods with sites rounded by `error` (m), a waist that two motors turn by
    their sum and difference, and a leg with a geared hip."""
    rng = np.random.default_rng(seed)
    ratio, gear = rng.uniform(0.4, 0.6, 2)
    text = neck(seed, error)
    driven = "".join(
        hinge(name, f"{x} .1 0", axis=axis)
        for name, x, axis in (
            ("motor_1", 0.1, "0 0 1"),
            ("motor_2", -0.1, "0 0 1"),
            ("hip_drive", 0.2, "1 0 0"),
            ("hip", 0.25, "1 0 0"),
        )
    )
    waist = (
        f'<body name="waist_roll"><joint name="waist_roll" axis="1 0 0"/>{INERTIAL}'
        f'<body name="waist_yaw"><joint name="waist_yaw" axis="0 0 1"/>{INERTIAL}'
    )
    text = text.replace("<worldbody>", f"<worldbody>{driven}{waist}").replace(
        "</worldbody>", "</body></body></worldbody>"
    )
    tendons = "".join(
        f'<fixed name="{name}"><joint joint="{name}" coef="1"/>'
        f'<joint joint="motor_1" coef="{-ratio}"/>'
        f'<joint joint="motor_2" coef="{sign * ratio}"/></fixed>'
        for name, sign in (("waist_roll", 1), ("waist_yaw", -1))
    )
    loops = (
        '<tendon tendon1="waist_roll"/><tendon tendon1="waist_yaw"/>'
        f'<joint joint1="hip" joint2="hip_drive" polycoef="0 {-gear} 0 0 0"/>'
    )
    motors = "".join(f'<motor joint="{name}"/>' for name in ("motor_1", "motor_2", "hip_drive"))
    text = text.replace("</equality>", f"{loops}</equality><tendon>{tendons}</tendon>")
    return text.replace("</actuator>", f"{motors}</actuator>")


def _assert_agreement(text: str, rounded: bool = False) -> None:
    """Tree gap <= 1e-12, reduced regressors <= 1e-9, constrained dynamics of MuJoCo <= 1e-8; behind
    rounded sites as far as the loops close, which the note states."""
    check = crosscheck(robot_of(text), 4)
    assert check.ok(), check.reason()
    assert check.gap <= 1e-12
    assert check.coupling is not None
    assert ("contradict each other" in check.coupling.note) == rounded
    if not rounded:
        assert check.coupling.gap <= 1e-9
        assert check.coupling.closure <= 1e-8


def test_engines_agree_on_a_leg_with_rods_at_heel_and_toe() -> None:
    bodies, loops = leg("l", np.random.default_rng(0))
    _assert_agreement(mjcf(_body("pelvis", "", np.array([0, 0, 1.0]), bodies), loops))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_engines_agree_on_many_such_legs(seed: int) -> None:
    _assert_agreement(biped(seed))


@pytest.mark.parametrize("error", [0.0, ROUNDED])
def test_engines_agree_on_gears_differentials_and_redundant_rods(error: float) -> None:
    _assert_agreement(geared(0, error), rounded=error > 0)


@pytest.mark.long
@pytest.mark.parametrize("error", [0.0, ROUNDED])
@pytest.mark.parametrize("seed", range(1, 6))
def test_engines_agree_on_many_such_gears(seed: int, error: float) -> None:
    _assert_agreement(geared(seed, error), rounded=error > 0)
