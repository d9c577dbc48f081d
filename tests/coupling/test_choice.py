"""Which joints move and which follow: chosen, wished for, refused; and how far they can go."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.errors import ModelError, UsageError
from sysid_bench.experiments.tasks.task import task_of
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from tests.coupling.mechanisms import KINDS, LOOPS, four_bar, hinge, mechanism, mjcf
from tests.robots import robot_of, states

PAIR = hinge("a", "0 0 0") + hinge("b", "0 0 1")


def test_the_driver_of_a_mimic_moves_and_the_ratio_is_G() -> None:
    robot = robot_of(mjcf(PAIR, '<joint joint1="a" joint2="b" polycoef="0.2 -1.5 0 0 0"/>'))
    assert robot.torque_rows == ("b",)
    assert robot.coupling is not None
    motion = states(robot, 5)
    np.testing.assert_allclose(robot.coupling.G(motion.q)[:, :, 0], [[-1.5, 1.0]] * 5, atol=1e-12)
    np.testing.assert_allclose(motion.q[:, 0], 0.2 - 1.5 * motion.q[:, 1], atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_the_motor_moves_and_no_joint_is_lost(kind: str) -> None:
    for seed in range(4):
        robot = mechanism(kind, seed)
        assert robot.coupling is not None
        assert set(robot.coupling.independent) | set(robot.coupling.dependent) == set(
            range(robot.nv)
        )
        motor = {"geared-pair": "drive", "mimic-gripper": "left", "tendon": "first"}
        assert motor.get(kind, "crank") in robot.torque_rows


@pytest.mark.parametrize("kind", LOOPS)
def test_a_planar_loop_has_redundant_rows_and_one_joint_that_moves(kind: str) -> None:
    robot = mechanism(kind)
    assert robot.coupling is not None
    (group,) = robot.coupling.groups
    _, J = group.constraints[0].residual_jacobian(np.zeros((1, len(group.dofs))))
    assert J.shape[1] > len(group.dependent)
    assert len(group.independent) == 1


def test_the_manifest_chooses_and_names_what_there_is(tmp_path: Path) -> None:
    manifest = find_manifest("random:four-bar:0")
    robot = load_robot(replace(manifest, independent=("rocker",)))
    assert robot.torque_rows[-1] == "rocker"
    with pytest.raises(UsageError, match=r"'rockr'.*Did you mean 'rocker'"):
        load_robot(replace(manifest, independent=("rockr",)))
    with pytest.raises(ModelError, match=r"crank, rocker cannot all be independent.*only 1 can"):
        load_robot(replace(manifest, independent=("crank", "rocker")))
    alone = load_robot(replace(manifest, couplings=False))
    assert alone.coupling is None
    assert alone.torque_rows == alone.rows == robot.rows


def test_a_robot_toml_says_so(tmp_path: Path) -> None:
    (tmp_path / "bar.xml").write_text(four_bar(), encoding="utf-8")
    text = 'name = "bar"\nfile = "bar.xml"\n'
    rows = {}
    for label, more in (
        ("chosen", ""),
        ("wished", '[coupling]\nindependent = ["rocker"]\n'),
        ("off", "couplings = false\n"),
    ):
        (tmp_path / "robot.toml").write_text(text + more, encoding="utf-8")
        rows[label] = load_robot(tmp_path / "robot.toml").torque_rows
    crank = rows["chosen"]
    assert rows == {"chosen": crank, "wished": ("rocker",), "off": ("crank", "coupler", "rocker")}
    assert crank == ("crank",)
    (tmp_path / "robot.toml").write_text(text + "[coupling]\ndriver = 1\n", encoding="utf-8")
    with pytest.raises(ModelError, match="independent"):
        load_robot(tmp_path / "robot.toml")


def test_a_flat_four_bar_is_refused_with_its_configuration() -> None:
    flat = four_bar(height=0.0, pin=0.2)
    with pytest.raises(
        ModelError, match=r"crank, coupler, rocker is singular.*singular value.*crank"
    ):
        robot_of(flat)
    assert load_robot(_manifest_of(flat, couplings=False)).coupling is None


def test_a_stretched_four_bar_that_cannot_move_is_refused() -> None:
    with pytest.raises(ModelError, match=r"crank, coupler, rocker (leaves|is singular).*singular"):
        robot_of(four_bar(height=0.0, pin=0.4))


def test_a_motion_into_a_singular_posture_is_refused_with_its_configuration() -> None:
    robot = mechanism("parallelogram")
    assert robot.coupling is not None
    motion = states(robot, 3)
    motion.q[1, robot.joints[robot.rows.index("crank")].qadr] += 3.0
    with pytest.raises(ModelError, match=r"cannot be closed, or is singular, at crank = .*value"):
        robot.coupling.completed(motion.q, motion.v, motion.a)


@pytest.mark.parametrize("kind", LOOPS)
def test_every_posture_within_reach_closes_and_stays_regular(kind: str) -> None:
    for seed in range(3):
        robot = mechanism(kind, seed)
        assert robot.coupling is not None
        motion = states(robot, 100, seed)
        (group,) = robot.coupling.groups
        x = motion.q[:, robot.coupling.qadr[group.dofs]] - robot.coupling.q0[group.dofs]
        least = group.condition(group.reference[None])[0]
        assert (group.condition(x) > 0.1 * least).all()


def test_joints_that_follow_keep_their_limits() -> None:
    robot = robot_of(four_bar(joint='range="-0.2 0.3"'))
    motion = states(robot, 200)
    angle = motion.q[:, robot.rows.index("rocker")]
    assert -0.2 <= angle.min() < -0.1
    assert 0.2 < angle.max() <= 0.3


def test_limits_against_the_coupling_bind_nothing_and_are_reported() -> None:
    bodies = hinge("a", "0 0 0", more='range="0 0.5"') + hinge("b", "0 0 1", more='range="0 0.5"')
    robot = robot_of(mjcf(bodies, '<joint joint1="a" joint2="b" polycoef="0 -1 0 0 0"/>'))
    assert robot.coupling is not None
    assert (robot.coupling.low[0], robot.coupling.high[0]) == (0.0, 0.5)
    assert "limits of a ignored" in " ".join(robot.repairs)


def test_a_motion_closes_alike_at_once_and_sample_by_sample() -> None:
    """Neighbours are the starts of a motion, the reference that of single states: one branch."""
    robot = mechanism("slider-crank")
    assert robot.coupling is not None
    (group,) = robot.coupling.groups
    turns = np.linspace(-3.0, 3.0, 2000)[:, None]
    together, good = group.motion_closure(turns)
    assert good.all()
    apart, _ = group.motion_closure(turns[::97][np.random.default_rng(0).permutation(21)])
    order = np.argsort(apart[:, group.independent[0]])
    np.testing.assert_allclose(apart[order], together[::97], atol=1e-9)


def test_spatial_tendons_are_refused_with_advice() -> None:
    sites = PAIR.replace("<inertial", '<site name="s"/><inertial', 1)
    sites = sites[::-1].replace("<inertial"[::-1], '<site name="t"/><inertial'[::-1], 1)[::-1]
    spatial = '<tendon><spatial name="rope"><site site="s"/><site site="t"/></spatial></tendon>'
    with pytest.raises(ModelError, match=r"tendon 'rope'.*fixed tendon.*couplings = false"):
        robot_of(mjcf(sites, '<tendon tendon1="rope"/>', spatial))


def test_what_couples_nothing_is_left_out() -> None:
    mocap = '<body name="hand" mocap="true"/>'
    held = (
        '<weld body1="hand" body2="a"/><connect active="false" body1="a" body2="b" anchor="0 0 0"/>'
    )
    robot = robot_of(mjcf(mocap + PAIR, held))
    assert robot.coupling is None
    (reported,) = (text for text in robot.repairs if "left out" in text)
    assert "mocap" in reported
    with pytest.raises(ModelError, match=r"fix all joints.*couplings = false"):
        robot_of(mjcf(PAIR, '<joint joint1="a"/><joint joint1="b"/>'))


def test_a_joint_held_by_an_equality_rests_where_it_is_held() -> None:
    robot = robot_of(mjcf(PAIR, '<joint joint1="a" polycoef="0.3 0 0 0 0"/>'))
    assert robot.torque_rows == ("b",)
    motion = states(robot, 5)
    np.testing.assert_allclose(motion.q[:, 0], 0.3, atol=1e-12)
    assert not motion.v[:, 0].any()


def test_the_terminal_torque_of_a_joint_that_follows_is_its_drivers() -> None:
    chain = hinge("a", "0 0 0", hinge("b", "0 0 0.3"))
    robot = robot_of(mjcf(chain, '<joint joint1="b" joint2="a" polycoef="0 2 0 0 0"/>'))
    task = task_of(robot, "terminal", ("viscous",))
    assert task.rows == ("a",)
    assert task.parameters[-1] == "a.fv"
    assert task.bodies[0].name == "b"


def _manifest_of(text: str, couplings: bool) -> Manifest:
    return Manifest("bar", Path("bar"), text=text, couplings=couplings)


MIMIC = """<robot name="r"><link name="base"/>{links}{joints}</robot>"""
LINK = (
    '<link name="{0}"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>'
    '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="{3}"><parent link="{1}"/><child link="{2}"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/>{4}</joint>'
)


def urdf(*mimics: str, kind: str = "revolute") -> str:
    """A chain of three joints j0, j1, j2, of which the last two carry these mimics."""
    words = ["", *mimics]
    links = "".join(LINK.format(f"l{k}") for k in range(3))
    joints = "".join(
        JOINT.format(
            f"j{k}", f"l{k - 1}" if k else "base", f"l{k}", kind if k == 2 else "revolute", w
        )
        for k, w in enumerate(words)
    )
    return MIMIC.format(links=links, joints=joints)


def test_mimics_of_mimics_follow_the_first() -> None:
    text = urdf(
        '<mimic joint="j0" multiplier="0.5"/>', '<mimic joint="j1" multiplier="-2" offset="0.1"/>'
    )
    robot = robot_of(text)
    assert robot.torque_rows == ("j0",)
    motion = states(robot, 5)
    np.testing.assert_allclose(motion.q[:, 1], 0.5 * motion.q[:, 0], atol=1e-12)
    np.testing.assert_allclose(motion.q[:, 2], 0.1 - motion.q[:, 0], atol=1e-12)


@pytest.mark.parametrize("target", ["nobody", "j2"])
def test_a_mimic_of_nothing_moves_on_its_own_and_is_reported(target: str) -> None:
    robot = robot_of(urdf("", f'<mimic joint="{target}"/>'))
    assert robot.coupling is None
    (reported,) = (text for text in robot.repairs if "mimic" in text)
    assert "'j2' treated as independent" in reported
    assert f"{target!r}" in reported


def test_a_mimic_with_a_broken_number_is_refused() -> None:
    with pytest.raises(ModelError, match=r"mimic of joint 'j1'.*multiplier is 'nan'"):
        robot_of(urdf('<mimic joint="j0" multiplier="nan"/>', ""))
