"""Models with new numbers: they read back as asked, and the rest of the text stays."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench import package_folders
from sysid_bench.errors import ModelError, UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.writing.mjcf_writer import update_mjcf
from sysid_bench.models.writing.update import JOINT_KEYS
from sysid_bench.models.writing.urdf_writer import update_urdf
from sysid_bench.models.writing.xml_text import element_tree
from sysid_bench.spatial import body_mass_inertia, phi_of
from sysid_bench.types import Array
from tests.robots import random_mjcf, random_phi, random_rotation, urdf_files

MJCFS = 23
WRITTEN = {
    "mjcf": re.compile(r"\s*<inertial\b[^>]*>|\s(damping|frictionloss)=\"[^\"]*\""),
    "urdf": re.compile(r"\s*<inertial>.*?</inertial>|\s*<dynamics\b[^>]*>", re.DOTALL),
}
"""What writing may change or add."""


def kept(text: str, format: str) -> str:
    """The text without what writing may change."""
    return WRITTEN[format].sub("", text)


def changed(robot: RobotModel, seed: int) -> tuple[dict[str, Array], dict[str, dict[str, float]]]:
    """Other bodies and other friction for everything that has any."""
    rng = np.random.default_rng(seed)
    bodies = {
        name: phi * rng.uniform(0.5, 2.0) + 0.1 * phi[0] * random_phi(rng)
        for name, phi in zip(robot.body_names, robot.phi, strict=True)
        if phi[0] > 0
    }
    joints = {
        joint.name: {"damping": float(rng.uniform()), "frictionloss": float(rng.uniform())}
        for joint in robot.joints
        if joint.kind in ("hinge", "slide")
    }
    return bodies, joints


def check_round_trips(path: Path, seed: int, tmp_path: Path) -> None:
    robot = load_robot(path)
    write = update_urdf if robot.format == "urdf" else update_mjcf
    source = path.read_bytes().decode()
    own = write(path, dict(zip(robot.body_names, robot.phi, strict=True)))
    bodies, joints = changed(robot, seed)
    new = write(path, bodies, joints)
    for text in (own, new):
        assert kept(text, robot.format) == kept(source, robot.format)
        for word in (r"<!--.*?-->", r"<mesh\b[^>]*>", r"\r"):
            assert re.findall(word, text, re.DOTALL) == re.findall(word, source, re.DOTALL)
    copy = tmp_path / path.name
    for text, wanted in ((own, {}), (new, bodies)):
        copy.write_bytes(text.encode())
        again = load_robot(copy)
        for name, phi, before in zip(robot.body_names, again.phi, robot.phi, strict=True):
            asked = wanted.get(name, before)
            assert np.abs(phi - asked).max() <= 1e-12 * max(1e-3, np.abs(asked).max()), name
    for joint in again.joints:
        for key, term in (("damping", "viscous"), ("frictionloss", "coulomb")):
            if joint.name in joints:
                value = getattr(again.joint_terms, term)[joint.vadr]
                assert value == joints[joint.name][key]


@pytest.mark.data
def test_round_trips_of_the_mjcf_collection(data_folder: Path, tmp_path: Path) -> None:
    files = sorted((data_folder / "robots").glob("*.xml"))
    assert len(files) == MJCFS
    for seed, file in enumerate(files):
        check_round_trips(file, seed, tmp_path)


def test_round_trips_of_urdfs(tmp_path: Path) -> None:
    for seed, file in enumerate(urdf_files()[::4]):
        check_round_trips(package_folders.robot_data_folder() / file, seed, tmp_path)


@pytest.mark.parametrize("seed", range(40))
def test_round_trips_of_random_trees_with_unnamed_bodies(seed: int, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "tree.xml"
    path.write_text(random_mjcf(seed), encoding="utf-8")
    check_round_trips(path, seed, tmp_path)


MJCF = """<?xml version="1.0" encoding="utf-8"?>
<!-- an arm <inertial mass="9"/> with everything -->
<mujoco model="größer">\r
  <compiler angle="degree"/>
  <default><joint damping="0.5 0.25"/>
    <default class="dry"><joint frictionloss="2"/></default></default>
  <worldbody>
    <body name="base"><geom name="a > b" type="box" size=".1 .1 .1"/>
      <frame pos="0 0 .1"><joint name="j1" class='dry' axis="0 0 1"/></frame>
      <body name="arm" pos="0 0 1">  <!-- > -->
        <body name="tip" pos="1 0 0"/>
        <inertial mass = '2' pos="0 0 0" euler="10 20 30"
                  diaginertia="1 2 2.5" />
        <joint axis="0 1 0" springref="5" stiffness="3"/>
        <body><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint type="slide"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
