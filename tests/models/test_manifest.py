"""A manifest says what a robot is; each mistake in it is named, with what was nearest."""

import re
from dataclasses import fields, replace
from pathlib import Path

import pytest

from sysid_bench import package_folders
from sysid_bench.errors import ModelError, SysidBenchError, UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import JointTerms, find_manifest, read_manifest
from sysid_bench.models.writing.manifest_writer import manifest_text
from tests.robots import NAMED, named_robot

URDF = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="j" type="revolute">
<parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="5" velocity="3"/></joint></robot>"""
HEAD = 'name = "r"\nfile = "r.urdf"\n'


def manifest_file(folder: Path, text: str) -> Path:
    (folder / "r.urdf").write_text(URDF, encoding="utf-8")
    file = folder / "robot.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_robots_are_shipped() -> None:
    assert set(NAMED) >= {"icub", "panda", "solo12", "ur5"}


@pytest.mark.parametrize("name", NAMED)
def test_every_shipped_manifest_makes_a_robot(name: str) -> None:
    manifest = find_manifest(name)
    robot = named_robot(name)
    assert manifest.name == name
    assert manifest.title
    assert manifest.licence
    assert manifest.path.is_file()
    assert robot.floating == manifest.free_base
    if manifest.tool in robot.body_names:
        assert robot.body_names[robot.tool_body] == manifest.tool
    for table in (manifest.limits, manifest.joints):
        assert set(table) - {"all"} <= {joint.name for joint in robot.joints}


WRONG = [
    ("nmae = 1", "'nmae'", "Did you mean 'name'?"),
    ("terms = ['viscos']", "'viscos'", "Did you mean 'viscous'?"),
    ("terms = 'viscous'", "terms"),
    ("gravity = [0, 0]", "gravity"),
    ("gravity = [0, 0, nan]", "gravity", "finite"),
    ("gravity = [0, 0, '9.81']", "gravity", "'9.81'"),
    ("free_base = 'often'", "free_base"),
    ("tool = 5", "tool"),
    ("[limits.all]\nw = 1", "'w'", "q, tau, v"),
    ("[limits.all]\nv = nan", "limits.all.v", "finite"),
    ("[limits.all]\nv = inf", "limits.all.v", "finite"),
    ("[limits.all]\nv = -1", "limits.all.v", "positive"),
    ("[limits.all]\na = 0", "limits.all.a", "positive"),
    ("[limits.all]\na = true", "limits.all.a", "number"),
    ("[limits.all]\ntau = '5'", "limits.all.tau", "number"),
    ("[limits.j]\nq = [1, -1]", "limits.j.q", "[1.0, -1.0]"),
    ("[limits.j]\nq = [1, 1]", "limits.j.q", "[low, high]"),
    ("[limits.j]\nq = [1]", "limits.j.q"),
    ("[limits.j]\nq = [nan, 1]", "limits.j.q", "finite"),
    ("[joints.all]\nviscos = 1", "'viscos'", "Did you mean 'viscous'?"),
    ("[joints.all]\ncoulomb = nan", "joints.all.coulomb", "finite"),
    ("[joints.all]\nspring = 'soft'", "joints.all.spring", "number"),
    ("[[sensor]]\nname = 'wrist'\nta = 'arm'", "'ta'", "Did you mean 'at'?"),
    ("[[sensor]]\nname = 'wrist'", "sensor.0.at"),
]


@pytest.mark.parametrize(("text", "words"), [(text, words) for text, *words in WRONG])
def test_a_mistake_is_named_with_its_place(text: str, words: list[str], tmp_path: Path) -> None:
    file = manifest_file(tmp_path, HEAD + text)
    with pytest.raises(ModelError) as refusal:
        read_manifest(file)
    for word in [str(file), *words]:
        assert word in str(refusal.value)


def test_all_mistakes_come_at_once(tmp_path: Path) -> None:
    file = manifest_file(tmp_path, HEAD + "nmae = 1\nfree_base = 'x'\n[limits.all]\nv = nan")
    with pytest.raises(ModelError) as refusal:
        read_manifest(file)
    assert all(word in str(refusal.value) for word in ("nmae", "free_base", "limits.all.v"))


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "name"),
        ('name = "r"', "file"),
        ('name = "r"\nfile = "absent.urdf"', "absent.urdf"),
        ('name = "r"\nfile = ""', "file"),
        ('name = "r"\nfile = "example-robot-data:absent.urdf"', "absent.urdf"),
        ('name = "r"\nfile = "robot_descriptions:no_such_robot"', "no_such_robot"),
        ("name = ", "not valid TOML"),
        ("name = 1\nname = 2", "not valid TOML"),
    ],
)
def test_a_manifest_without_a_robot_is_refused(text: str, word: str, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=word):
        read_manifest(manifest_file(tmp_path, text))


def test_a_manifest_that_is_no_text_is_refused(tmp_path: Path) -> None:
    file = manifest_file(tmp_path, "")
    file.write_bytes(b"\xff\xfe\x00name")
    with pytest.raises(ModelError, match="not valid TOML"):
        read_manifest(file)


@pytest.mark.parametrize("table", ["limits", "joints"])
def test_a_joint_that_is_not_there_is_refused_when_loaded(table: str, tmp_path: Path) -> None:
    key = "v" if table == "limits" else "viscous"
    file = manifest_file(tmp_path, HEAD + f"[{table}.jj]\n{key} = 1")
    with pytest.raises(ModelError, match="Did you mean 'j'"):
        load_robot(file)


def test_a_tool_that_is_not_there_is_refused_when_loaded(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="Did you mean 'arm'"):
        load_robot(manifest_file(tmp_path, HEAD + "tool = 'arms'"))


def test_terms_that_replace_those_of_the_model_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.urdf").write_text(
        '<robot name="a"><link name="b"/><link name="l"><inertial><mass value="1"/><inertia ixx="1"'
        ' iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j" type='
        '"continuous"><parent link="b"/><child link="l"/><axis xyz="0 0 1"/><dynamics damping="2" '
        'friction="3"/></joint></robot>'
    )
    terms = "[joints.all]\nviscous = 5\n[joints.j]\nviscous = 7.5\ncoulomb = 3"
    (tmp_path / "robot.toml").write_text(f'name = "a"\nfile = "a.urdf"\n{terms}')
    robot = load_robot(find_manifest(str(tmp_path)))
    assert robot.joint_terms.viscous[0] == 7.5
    assert robot.repairs == (
        "damping of a.urdf replaced by the viscous of robot.toml: j 7.5 (file: 2)",
    )


def test_what_a_manifest_says_reaches_the_robot(tmp_path: Path) -> None:
    text = """
    tool = "arm"
    gravity = [1, 2, 3]
    terms = ["viscous", "spring"]
    [limits.all]
    v = 0.5
    [limits.j]
    q = [-0.5, 0.25]
    a = 7
    tau = 4
    [joints.all]
    viscous = 0.1
    coulomb = 0.2
    [joints.j]
    coulomb = 0.3
    offset = 0.4
    armature = 0.5
    spring = 0.6
    spring_reference = 0.7
    """
    robot = load_robot(manifest_file(tmp_path, HEAD + text))
    limits, terms = robot.limits, robot.joint_terms
    assert robot.tree.gravity.tolist() == [1, 2, 3]
    assert (limits.q_low[0], limits.q_high[0]) == (-0.5, 0.25)
    assert (limits.v[0], limits.a[0], limits.tau[0]) == (0.5, 7, 4)
    assert robot.manifest.terms == ("viscous", "spring")
    assert [terms.viscous[0], terms.coulomb[0], terms.offset[0]] == [0.1, 0.3, 0.4]
    assert [terms.armature[0], terms.spring[0], terms.spring_reference[0]] == [0.5, 0.6, 0.7]


def test_every_way_to_name_a_robot_finds_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "robots" / "own"
    own.mkdir(parents=True)
    file = manifest_file(own, HEAD)
    monkeypatch.chdir(tmp_path)
    ways = ["own", "robots/own", "robots/own/robot.toml", "file:robots/own/robot.toml", str(file)]
    assert {find_manifest(way).path.resolve() for way in ways} == {own / "r.urdf"}
    bare = ["robots/own/r.urdf", "file:robots/own/r.urdf", str(own / "r.urdf")]
    assert {find_manifest(way).path.resolve() for way in bare} == {own / "r.urdf"}
    assert {find_manifest(way).name for way in bare} == {"r"}
    assert find_manifest("r.urdf", folder=own).path == own / "r.urdf"
    monkeypatch.chdir(own)
    assert find_manifest("own", robots_dir=tmp_path / "robots").path == own / "r.urdf"


@pytest.mark.parametrize("name", ["", "robots", "."])
def test_names_that_resemble_none_list_eight_robots(name: str) -> None:
    known = package_folders.robots()
    with pytest.raises(UsageError) as refusal:
        find_manifest(name)
    found = re.search(rf"There are ([\w, ]+) and {len(known) - 8} more", str(refusal.value))
    assert found is not None
    listed = found[1].split(", ")
    assert listed == sorted(known)[:8]
    assert "sysid-bench list robots" in str(refusal.value)


@pytest.mark.parametrize("name", ["ur55", "pandas"])
def test_unknown_names_list_the_nearest_eight(name: str) -> None:
    known = package_folders.robots()
    with pytest.raises(UsageError) as refusal:
        find_manifest(name)
    found = re.search(rf"The nearest of {len(known)}: ([\w, ]+)\.", str(refusal.value))
    assert found is not None
    listed = found[1].split(", ")
    assert len(set(listed)) == 8
    assert set(listed) <= set(known)


@pytest.mark.parametrize("name", ["no/such.urdf", "absent.xml", "file:x"])
def test_absent_files_list_the_named_robots(name: str) -> None:
    with pytest.raises(UsageError) as refusal:
        find_manifest(name)
    assert "panda" in str(refusal.value)


def test_the_nearest_robot_is_offered() -> None:
    with pytest.raises(UsageError, match="Did you mean 'ur5'"):
        find_manifest("ur55")


@pytest.mark.parametrize(
    "text", ["", "hello", "<a/>", "<robot/>", "<mujoco/>", "<robot><link/></robot>"]
)
@pytest.mark.parametrize("suffix", [".urdf", ".xml", ".mjcf"])
def test_a_file_that_holds_no_robot_is_refused(text: str, suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"r{suffix}"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ModelError) as refusal:
        load_robot(file)
    assert file.name in str(refusal.value)


def test_a_file_of_another_kind_is_no_crash(tmp_path: Path) -> None:
    file = tmp_path / "r.urdf"
    file.write_bytes(bytes(range(256)))
    with pytest.raises(SysidBenchError):
        load_robot(file)


OTHERS = ("path", "manifest_file", "dh", "paper")
"""Fields that belong to the original file."""


@pytest.mark.parametrize("name", NAMED)
def test_a_written_manifest_reads_back_as_given(name: str, tmp_path: Path) -> None:
    terms = JointTerms(viscous=0.1 + 0.2, offset=-1e-3, spring=-2.0, viscous_coupling={"b": 0.5})
    manifest = replace(
        find_manifest(name), joints={"a": terms}, locked={"c": 0.25}, massless=("d",),
        gravity=(0.0, 9.81, 0.0), couplings=False, assets=tmp_path,
    )  # fmt: skip
    (tmp_path / "model.xml").write_text("<mujoco/>")
    file = tmp_path / "robot.toml"
    file.write_text(manifest_text(manifest, "model.xml"))
    again = read_manifest(file)
    for field in fields(manifest):
        if field.name not in OTHERS:
            assert getattr(again, field.name) == getattr(manifest, field.name), field.name
    assert again.path == tmp_path / "model.xml"
