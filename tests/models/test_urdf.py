"""Canonical URDF: what is broken is refused in one sentence, what is repaired is reported, and
what is good stays as it was written."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from sysid_bench import package_folders
from sysid_bench.errors import ModelError
from sysid_bench.models.urdf import Mimic, canonical_urdf
from sysid_bench.models.xml_file import parse_xml
from sysid_bench.spatial import inertia_matrix, matrix_of_quaternion, quaternion_of_rotation
from sysid_bench.types import Array
from tests.closeness import assert_close
from tests.robots import named_robot, random_rotation, robot_of, urdf_files, urdf_robot

SIX = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
ROWS, COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)


def link(name: str, mass: str = "1", inertia: str = "1 0 0 1 0 1", origin: str = "0 0 0") -> str:
    six = " ".join(f'{key}="{x}"' for key, x in zip(SIX, inertia.split(), strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="{origin}"/><mass value="{mass}"/>'
        f"<inertia {six}/></inertial></link>"
    )


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/>{inside}</joint>'
    )


def robot(*parts: str) -> str:
    return f"<robot name='r'>{''.join(parts)}</robot>"


GOOD = robot(link("a"), link("b"), joint("j", "a", "b"))


def inertials(text: str) -> dict[str, list[float]]:
    """Mass, origin and the six numbers of every link, read as they are written."""
    found = {}
    for element in ET.fromstring(text).findall("link"):
        inertial = element.find("inertial")
        if inertial is None:
            continue
        origin, mass = inertial.find("origin"), inertial.find("mass")
        six = inertial.find("inertia")
        place = {} if origin is None else origin.attrib
        words = [*place.get("xyz", "0 0 0").split(), *place.get("rpy", "0 0 0").split()]
        words.append("0" if mass is None else mass.get("value", "0"))
        words += ["0"] * 6 if six is None else [six.get(key, "0") for key in SIX]
        found[str(element.get("name"))] = [float(word) for word in words]
    return found


def skeleton(text: str) -> dict[str, tuple[str | None, str]]:
    """Type, ends, origin, axis and limits of every joint, as written."""
    found = {}
    for element in ET.fromstring(text).findall("joint"):
        parts = {tag: element.find(tag) for tag in ("parent", "child", "origin", "axis", "limit")}
        attributes = {tag: {} if part is None else part.attrib for tag, part in parts.items()}
        found[str(element.get("name"))] = (element.get("type"), repr(attributes))
    return found


@pytest.mark.parametrize("file", urdf_files())
def test_what_is_not_repaired_keeps_all_its_numbers(file: str) -> None:
    text = (package_folders.robot_data_folder() / file).read_text(encoding="utf-8")
    urdf = canonical_urdf(text, file)
    mended = {name for words in urdf.repairs for name in re.findall(r"link '([^']+)'", words)}
    before, after = inertials(text), inertials(urdf.text)
    assert mended <= set(after)
    for name, numbers in before.items():
        if name not in mended:
            assert after[name] == numbers
    assert set(after) - set(before) <= mended
    assert skeleton(urdf.text) == skeleton(text)


@pytest.mark.parametrize("file", urdf_files())
def test_the_canonical_text_is_its_own(file: str) -> None:
    """Mended once, there is nothing left to mend."""
    urdf = canonical_urdf((package_folders.robot_data_folder() / file).read_bytes(), file)
    again = canonical_urdf(urdf.text, file)
    assert again.repairs == ()
    assert inertials(again.text) == inertials(urdf.text)
    assert skeleton(again.text) == skeleton(urdf.text)


def test_a_good_file_needs_no_repair() -> None:
    urdf = canonical_urdf(GOOD, "good.urdf")
    assert urdf.repairs == ()
    assert urdf.mimic == ()
    assert urdf.velocity_limits == {"j": 1.0}


BROKEN = {
    "no XML": ("<robot>", "not well-formed XML"),
    "empty": ("", "not well-formed XML"),
    "not a robot": ("<model/>", "its root element is <model>"),
    "doctype": ('<!DOCTYPE x [<!ENTITY y "z">]>' + GOOD, "DOCTYPE"),
    "no links": (robot(), "no <link>"),
    "a world that is not declared": (
        robot(link("a"), joint("weld", "world", "a")),
        'refuse the file: add <link name="world"/>',
    ),
    "a joint alone": (robot(joint("j", "a", "b")), "'a', which is not one of its links"),
    "link without name": (robot("<link/>", link("b")), "<link> has no name"),
    "two links of a name": (robot(link("a"), link("a")), "2 <link> elements are called 'a'"),
    "two joints of a name": (
        robot(link("a"), link("b"), link("c"), joint("j", "a", "b"), joint("j", "b", "c")),
        "2 <joint> elements are called 'j'",
    ),
    "two roots": (robot(link("a"), link("b")), "2 root links (a, b)"),
    "two parents": (
        robot(link("a"), link("b"), link("c"), joint("i", "a", "c"), joint("j", "b", "c")),
        "two parents, 'a' and 'b'",
    ),
    "whole cycle": (
        robot(link("a"), link("b"), joint("i", "a", "b"), joint("j", "b", "a")),
        "a cycle",
    ),
    "cycle apart": (
        robot(link("a"), link("b"), link("c"), joint("i", "b", "c"), joint("j", "c", "b")),
        "b, c form a cycle apart from 'a'",
    ),
    "own parent": (robot(link("a"), link("b"), joint("j", "b", "b")), "cycle"),
    "missing parent": (
        robot(link("b"), joint("j", "x", "b")),
        "'x', which is not one of its links",
    ),
    "missing child": (robot(link("a"), joint("j", "a", "x")), "'x', which is not one of its links"),
    "no child": (GOOD.replace('<child link="b"/>', ""), "child of joint 'j' is None"),
    "negative mass": (GOOD.replace('value="1"', 'value="-1"', 1), "negative mass -1.0"),
    "NaN mass": (GOOD.replace('value="1"', 'value="nan"', 1), "'nan'"),
    "infinite mass": (GOOD.replace('value="1"', 'value="inf"', 1), "'inf'"),
    "mass in words": (GOOD.replace('value="1"', 'value="heavy"', 1), "'heavy'"),
    "mass without value": (GOOD.replace('value="1"', "", 1), "value is None"),
    "NaN inertia": (GOOD.replace('ixx="1"', 'ixx="nan"', 1), "ixx is 'nan'"),
    "NaN centre": (GOOD.replace('xyz="0 0 0"', 'xyz="0 nan 0"', 1), "'0 nan 0'"),
    "short centre": (GOOD.replace('xyz="0 0 0"', 'xyz="0 0"', 1), "'0 0'"),
    "NaN limit": (GOOD.replace('lower="-1"', 'lower="nan"'), "lower is 'nan'"),
    "NaN placement": (
        robot(link("a"), link("b"), joint("j", "a", "b", inside='<origin rpy="0 0 nan"/>')),
        "'0 0 nan'",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_cannot_be_mended_is_refused_in_a_sentence(case: str) -> None:
    text, words = BROKEN[case]
    with pytest.raises(ModelError) as refusal:
        canonical_urdf(text, "broken.urdf")
    message = str(refusal.value)
    assert words in message
    assert message.startswith("broken.urdf")
    assert "\n" not in message


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-32"])
def test_entities_are_refused_in_every_encoding(encoding: str) -> None:
    text = '<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "b">]><robot/>'
    with pytest.raises(ModelError, match="DOCTYPE"):
        parse_xml(text.encode(encoding), "r.urdf")


def body_inertia(text: str, name: str) -> Array:
    return inertia_matrix(np.array(inertials(text)[name][7:]))


IMPOSSIBLE = ["1 0 0 1 0 5", "-1 0 0 1 0 1", "1 2 0 1 0 1", "1 0 0 1 0 0", "0 0 0 0 0 3"]


@pytest.mark.parametrize("inertia", IMPOSSIBLE)
def test_an_impossible_inertia_is_made_possible_and_reported(inertia: str) -> None:
    text = robot(link("a"), link("b", inertia=inertia), joint("j", "a", "b"))
    urdf = canonical_urdf(text, "r.urdf")
    (words,) = urdf.repairs
    assert "inertia of link 'b' made physically possible" in words
    moments = np.linalg.eigvalsh(body_inertia(urdf.text, "b"))
    assert moments[0] > 0
    assert moments[0] + moments[1] >= moments[2]
    change = np.abs(body_inertia(urdf.text, "b") - body_inertia(text, "b")).max()
    reported = float(words.split("largest relative change ")[1].rstrip(")"))
    assert reported == pytest.approx(change / np.abs(body_inertia(text, "b")).max(), rel=0.05)
    robot_of(urdf.text)


def test_a_nearly_possible_inertia_is_hardly_touched() -> None:
    text = robot(link("a"), link("b", inertia="1 0 0 1 0 2.000001"), joint("j", "a", "b"))
    urdf = canonical_urdf(text, "r.urdf")
    assert len(urdf.repairs) == 1
    np.testing.assert_allclose(body_inertia(urdf.text, "b"), body_inertia(text, "b"), atol=1e-5)


@pytest.mark.parametrize("seed", range(60))
def test_a_lamina_at_any_angle_is_a_robot(seed: int) -> None:
    """It lies on the border of what can exist; rounding puts it on either side."""
    rng = np.random.default_rng(seed)
    R, squares = random_rotation(rng), rng.uniform(0.01, 1, 3) * [0, 1, 1]
    covariance = R @ np.diag(squares) @ R.T
    inertia = np.trace(covariance) * np.eye(3) - covariance
    six = " ".join(repr(float(x)) for x in inertia[ROWS, COLUMNS])
    urdf = canonical_urdf(robot(link("a"), link("b", inertia=six), joint("j", "a", "b")), "r.urdf")
    np.testing.assert_allclose(robot_of(urdf.text).phi[1, 4:], inertia[ROWS, COLUMNS], atol=1e-5)


@pytest.mark.parametrize("seed", range(60))
def test_a_lamina_in_a_turned_frame_is_a_robot_as_written(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(0.01, 1, 2) * 10.0 ** rng.uniform(-6, 1)).tolist()
    six = f"{x!r} 0 0 {y!r} 0 {x + y!r}"
    rpy = " ".join(map(repr, rng.uniform(-3, 3, 3).tolist()))
    flat = link("b", inertia=six).replace("<origin", f'<origin rpy="{rpy}"')
    loaded = robot_of(robot(link("a"), flat, joint("j", "a", "b")))
    assert loaded.repairs == ()
    moments = np.linalg.eigvalsh(inertia_matrix(loaded.phi[1, 4:]))
    assert_close(moments, sorted([x, y, x + y]), 1e-11)


def test_a_microrobot_keeps_its_inertias() -> None:
    small = "2e-14 0 0 3e-14 0 2.5e-14"
    text = robot(*(link(name, "1e-6", small) for name in "ab"), joint("j", "a", "b"))
    assert canonical_urdf(text, "r.urdf").repairs == ()
    assert_close(robot_of(text).phi[1, 4:], [2e-14, 0, 0, 3e-14, 0, 2.5e-14])
    impossible = text.replace(small.split()[0], "2e-11").replace("3e-14", "3e-11")
    mended = robot_of(impossible.replace("2.5e-14", "5.0001e-11")).phi[1]
    np.testing.assert_allclose(mended[[4, 7, 9]], [2e-11, 3e-11, 5e-11], rtol=2e-3)


def test_a_point_mass_is_given_an_inertia_and_reported() -> None:
    text = robot(link("a"), link("b", mass="3", inertia="0 0 0 0 0 0"), joint("j", "a", "b"))
    urdf = canonical_urdf(text, "r.urdf")
    (words,) = urdf.repairs
    assert "point mass of link 'b'" in words
    assert 0 < body_inertia(urdf.text, "b")[0, 0] < 1e-5
    assert robot_of(urdf.text).phi[1, 0] == 3.0


@pytest.mark.parametrize("empty", ['<link name="b"/>', link("b", mass="0", inertia="0 0 0 0 0 0")])
def test_a_moving_link_without_mass_is_given_some_and_reported(empty: str) -> None:
    urdf = canonical_urdf(robot(link("a"), empty, joint("j", "a", "b")), "r.urdf")
    (words,) = urdf.repairs
    assert "massless moving link 'b'" in words
    assert 0 < robot_of(urdf.text).phi[1, 0] <= 1e-6


def test_a_frame_with_something_fixed_to_it_stays_massless() -> None:
    """The mass may be on a welded child; only what would move without any mass is mended."""
    parts = [link("a"), '<link name="b"/>', link("c"), joint("j", "a", "b")]
    urdf = canonical_urdf(robot(*parts, joint("k", "b", "c", kind="fixed")), "r.urdf")
    assert urdf.repairs == ()
    np.testing.assert_array_equal(robot_of(urdf.text).phi[:, 0], [1, 0, 1])


def test_a_mimic_joint_is_taken_out_of_the_text_and_kept() -> None:
    parts = [link("a"), link("b"), link("c"), joint("i", "a", "b")]
    coupled = joint("j", "b", "c", inside='<mimic joint="i" multiplier="2"/>')
    urdf = canonical_urdf(robot(*parts, coupled), "r.urdf")
    assert urdf.mimic == (Mimic("j", "i", 2.0, 0.0),)
    assert urdf.repairs == ()
    assert robot_of(urdf.text).nv == 2


def test_fixed_links_keep_their_own_parameters() -> None:
    """MuJoCo fuses them by default: the base of a UR5 would be lost, and half of an iCub's arm."""
    ur5, icub = named_robot("ur5"), named_robot("icub")
    solo = urdf_robot("solo_description/robots/solo12.urdf")
    assert ur5.phi[:, 0].sum() == pytest.approx(20.99, abs=0.005)
    assert solo.phi[:, 0].sum() == pytest.approx(2.50, abs=0.005)
    assert icub.phi[icub.body_names.index("l_upper_arm"), 0] == pytest.approx(0.7278, abs=5e-5)


