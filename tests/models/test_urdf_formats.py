"""URDF joints and links as files have them: mapped in both engines, or one sentence."""

import re

import numpy as np
import pytest

from sysid_bench.errors import ModelError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import subtree_at
from tests.robots import robot_of

INERTIA = '<inertia ixx=".1" iyy=".2" izz=".25" ixy=".01" ixz="0" iyz="0"/>'
INERTIAL = f'<inertial><origin xyz=".1 0 .1" rpy="1 2 3"/><mass value="1"/>{INERTIA}</inertial>'
LIMIT = '<limit lower="-1" upper="1" effort="5" velocity="1"/>'
LOOKS = """<visual><geometry><mesh filename="package://absent/x.dae"/></geometry></visual>
<collision><geometry><mesh filename="file:///absent.stl"/></geometry></collision>"""


def link(name: str, inside: str = INERTIAL) -> str:
    return f'<link name="{name}">{inside}</link>'


def joint(name: str, ends: str, kind: str | None = "revolute", inside: str = LIMIT) -> str:
    parent, child = ends.split()
    type_ = "" if kind is None else f'type="{kind}"'
    return (
        f'<joint name="{name}" {type_}><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 .1 .2" rpy=".1 0 .3"/><axis xyz="0 1 1"/>{inside}</joint>'
    )


def urdf(*parts: str, name: str = 'name="r"') -> str:
    return f"<robot {name}>{''.join(parts)}</robot>"


def arm(kind: str | None = "revolute", inside: str = LIMIT, tip: str = INERTIAL) -> str:
    ends = joint("j", "base a", kind, inside), joint("k", "a tip", "continuous", "")
    return urdf(link("base"), link("a"), link("tip", tip), *ends)


WHOLE = {
    "revolute": (arm(), ["hinge", "hinge"]),
    "continuous": (arm("continuous", ""), ["hinge", "hinge"]),
    "prismatic": (arm("prismatic"), ["slide", "hinge"]),
    "planar": (arm("planar", ""), ["slide", "slide", "hinge", "hinge"]),
    "fixed": (arm("fixed", ""), ["hinge"]),
    "no limit": (arm("revolute", ""), ["hinge", "hinge"]),
    "no effort": (arm("revolute", '<limit lower="-1" upper="1"/>'), ["hinge", "hinge"]),
    "massless tip": (arm(tip=""), ["hinge", "hinge"]),
    "point mass": (arm(tip='<inertial><mass value="1"/></inertial>'), ["hinge", "hinge"]),
    "impossible": (arm(tip=INERTIAL.replace('ixx=".1"', 'ixx="9"')), ["hinge", "hinge"]),
    "absent meshes": (arm(tip=INERTIAL + LOOKS), ["hinge", "hinge"]),
    "no name": (arm().replace('<robot name="r">', "<robot>"), ["hinge", "hinge"]),
    "world": (
        urdf(link("world", ""), link("b"), link("tip"), joint("f", "world b", "fixed", ""),
             joint("k", "b tip")),
        ["hinge"],
    ),
}  # fmt: skip


def agrees(robot: RobotModel) -> None:
    check = crosscheck(robot, 8)
    assert check.ok(), check.reason()


@pytest.mark.parametrize("free", [False, True], ids=["fixed", "free"])
@pytest.mark.parametrize("name", WHOLE)
def test_what_urdf_has_agrees_in_both_engines(name: str, free: bool) -> None:
    text, kinds = WHOLE[name]
    robot = robot_of(text, free_base=free)
    assert [j.kind for j in robot.joints] == ["free"] * free + kinds
    agrees(robot)
    assert crosscheck(robot, 8).native_gap is not None


@pytest.mark.parametrize("root", ["world", "base_link"])
@pytest.mark.parametrize("free", [False, True], ids=["fixed", "free"])
def test_a_floating_joint_at_the_ground_is_a_free_base(root: str, free: bool) -> None:
    """The ground is the root link without mass, whatever its name."""
    text = urdf(link(root, ""), link("b"), link("tip"), joint("f", f"{root} b", "floating", ""),
                joint("k", "b tip"))  # fmt: skip
    robot = robot_of(text, free_base=free)
    assert [j.kind for j in robot.joints] == ["free", "hinge"]
    assert any("is the ground" in repair for repair in robot.repairs) == (root != "world")
    agrees(robot)
    assert crosscheck(robot, 8).native_gap is not None


TWO_ARMS = urdf(
    link("world", ""), link("a"), link("b"), joint("j", "world a"), joint("k", "world b")
)
FLOATING = {
    "a joint below world": (urdf(link("world", ""), link("a"), joint("j", "world a")), 1),
    "two joints below world": (TWO_ARMS, 2),
    "world weighs": (urdf(link("world"), link("a"), joint("j", "world a", "fixed", ""),
                          link("b"), joint("k", "a b")), 1),
    "no mass at the root": (urdf(link("base", ""), link("a"), joint("j", "base a")), 1),
}  # fmt: skip


