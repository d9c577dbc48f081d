"""Numbers of base parameters: known figures of robots, and formulas for families of trees."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from sysid_bench import crosscheck, package_folders
from sysid_bench.identifiability.base_map import structural_base, structural_count
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import BaseMap
from tests.coupling.mechanisms import chain, mjcf
from tests.robots import SCARA, named_robot, revolute_tree, robot_of

MJCFS = 23
RANKS = {
    "ur5": 36,
    "ur10": 36,
    "panda": 51,
    "xarm7": 43,
    "kinova": 36,
    "z1": 43,
    "baxter": 103,
    "solo12": 94,
    "icub": 212,
    "scara": 8,
}
"""Standard inertial parameters of the whole tree; solo12 floats, the others stand."""

FILES = {
    "talos_left_arm.urdf": 45,  # the first axis is horizontal: 7n - 4
    "double_pendulum_continuous.urdf": 6,  # planar
    "solo12.urdf": 68,  # held at its base
    "tiago_no_hand.urdf": 58,
    "allegro_left_hand.urdf": 94,
}


def inertial_base(robot: RobotModel) -> BaseMap:
    return structural_base(robot, robot.inertial_columns)


@pytest.mark.parametrize("name", RANKS)
def test_named_robots_have_their_ranks(name: str) -> None:
    base = inertial_base(named_robot(name))
    assert base.rank == RANKS[name]
    assert base.gap > 1e6
    assert base.near_degenerate == 0


@pytest.mark.parametrize("name", ["ur5", "so100", "scara", "solo12"])
def test_counts_are_those_of_the_base(name: str) -> None:
    base = inertial_base(named_robot(name))
    found = structural_count(named_robot(name))
    assert (found.rank, found.near_degenerate) == (base.rank, base.near_degenerate)
    gap = found.gap or 0.0
    assert gap > 1e10 or gap == pytest.approx(base.gap, rel=1e-3)
    # What is dropped is said, but for rounding.
    assert bool(found.dropped_text) == (base.near_degenerate > 0)


@pytest.mark.long
def test_a_chain_of_200_joints_is_counted() -> None:
    """Spatial hinges from a fixed base: 7 parameters each, without those of gravity at the root."""
    rng = np.random.default_rng(0)
    text = mjcf(chain("a", 200, "0 0 0", rng), "")
    rank, near_degenerate, _ = structural_count(robot_of(text))
    assert 7 * 200 - 6 <= rank + near_degenerate <= 7 * 200


@pytest.mark.parametrize("file", FILES)
def test_other_files_have_their_ranks(file: str) -> None:
    (path,) = package_folders.robot_data_folder().rglob(file)
    assert inertial_base(load_robot(path)).rank == FILES[file]


def test_a_payload_adds_no_base_parameter() -> None:
    """It is welded: its ten columns are combinations of its carrier's."""
    assert inertial_base(named_robot("ur5", "box-2kg")).rank == RANKS["ur5"]


@pytest.mark.parametrize("file", ["so100.urdf", "so101.urdf"])
def test_axes_tilted_by_rounding_are_reported_as_near_degenerate(file: str) -> None:
    """Two axes are parallel but for truncated decimals; unit columns would hide that."""
    (path,) = package_folders.robot_data_folder().rglob(file)
    base = inertial_base(load_robot(path))
    assert base.rank == 36
    assert base.near_degenerate == 2


@pytest.mark.parametrize("joints", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_floating_tree_of_hinges_has_ten_and_seven_a_hinge(joints: int, seed: int) -> None:
    assert inertial_base(revolute_tree(seed, joints)).rank == 10 + 7 * joints


def test_a_scara_has_eight() -> None:
    base = inertial_base(robot_of(SCARA))
    assert base.rank == 8
    assert base.gap > 1e10


def test_a_slide_identifies_one_parameter_and_a_vertical_hinge_one() -> None:
    for joint, rank in (('type="slide" axis="0 0 1"', 1), ('axis="0 0 1"', 1), ('axis="1 0 0"', 3)):
        robot = robot_of(
            f"""<mujoco><worldbody><body><joint {joint}/>
            <inertial pos=".1 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
        )
        assert inertial_base(robot).rank == rank


def test_a_ball_identifies_all_but_the_mass_and_a_free_body_all() -> None:
    for joint, rank in (('<joint type="ball"/>', 9), ("<freejoint/>", 10)):
        robot = robot_of(
            f"""<mujoco><worldbody><body>{joint}
            <inertial pos=".1 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
        )
        assert inertial_base(robot).rank == rank


@pytest.mark.data
def test_ranks_of_the_mjcf_collection(data_folder: Path) -> None:
    folder = data_folder / "robots"
    facts = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
    assert len(facts) == MJCFS
    expected = {file: fact["base_rank_tol1e9"] for file, fact in facts.items()}
    assert {
        file: inertial_base(load_robot(folder / file).without_coupling).rank for file in facts
    } == expected


@pytest.mark.parametrize("coupled", [False, True])
def test_crosscheck_says_what_is_dropped_with_its_gap(tmp_path: Path, coupled: bool) -> None:
    (path,) = package_folders.robot_data_folder().rglob("so101.urdf")
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", path.read_text(), flags=re.DOTALL)
    if coupled:
        end = text.index("</joint>", text.index('<joint name="gripper"'))
        text = f'{text[:end]}<mimic joint="shoulder_pan" multiplier="0.5"/>{text[end:]}'
    (tmp_path / "arm.urdf").write_text(text)
    (found,) = crosscheck(tmp_path / "arm.urdf")
    assert found.near_degenerate == 2
    assert found.rank_gap is not None
    said = (
        f"2 near-degenerate directions below 1e-05 of the largest dropped, gap {found.rank_gap:.3g}"
    )
    assert said in found.summary()
    assert (found.coupling is not None) == coupled
    if found.coupling is not None:
        assert found.coupling["coupled_near_degenerate"] == 2
        assert f"gap {found.coupling['coupled_rank_gap']:.3g})" in found.summary()
