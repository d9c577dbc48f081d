"""Models written in the other format: torques of the source in both engines, and the way back."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench import package_folders
from sysid_bench.commands.identify import identify
from sysid_bench.commands.write_model import format_of
from sysid_bench.errors import ModelError, UsageError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.writing.manifest_writer import manifest_text
from sysid_bench.models.writing.other_format import converted
from sysid_bench.models.writing.update import update_of
from sysid_bench.regressors.pinocchio import pinocchio_regressor
from sysid_bench.types import Array
from tests.robots import random_mjcf, states, urdf_files

OTHER = {"urdf": "mjcf", "mjcf": "urdf"}
SUFFIX = {"urdf": ".urdf", "mjcf": ".xml"}
MJCFS = 23


def torque(robot: RobotModel, rows: tuple[str, ...]) -> Array:
    """Pinocchio's torque of the bodies and of the joints' terms at random states, by row."""
    joint = {name: joint for joint in robot.joints for name in joint.dofs}
    motion, order = states(robot, 5), [robot.rows.index(row) for row in rows]
    rng = np.random.default_rng(3)
    q, v, a = np.array(motion.q), np.zeros_like(motion.v), np.zeros_like(motion.a)
    for row in rows:  # the same state, whatever the order of the joints
        dof = robot.rows.index(row)
        if joint[row].kind in ("hinge", "slide"):
            q[:, joint[row].qadr] = rng.uniform(-1, 1, 5)
        v[:, dof], a[:, dof] = rng.normal(size=(2, 5))
    for base in (one for one in robot.joints if one.kind == "free"):
        q[:, base.qadr : base.qadr + 7] = [0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5]
    moved = type(motion)(motion.t, q, v, a)
    terms = robot.joint_terms
    tau = pinocchio_regressor(robot, moved).Y @ robot.phi.ravel()
    tau = tau + terms.viscous * v + terms.coulomb * np.sign(v) + terms.armature * a
    for one in (one for one in robot.joints if one.kind in ("hinge", "slide")):
        away = q[:, one.qadr] - terms.spring_reference[one.vadr]
        tau[:, one.vadr] += terms.spring[one.vadr] * away
    return np.asarray(tau[:, order])


def assert_same(source: RobotModel, file: Path) -> None:
    again = load_robot(file)
    assert crosscheck(again, samples=5).ok()
    assert set(again.rows) == set(source.rows)
    theirs, ours = torque(again, source.rows), torque(source, source.rows)
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-9 * np.abs(ours).max())
    for row in source.rows:
        one, other = (robot.rows.index(row) for robot in (source, again))
        (joint,) = (one for one in source.joints if row in one.dofs)
        if not source.mj.jnt_limited[source.joints.index(joint)]:
            continue
        for end in ("q_low", "q_high"):
            np.testing.assert_allclose(
                getattr(again.limits, end)[other], getattr(source.limits, end)[one]
            )


def write(source: Path | str, folder: Path) -> Path:
    """The manifest of a robot written in the other format."""
    manifest = find_manifest(str(source))
    update = update_of(manifest.path, {}, {}, None)
    form = OTHER[update.robot.format]
    name = f"{manifest.path.stem}-{form}{SUFFIX[form]}"
    text, described = converted(update, manifest, form, name)
    (folder / name).write_text(text)
    file = folder / f"{Path(name).stem}.toml"
    file.write_text(manifest_text(described, name))
    return file


def check_both_ways(source: Path | str, folder: Path) -> None:
    robot = load_robot(find_manifest(str(source)))
    there = write(source, folder)
    assert_same(robot, there)
    assert_same(robot, write(there, folder))


@pytest.mark.parametrize("seed", range(12))
def test_random_trees_go_there_and_back(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "tree.xml"
    path.write_text(random_mjcf(seed))
    robot = load_robot(path)
    if {"ball", "free"} & {joint.kind for joint in robot.joints}:
        with pytest.raises(ModelError, match=r"ball joints|of a free joint"):
            write(path, tmp_path)
        return
    check_both_ways(path, tmp_path)


@pytest.mark.parametrize("name", ["ur5", "panda", "scara"])
def test_named_robots_go_there_and_back(name: str, tmp_path: Path) -> None:
    check_both_ways(name, tmp_path)


AWKWARD = """<mujoco><option gravity="1 0 -3"/><worldbody>
<body name="a" pos="0 0.1 1" euler="10 90 20"><inertial pos="0.1 0 0" mass="2" diaginertia="1 1 1"/>
 <joint name="one" axis="0 0.6 0.8" pos="0.1 0.2 0" ref="30" damping="2" stiffness="5"
  springref="10" range="-90 90"/>
 <joint name="two" type="slide" axis="1 0 0" pos="0 0.3 0" ref="0.2" armature="0.3"
  frictionloss="1"/>
 <body name="b" pos="0.3 0 0" quat="0.5 0.5 0.5 0.5">
  <inertial pos="0 0 0.2" mass="1" fullinertia="0.2 0.3 0.25 0.01 0.02 0"/>
  <joint name="three" ref="20"/>
  <body name="c" pos="0 0 0.1">
   <inertial pos="0 0.1 0" mass="1" diaginertia="0.1 0.1 0.1"/>
   <joint name="five" axis="1 0 0"/><joint name="six" axis="0 1 0" pos="0 0 0.1"/>
   <site name="hand" pos="0 0 0.2" euler="0 45 0"/></body>
 </body></body>