URDF = """<robot name="arm">
  <link name="base"/>
  <link name="bare"/>
  <link name="half"><inertial><mass value="2"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="none"><visual><geometry><mesh filename="a.stl"/></geometry></visual></link>
  <joint name="j1" type="continuous"><parent link="base"/><child link="half"/><axis xyz="0 0 1"/>
    <origin xyz="1 2 3" rpy="0.1 0.2 0.3"/></joint>
  <joint name="f" type="fixed"><parent link="half"/><child link="bare"/></joint>
  <joint name="g" type="fixed"><parent link="half"/><child link="none"/></joint>
</robot>
"""
PHI = random_phi(np.random.default_rng(3))


ARM = '<body name="arm"><joint/><geom size=".1"/></body>'
"""An MJCF body with the inertia of its shape."""


@pytest.fixture
def mjcf(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_bytes(MJCF.encode())
    return path


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_bytes(URDF.encode())
    return path


def reread(path: Path, text: str) -> RobotModel:
    path.write_bytes(text.encode())
    return load_robot(path)


def check_written(path: Path, name: str, text: str) -> RobotModel:
    """The body has PHI, and the others what they had."""
    before, after = load_robot(path), reread(path, text)
    for body, phi, old in zip(before.body_names, after.phi, before.phi, strict=True):
        np.testing.assert_allclose(phi, PHI if body == name else old, rtol=0, atol=1e-12)
    return after


@pytest.mark.parametrize("name", ["base", "arm", "tip", "body4"])
def test_every_kind_of_body_is_written(mjcf: Path, name: str) -> None:
    text = update_mjcf(mjcf, {name: PHI})
    assert text.count("\r") == MJCF.count("\r")
    assert "größer" in text
    assert '<!-- an arm <inertial mass="9"/> with everything -->' in text
    check_written(mjcf, name, text)


@pytest.mark.parametrize("name", ["base", "bare", "half", "none"])
def test_every_kind_of_link_is_written(urdf: Path, name: str) -> None:
    text = update_urdf(urdf, {name: PHI}, {"j1": {"damping": 0.3}})
    assert 'rpy="0.1 0.2 0.3"' in text
    assert '<mesh filename="a.stl"/>' in text
    assert check_written(urdf, name, text).joint_terms.viscous[0] == 0.3


def test_a_body_that_had_shapes_alone_keeps_them(mjcf: Path) -> None:
    text = update_mjcf(mjcf, {"base": PHI})
    (root,) = [
        e for e in element_tree(text.encode(), "x").subtree() if e.attributes.get("name") == "base"
    ]
    assert [child.tag for child in root.children][:2] == ["inertial", "geom"]


@pytest.mark.parametrize(
    ("mass", "com", "six"),
    [
        (1.0, (0.1, 0.2, 0.3), (0.0,) * 6),
        (2.0, (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 0.3, 0.0, 0.3)),
        (1.5, (0.0, 0.0, 0.0), (0.1, 0.02, 0.0, 0.2, 0.0, 0.3)),
    ],
)
def test_points_rods_and_laminae_are_written(
    mjcf: Path, mass: float, com: tuple[float, ...], six: tuple[float, ...]
) -> None:
    after = reread(mjcf, update_mjcf(mjcf, {"tip": (mass, com, six)}))
    read_back = body_mass_inertia(after.phi[after.body_names.index("tip")])
    assert read_back[0] == mass
    np.testing.assert_allclose(read_back[1], com, atol=1e-15)
    np.testing.assert_allclose(
        read_back[2][(0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)], six, atol=1e-13
    )


@pytest.mark.parametrize("joint", ["j1", "joint2"])
def test_joint_terms_have_the_units_of_the_file(mjcf: Path, joint: str) -> None:
    values = dict(zip(JOINT_KEYS, (0.7, 0.1, 0.02, 4.0, 1.1), strict=True))
    text = update_mjcf(mjcf, {}, {joint: values})
    assert "0.7 0.25" in text  # the quadratic part of the default's damping stays
    again = reread(mjcf, text)
    names = ("viscous", "coulomb", "armature", "spring", "spring_reference")
    terms = [getattr(again.joint_terms, name)[again.rows.index(joint)] for name in names]
    np.testing.assert_allclose(terms, [*values.values()], rtol=0, atol=1e-15)


# --- Refusals -------------------------------------------------------------------------------


def test_what_was_not_identified_is_named_and_not_written(mjcf: Path, urdf: Path) -> None:
    read_back = {"tip.m": "none", "tip.hx": "identifiable", "tip.Ixx": "combination"}
    for write, path in ((update_mjcf, mjcf), (update_urdf, urdf)):
        before = path.read_bytes()
        with pytest.raises(ModelError, match=r"2 of 3 parameters .*: tip\.m, tip\.Ixx\. Use"):
            write(path, {load_robot(path).body_names[0]: PHI}, verdicts=read_back)
        assert path.read_bytes() == before


LIGHT, THIN = PHI * np.array([-1.0] + [1] * 9), PHI * np.array([1, 1, 1, 1, 4.0] + [1] * 5)
"""A negative mass, and moments that break the triangle inequality."""
REFUSED: list[tuple[type[Exception], str, dict[str, Any], dict[str, Any], str]] = [
    (ModelError, "xml", {"tip": LIGHT, "base": THIN, "arm": PHI}, {}, "parameters of tip .*, base"),
    (ModelError, "urdf", {"half": THIN}, {}, "positive semidefinite"),
    (ModelError, "xml", {}, {"j1": {"damping": -0.1}}, r"damping of the joint 'j1' is -0\.1"),
    (ModelError, "urdf", {}, {"j1": {"armature": 0.1}}, "no armature of joints"),
    (UsageError, "xml", {"tipp": PHI}, {}, "Did you mean 'tip'"),
    (UsageError, "xml", {}, {"joint1": {"damping": 1.0}}, "Did you mean 'joint"),
    (UsageError, "xml", {}, {"j1": {"dampin": 1.0}}, "Did you mean 'damping'"),
    (UsageError, "xml", {"tip": PHI[:9]}, {}, "ten finite numbers"),
    (UsageError, "xml", {"tip": PHI * np.nan}, {}, "ten finite numbers"),
    (UsageError, "xml", {"tip": (1.0, "x", 2)}, {}, "cannot have"),
    (UsageError, "xml", {"tip": [1, 2, 3]}, {}, r"'tip' cannot have \[1, 2, 3\]; it needs ten"),
    (UsageError, "xml", {}, {"j1": {"damping": np.inf}}, "must be finite"),
]


@pytest.mark.parametrize(("error", "format", "bodies", "joints", "words"), REFUSED)
def test_wrong_values_and_names_are_not_written(
    mjcf: Path,
    urdf: Path,
    error: type[Exception],
    format: str,
    bodies: Any,
    joints: Any,
    words: str,
) -> None:
    write, path = {"xml": (update_mjcf, mjcf), "urdf": (update_urdf, urdf)}[format]
    with pytest.raises(error, match=words):
        write(path, bodies, joints)


def test_the_other_format_is_refused(mjcf: Path, urdf: Path) -> None:
    with pytest.raises(ModelError, match="not an MJCF"):
        update_mjcf(urdf, {})
    with pytest.raises(ModelError, match="not a URDF"):
        update_urdf(mjcf, {})


FILES = {
    f'<mujoco><worldbody><replicate count="2" offset="1 0 0">{ARM}</replicate></worldbody>'
    "</mujoco>": "<replicate> creates it",
    "<?xml version='1.0' encoding='iso-8859-1'?><!-- gr\xf6\xdfer --><mujoco><worldbody>"
    f"{ARM}</worldbody></mujoco>": "UTF-8",
} | {
    f"<mujoco><compiler {option}/><worldbody>{ARM}</worldbody></mujoco>": option.partition("=")[0]
    for option in ('settotalmass="3"', 'inertiafromgeom="true"', 'boundmass="50"')
}


@pytest.mark.parametrize("text", FILES)
def test_files_that_copy_or_overrule_what_is_written_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "arm.xml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ModelError, match=FILES[text]):
        update_mjcf(path, {load_robot(path).body_names[0]: PHI})


def test_inertia_from_shapes_alone_is_to_become_auto(tmp_path: Path) -> None:
    path, text = tmp_path / "arm.xml", next(text for text in FILES if "inertiafromgeom" in text)
    path.write_text(text)
    with pytest.raises(ModelError, match='set inertiafromgeom="auto"'):
        update_mjcf(path, {"arm": PHI})
    path.write_text(text.replace("true", "auto"))
    check_written(path, "arm", update_mjcf(path, {"arm": PHI}))


def test_bodies_of_included_files_are_refused_and_others_written(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "hand.xml").write_text(
        '<mujoco><body name="hand"><joint name="h"/><geom size=".1"/></body></mujoco>'
    )
    path = tmp_path / "arm.xml"
    path.write_text(
        f'<mujoco><worldbody>{ARM[:-7]}<include file="parts/hand.xml"/></body></worldbody></mujoco>'
    )
    after = reread(path, update_mjcf(path, {"arm": PHI}))
    np.testing.assert_allclose(after.phi[0], PHI, atol=1e-12)
    for bodies, joints in (({"hand": PHI}, {}), ({}, {"h": {"damping": 1.0}})):
        with pytest.raises(ModelError, match="included file"):
            update_mjcf(path, bodies, joints)
    with pytest.raises(ModelError, match="'joint1' cannot be written"):  # its place is not known
        update_mjcf(path, {}, {"joint1": {"damping": 1.0}})


GEARED = """<mujoco><worldbody><body name="a"><joint name="ja" damping="3" armature="0.2"/>
<geom size=".1"/><body name="b" pos="1 0 0"><joint name="jb"/><geom size=".1"/></body></body>
</worldbody><actuator><motor joint="ja" gear="7" armature="0.01" damping=".1"/>
<motor name="second" joint="ja" gear="-2" armature="0.02"/><motor joint="jb"/></actuator>
</mujoco>"""


@pytest.mark.parametrize("seed", range(3))
def test_a_joint_is_written_without_what_its_actuators_add(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(GEARED)
    added = {"armature": 49 * 0.01 + 4 * 0.02, "damping": 4.9}
    rng = np.random.default_rng(seed)
    own = {key: float(rng.random()) for key in added}
    total = {key: own[key] + added[key] for key in added}
    text = update_mjcf(path, {}, {"ja": total, "jb": own})
    elements = element_tree(text.encode(), "").subtree()
    joints = {e.attributes["name"]: e.attributes for e in elements if e.tag == "joint"}
    for joint in ("ja", "jb"):
        for key in added:
            assert float(joints[joint][key]) == pytest.approx(own[key], abs=1e-12)
    terms = reread(path, text).joint_terms
    np.testing.assert_allclose(terms.armature, [total["armature"], own["armature"]], rtol=1e-12)
    np.testing.assert_allclose(terms.viscous, [total["damping"], own["damping"]], rtol=1e-12)


def test_less_than_what_an_actuator_adds_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(GEARED)
    with pytest.raises(ModelError, match=r"'ja' is 0\.1, less than the 0\.57 .*second"):
        update_mjcf(path, {}, {"ja": {"armature": 0.1}})


def test_nothing_is_written_beside_the_source(mjcf: Path) -> None:
    before = {path: path.read_bytes() for path in mjcf.parent.iterdir()}
    update_mjcf(mjcf, {"tip": PHI})
    assert {path: path.read_bytes() for path in mjcf.parent.iterdir()} == before


@pytest.mark.parametrize("seed", range(10))
def test_a_lamina_is_written_and_read_without_repair(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    R, squares = random_rotation(rng), rng.uniform(0.01, 1, 3) * [0, 1, 1]
    covariance = R @ np.diag(squares) @ R.T
    inertia = np.trace(covariance) * np.eye(3) - covariance
    phi = phi_of(2.0, rng.normal(size=3) * 0.1, inertia)
    six = 'ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"'
    inertial = f'<inertial><mass value="1"/><inertia {six}/></inertial>'
    links = "".join(f'<link name="{name}">{inertial}</link>' for name in "ab")
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    file = tmp_path / "r.urdf"
    file.write_text(f'<robot name="r">{links}{joint}</robot>')
    file.write_text(update_urdf(file, {"b": phi}))
    again = load_robot(file)
    assert again.repairs == ()
    np.testing.assert_allclose(again.phi[1], phi, atol=1e-12)


@pytest.mark.parametrize("angle", [1e-9, 4e-8, 9e-7, 3e-6, 1e-3])
def test_a_rod_almost_along_an_axis_is_read_as_it_moves(mjcf: Path, angle: float) -> None:
    """MuJoCo takes an inertial frame within 1e-6 of that of the body for it."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    phi = phi_of(2.0, np.array([0.01, 0.0, 0.2]), R @ np.diag([0.3, 0.3, 1e-8]) @ R.T)
    after = reread(mjcf, update_mjcf(mjcf, {"tip": phi}))
    np.testing.assert_allclose(after.phi[after.body_names.index("tip")], phi, rtol=0, atol=3.1e-7)