@pytest.mark.parametrize("name", FLOATING)
def test_a_free_base_takes_no_joint_away(name: str) -> None:
    text, moving = FLOATING[name]
    fixed, robot = robot_of(text), robot_of(text, free_base=True)
    assert (fixed.nv, robot.nv) == (moving, 6 + moving)
    assert set(fixed.rows) < set(robot.rows)
    assert [reported for reported in robot.repairs if "massless" in reported or "world" in reported]
    agrees(robot)


def test_a_massless_mjcf_root_may_float() -> None:
    inertial = '<inertial pos="0 0 .1" mass="1" diaginertia="1 1 1"/>'
    body = f'<body name="a"><joint/>{inertial}</body>'
    robot = robot_of(
        f'<mujoco><worldbody><body name="r">{body}</body></worldbody></mujoco>', free_base=True
    )
    assert robot.nv == 7
    assert any("massless root body 'r'" in reported for reported in robot.repairs)
    agrees(robot)


NAMES = ("root_joint", "root", "universe", "world", "b0", "j1", "base_link", "free")


@pytest.mark.parametrize("free", [False, True], ids=["fixed", "free"])
@pytest.mark.parametrize("name", NAMES)
def test_no_name_means_anything_to_an_engine(name: str, free: bool) -> None:
    plain, named = arm(), re.sub(r'"(j|a)"', f'"{name}"', arm())
    check = crosscheck(robot_of(named, free_base=free), 8)
    assert check.ok(), check.reason()
    assert check.native_gap is not None
    assert robot_of(named, free_base=free).nv == robot_of(plain, free_base=free).nv


def test_attributes_of_other_programs_are_let_pass() -> None:
    prefixed = LIMIT.replace("<limit", '<limit drake:acceleration="3"')
    text = arm(inside=prefixed).replace("<robot", '<robot xmlns="http://www.ros.org"')
    robot = robot_of(text)
    np.testing.assert_array_equal(robot.phi, robot_of(arm()).phi)
    check = crosscheck(robot, 4)  # the undeclared prefix reaches the text of both engines
    assert check.ok(), check.reason()
    assert check.native_gap is not None
    welded = robot_of(text.replace('name="k" type="continuous"', 'name="k" type="fixed"'))
    assert subtree_at(welded, "k").body == welded.body_names.index("tip")


DOUBTFUL = {
    "centre": (arm(tip=INERTIAL.replace('xyz=".1 0 .1"', 'xyz="100 0 100"')), "tip.* mm?"),
    "offset": (arm().replace('xyz="0 .1 .2"', 'xyz="0 100 200"'), "a, tip.*50 m.* mm?"),
    "inertia": (arm(tip=re.sub(r'i(..)="([^"]+)"', r'i\1="\g<2>e6"', INERTIAL)), "tip.*mm\\^2"),
    "turns": (arm().replace('rpy=".1 0 .3"', 'rpy="90 0 45"'), "j, k.*degrees"),
    "range": (arm(inside='<limit lower="-180" upper="180"/>'), "limits of j .*degrees"),
}


@pytest.mark.parametrize("name", DOUBTFUL)
def test_what_looks_like_another_unit_is_reported_and_kept(name: str) -> None:
    assert robot_of(arm()).repairs == ()
    text, words = DOUBTFUL[name]
    (reported,) = robot_of(text).repairs
    assert re.search(words, reported)


def test_options_of_the_mujoco_extension_are_reported() -> None:
    extension = '<mujoco><compiler meshdir="x" boundmass="5"/><option gravity="0 0 0"/></mujoco>'
    (reported,) = robot_of(arm().replace("<link", f"{extension}<link", 1)).repairs
    assert reported == "left out of the <mujoco> extension: compiler boundmass, option gravity"


def test_an_inertia_without_mass_is_reported() -> None:
    (reported,) = robot_of(arm(tip=INERTIAL.replace('value="1"', 'value="0"'))).repairs
    assert "its inertia left out" in reported


REFUSED = {
    "planar parts": (arm("planar", "").replace('"k"', '"j_TX"'), "'j_TX'; rename"),
    "floating below": (arm("floating", ""), "floating joint 'j'.*'world'.*free base"),
    "unknown kind": (arm("hinge"), r"joint 'j': No kind of joint is called 'hinge'.*revolute"),
    "no kind": (arm(None), "joint 'j' has no type"),
    "limit in words": (arm(inside=LIMIT.replace('"-1"', '"-1rad"')), "'-1rad'"),
    "too deep": (urdf("<a>" * 2000 + "</a>" * 2000, link("a")), "deep"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_one_sentence(name: str) -> None:
    text, words = REFUSED[name]
    with pytest.raises(ModelError) as refusal:
        robot_of(text)
    assert re.search(words, str(refusal.value))
    assert "\n" not in str(refusal.value)


def test_repairs_are_reported_and_change_nothing_else() -> None:
    whole, mended = robot_of(arm()), robot_of(WHOLE["impossible"][0])
    (reported,) = mended.repairs
    assert "'tip'" in reported
    np.testing.assert_array_equal(mended.phi[:2], whole.phi[:2])
    (reported,) = robot_of(arm(inside=LIMIT.replace('"-1"', '"2"'))).repairs
    assert "reversed" in reported
    (reported,) = [t for t in robot_of(arm("prismatic", "")).repairs if "no limits" in t]
    assert "'j'" in reported