<body name="d"><inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>
 <joint name="four"/></body>
</worldbody><equality>{equality}</equality>
<actuator><motor joint="three" gear="10" ctrlrange="-2 2" forcerange="-2 2"/></actuator></mujoco>"""
RATIO = '<joint joint1="four" joint2="three" polycoef="0.1 -2 0 0 0"/>'


def test_references_springs_gravity_and_couplings_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(AWKWARD.format(equality=""))
    check_both_ways(path, tmp_path)
    path.write_text(AWKWARD.format(equality=RATIO))
    robot, again = load_robot(path), load_robot(write(f"{path}?tool=hand", tmp_path))
    assert robot.coupling is not None
    assert again.coupling is not None
    assert again.torque_rows == robot.torque_rows
    # The same closure: the dependent joint for a given independent one.
    for one in (robot, again):
        q = np.zeros((1, one.mj.nq))
        q[:, next(j.qadr for j in one.joints if j.name == "three")] = 0.7
        assert one.coupling is not None
        full = one.coupling.completed(q, np.zeros((1, one.nv)), np.zeros((1, one.nv)))[0]
        dependent = full[0, next(j.qadr for j in one.joints if j.name == "four")]
        assert dependent == pytest.approx(0.1 - 2 * (0.7 - np.deg2rad(20)))
    assert again.body_names[again.tool_body] == "hand"
    assert load_robot(write(path, tmp_path)).limits.tau[again.rows.index("three")] == 20.0


def test_what_a_urdf_cannot_hold_is_listed(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    curved = '<joint joint1="four" joint2="three" polycoef="0 1 1 0 0"/>'
    text = AWKWARD.format(equality=curved).replace('<joint name="three" ref="20"/>',
        '<joint name="three" ref="20"/><joint name="wrist" type="ball"/>')  # fmt: skip
    path.write_text(text)
    with pytest.raises(ModelError, match=r"constant ratio.*ball joints \(wrist\)"):
        write(path, tmp_path)


def test_the_suffix_chooses_the_format(tmp_path: Path) -> None:
    target = tmp_path / "arm.xml"
    words: dict[str, Any] = {"simulate": True, "complete": "entropic", "model_out": target}
    done = identify("ur5", **words)
    assert format_of(target) == load_robot(target).format == "mjcf"
    assert any("arm.toml" in warning for warning in done["warnings"])
    assert load_robot(tmp_path / "arm.toml").manifest.tool == "tool0"
    for name, one in zip(load_robot(target).body_names, load_robot(target).phi, strict=True):
        mass = done["bodies"].get(name, {"parameters": {"m": one[0]}})["parameters"]["m"]
        assert one[0] == pytest.approx(mass, abs=1e-9)
    with pytest.raises(UsageError, match=r"\*\.urdf or \*\.xml"):
        identify("ur5", **{**words, "model_out": tmp_path / "arm.txt"})
    (tmp_path / "other.toml").write_text("[mine]\n")
    with pytest.raises(UsageError, match="not a robot's manifest"):
        identify("ur5", **{**words, "model_out": tmp_path / "other.xml"})


@pytest.mark.long
@pytest.mark.parametrize("file", urdf_files())
def test_urdfs_of_the_collection(file: str, tmp_path: Path) -> None:
    path = package_folders.robot_data_folder() / file
    assert_same(load_robot(Manifest(path.stem, path)), write(path, tmp_path))


@pytest.mark.long
@pytest.mark.data
def test_mjcfs_of_the_collection(data_folder: Path, tmp_path: Path) -> None:
    files = sorted((data_folder / "robots").glob("*.xml"))
    assert len(files) == MJCFS
    for path in files:
        assert_same(load_robot(path), write(path, tmp_path))
