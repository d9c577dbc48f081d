"""MJCF files that MuJoCo refuses for what does not matter are mended, in words, or refused in one
sentence; what is mended is the model that a clean file describes."""

from pathlib import Path

import numpy as np
import pytest

from sysid_bench.errors import ModelError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.models.load import load_robot
from sysid_bench.models.mjcf import element_tree
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.urdf_links import TINY_MASS, TINY_MOMENT
from tests.closeness import assert_close
from tests.robots import robot_of

LINK = '<geom type="capsule" size=".05" fromto="0 0 0 .3 0 .1"/>'
ARM = (
    '<mujoco model="m">{head}<asset><material name="grey"/>{asset}</asset><worldbody>'
    f'<body><joint axis="0 1 0"/>{LINK}<body pos=".3 0 0"><joint axis="0 0 1"/>{LINK}</body></body>'
    "</worldbody></mujoco>"
)


def arm(head: str = "", asset: str = "") -> str:
    return ARM.format(head=head, asset=asset)


MENDED = {
    "dropped option": (arm('<option apirate="50" gravity="0 0 -3"/>'), "'apirate' of <option>"),
    "two dropped options": (arm('<option apirate="50" collision="all" gravity="0 0 -3"/>'),
                            "'collision' of <option>"),
    "group of a default": (arm('<option gravity="0 0 -3"/><default><default class="a" group="1"/>'
                               "</default>"), "'group' of <default>"),
    "repeated material": (arm('<option gravity="0 0 -3"/>', '<material name="grey"/>'),
                          "repeated material 'grey'"),
    "repeated shape": (arm('<option gravity="0 0 -3"/>').replace("<geom ", '<geom name="g" '),
                       "repeated name of geom 'g'"),
    "repeated sites and lights": (
        arm('<option gravity="0 0 -3"/>').replace(
            "<joint ", '<site name="s"/><light name="s"/><joint '),
        "repeated name of light 's'"),
}  # fmt: skip


@pytest.mark.parametrize("name", MENDED)
def test_a_mended_file_is_the_model_of_a_clean_one(name: str) -> None:
    text, words = MENDED[name]
    robot, clean = robot_of(text), robot_of(arm('<option gravity="0 0 -3"/>'))
    assert any(words in repair for repair in robot.repairs)
    assert clean.repairs == ()
    np.testing.assert_array_equal(robot.phi, clean.phi)
    np.testing.assert_array_equal(robot.tree.gravity, clean.tree.gravity)
    check = crosscheck(robot, 4)
    assert check.ok(), check.reason()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (arm().replace("<joint ", '<joint stiff="3" ', 1), "unrecognized attribute: 'stiff'"),
        (arm('<compiler coordinate="global"/>'), "global coordinates"),
        (arm('<option apirate="1"/><composite/>'), "composite"),
        (arm("", '<model name="a" file="b.xml"/>') + "", "b.xml"),
    ],
)  # fmt: skip
def test_what_may_matter_is_refused(text: str, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        robot_of(text)


def test_included_files_are_mended_with_the_model(tmp_path: Path) -> None:
    """Files are looked for beside the model and beside the file that includes them."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "option.xml").write_text(
        '<mujocoinclude><option apirate="9"/><include file="gravity.xml"/></mujocoinclude>'
    )
    (tmp_path / "parts" / "gravity.xml").write_text(
        '<mujocoinclude><option gravity="0 0 -3"/></mujocoinclude>'
    )
    model = tmp_path / "model.xml"
    model.write_text(arm('<include file="parts/option.xml"/>'))
    root = element_tree(model, model.read_bytes())
    assert not list(root.iter("include"))
    robot = load_robot(model)
    assert "unknown attribute 'apirate' of <option> left out" in robot.repairs
    np.testing.assert_array_equal(robot.tree.gravity, [0, 0, -3])


def massless(inertial: str, count: int, kind: str = "") -> RobotModel:
    """A chain whose first `count` bodies have an inertial, or none, and the last a capsule."""
    inner = f'<body pos=".2 0 0"><joint {kind}/>{LINK}</body>'
    for k in range(count):
        inner = f'<body name="b{k}" pos=".1 0 0"><joint axis="0 1 0"/>{inertial}{inner}</body>'
    return robot_of(f"<mujoco><worldbody>{inner}</worldbody></mujoco>")


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("kind", ['axis="0 0 1"', 'type="ball"'])
def test_massless_bodies_that_move_have_the_mass_that_a_urdf_gives_them(
    count: int, kind: str
) -> None:
    robot = massless("", count, kind)
    assert [r for r in robot.repairs if "massless" in r] == [
        f"massless moving body 'b{k}' given 1e-06 kg" for k in reversed(range(count))
    ]
    expected = [TINY_MASS, 0, 0, 0, TINY_MOMENT, 0, 0, TINY_MOMENT, 0, TINY_MOMENT]
    found = np.sort(robot.phi[:count], axis=1)
    np.testing.assert_allclose(found, np.sort([expected] * count, axis=1), atol=1e-20)
    check = crosscheck(robot, 4)
    assert check.ok(), check.reason()


def test_a_point_mass_keeps_its_mass_and_place() -> None:
    robot = massless('<inertial pos=".1 0 .2" mass="3" diaginertia="0 0 0"/>', 2)
    np.testing.assert_allclose(robot.phi[:2, 0], 3.0)
    assert_close(robot.phi[:2, 1:4], [[0.3, 0, 0.6]] * 2)
    assert sum("point mass" in repair for repair in robot.repairs) == 2


@pytest.mark.parametrize("count", [1, 3])
def test_an_inertial_without_a_position_lies_in_the_frame_of_its_body(count: int) -> None:
    numbers = 'mass="3" diaginertia="1 2 2.5"'
    robot, clean = (massless(f"<inertial {pos} {numbers}/>", count) for pos in ("", 'pos="0 0 0"'))
    np.testing.assert_array_equal(robot.phi, clean.phi)
    assert sum("without position" in repair for repair in robot.repairs) == count
    assert clean.repairs == ()


@pytest.mark.parametrize(
    "numbers",
    ['mass="-2" diaginertia="1 1 1"', 'mass="0" diaginertia="-1 1 1"', 'mass="nan"',
     'mass="1" diaginertia="-1 1 1"', 'mass="1" diaginertia="0 0 -1"'],
)  # fmt: skip
def test_numbers_that_no_body_can_have_are_not_mended(numbers: str) -> None:
    with pytest.raises(ModelError):
        massless(f'<inertial pos="0 0 0" {numbers}/>', 1)


@pytest.mark.parametrize("weight", ['mass="-1"', 'density="-500"'])
def test_shapes_of_negative_mass_are_not_mended(weight: str) -> None:
    with pytest.raises(ModelError):
        robot_of(arm().replace('type="capsule"', f'type="capsule" {weight}', 1))


def test_a_model_without_any_mass_that_moves_is_no_model_of_dynamics() -> None:
    text = arm().replace(LINK, "").replace("<worldbody>", f"<worldbody><body>{LINK}</body>")
    with pytest.raises(ModelError, match="not a model of dynamics"):
        robot_of(text)


def test_a_text_ends_at_its_first_nul() -> None:
    np.testing.assert_array_equal(robot_of(arm() + "\n\0<").phi, robot_of(arm()).phi)