@pytest.mark.parametrize("file", urdf_files())
def test_every_link_of_a_file_is_a_body_of_the_robot(file: str) -> None:
    """The root may be the world; masses are those of the canonical text."""
    loaded = urdf_robot(file)
    written = inertials(loaded.text.decode())
    links = [str(e.get("name")) for e in ET.fromstring(loaded.text).findall("link")]
    assert set(links) - set(loaded.body_names) <= {"world"}
    for name, numbers in zip(loaded.body_names, loaded.phi, strict=True):
        if name in written:
            assert numbers[0] == written[name][6]


def test_a_floating_robot_begins_below_the_world() -> None:
    parts = ['<link name="world"/>', link("a"), link("b"), joint("w", "world", "a", kind="fixed")]
    text = robot(*parts, joint("j", "a", "b"))
    floating = robot_of(text, free_base=True)
    assert floating.rows == ("root.vx", "root.vy", "root.vz", "root.wx", "root.wy", "root.wz", "j")
    assert floating.body_names == ("a", "b")
    assert robot_of(text).rows == ("j",)


@pytest.mark.parametrize("seed", range(6))
def test_inertial_frames_may_be_turned_in_any_way(seed: int) -> None:
    """Against R I R^T of the written numbers; MuJoCo before 3.14 gets this wrong by itself."""
    rng = np.random.default_rng(seed)
    roll, pitch, yaw = rpy = rng.uniform(-3, 3, size=3)
    density = np.diag(rng.uniform(1, 2, size=3))
    if seed % 2:  # else the axes of the inertial frame are principal
        turn = random_rotation(rng)
        density = turn @ density @ turn.T
    inertia = np.trace(density) * np.eye(3) - density
    six = " ".join(map(repr, inertia[ROWS, COLUMNS].tolist()))
    words = " ".join(map(repr, rpy.tolist()))
    text = robot(link("a"), link("b", inertia=six), joint("j", "a", "b"))
    turned = text.replace('xyz="0 0 0"', f'xyz="0 0 0" rpy="{words}"')
    found = robot_of(turned).phi[1, 4:]
    x, y, z = (
        matrix_of_quaternion(quaternion_of_rotation(angle * axis))
        for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)
    )
    R = z @ y @ x
    assert_close(inertia_matrix(found), R @ inertia @ R.T, 1e-13)
