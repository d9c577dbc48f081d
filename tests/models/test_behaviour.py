"""Laws of a robot in a baseline: an edit that matters is named, a harmless one is not seen."""

import json
import random
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench import package_folders
from sysid_bench.harness.comparison.baseline import baseline_of, from_text, to_text, update_of
from sysid_bench.harness.comparison.run_difference import RunDifference, find_difference
from sysid_bench.harness.comparison.run_values import CellValues, RunValues
from sysid_bench.metrics import METRICS
from sysid_bench.models.behaviour import behaviour_of, model_hash
from sysid_bench.models.behaviour_change import TORQUE, Behaviour, behaviour_changes
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.model_record import model_record
from tests.robots import robot_of

ROBOTS = (
    *("ur_description/urdf/ur5_robot", "panda_description/urdf/panda"),
    *("xarm_description/urdf/xarm7", "z1_description/urdf/z1", "so_arm_description/urdf/so100"),
    *("kinova_description/robots/kinova", "ur_description/urdf/ur3_robot"),
    *("ur_description/urdf/ur10_robot", "go2_description/urdf/go2", "b1_description/urdf/b1-z1"),
    *("so_arm_description/urdf/so101", "baxter_description/urdf/baxter"),
    *("bolt_description/robots/bolt", "talos_data/robots/talos_left_arm"),
    *("solo_description/robots/solo12", "allegro_hand_description/urdf/allegro_left_hand"),
    *("go1_description/urdf/go1", "double_pendulum_description/urdf/double_pendulum"),
    *("hyq_description/robots/hyq_no_sensors", "finger_edu_description/robots/finger_edu"),
)
SIZES = [
    pytest.param(ROBOTS[:3], id="three robots"),
    pytest.param(ROBOTS, id="twenty robots", marks=pytest.mark.long),
]


@dataclass
class Robot:
    """A folder with model.urdf and robot.toml, and a joint of it that is edited."""

    folder: Path
    rng: random.Random

    @classmethod
    def of(cls, name: str, folder: Path) -> "Robot":
        """A copy of a robot of the collection, its meshes left out; with gears and damping."""
        tree = ET.parse(package_folders.robot_data_folder() / f"{name}.urdf").getroot()
        for joint in tree.findall("joint"):
            if joint.get("type") in ("revolute", "continuous", "prismatic"):
                part = ET.SubElement(tree, "transmission")
                ET.SubElement(part, "joint", name=joint.get("name", ""))
                actuator = ET.SubElement(part, "actuator", name=f"motor of {joint.get('name')}")
                ET.SubElement(actuator, "mechanicalReduction").text = "100"
                if joint.find("dynamics") is None:
                    ET.SubElement(joint, "dynamics", damping="0.5", friction="0.2")
        folder.mkdir(parents=True)
        robot = cls(folder, random.Random(name))
        robot.write(tree)
        robot.keys()
        return robot

    @property
    def tree(self) -> ET.Element:
        return ET.parse(self.folder / "model.urdf").getroot()

    def write(self, tree: ET.Element) -> None:
        (self.folder / "model.urdf").write_text(ET.tostring(tree, encoding="unicode"))

    def keys(self, more: str = "") -> None:
        (self.folder / "robot.toml").write_text(f'name = "r"\nfile = "model.urdf"\n{more}\n')

    def joint(self, tree: ET.Element) -> ET.Element:
        """A moving joint whose child has mass, and which has a range."""
        masses = {
            link.get("name"): link.find("inertial/mass") is not None
            for link in tree.findall("link")
        }
        return self.rng.choice([
            joint
            for joint in tree.findall("joint")
            if joint.get("type") in ("revolute", "prismatic")
            and joint.find("mimic") is None
            and masses[self.child(joint)]
        ])  # fmt: skip

    @staticmethod
    def child(joint: ET.Element) -> str:
        element = joint.find("child")
        assert element is not None
        return element.get("link", "")

    def behaviour(self) -> Behaviour:
        return behaviour_of(load_robot(find_manifest(str(self.folder))))

    def hash(self) -> str:
        model = load_robot(find_manifest(str(self.folder)))
        return model_hash(model, behaviour_of(model))


Edit = Callable[[Robot], tuple[str, str]]
"""Changes a robot; returns the joint ("" for the robot) and a word of the quantity to be named."""


def _moved(text: str, place: int, factor: float = 1.02, more: float = 0.013) -> str:
    numbers = [float(number) for number in text.split()]
    numbers[place] = numbers[place] * factor + more
    return " ".join(map(repr, numbers))


def _element(joint: ET.Element, tag: str, **default: str) -> ET.Element:
    found = joint.find(tag)
    return ET.SubElement(joint, tag, default) if found is None else found


def _axis(robot: Robot) -> tuple[str, str]:
    tree = robot.tree
    joint = robot.joint(tree)
    axis = _element(joint, "axis", xyz="1 0 0")
    axis.set("xyz", " ".join(repr(-float(x)) for x in axis.get("xyz", "").split()))
    robot.write(tree)
    return joint.get("name", ""), "axis"


def _origin(robot: Robot) -> tuple[str, str]:
    tree = robot.tree
    joint = robot.joint(tree)
    origin = _element(joint, "origin")
    origin.set("xyz", _moved(origin.get("xyz", "0 0 0"), robot.rng.randrange(3), more=1e-3))
    robot.write(tree)
    return joint.get("name", ""), "origin"


def _range(robot: Robot) -> tuple[str, str]:
    tree = robot.tree
    joint = robot.joint(tree)
    limit = _element(joint, "limit", lower="-1", upper="1", effort="1", velocity="1")
    limit.set("upper", _moved(limit.get("upper", "0"), 0))
    robot.write(tree)
    return joint.get("name", ""), "range"


def _of_link(tag: str, key: str, quantity: str) -> Edit:
    def edit(robot: Robot) -> tuple[str, str]:
        tree = robot.tree
        joint = robot.joint(tree)
        part = tree.find(f"link[@name='{robot.child(joint)}']/inertial/{tag}")
        assert part is not None
        part.set(key, repr(float(part.get(key, "0")) * 1.02 + 1e-5))
        robot.write(tree)
        return joint.get("name", ""), quantity

    return edit


def _of_joint(tag: str, key: str, quantity: str, factor: float) -> Edit:
    def edit(robot: Robot) -> tuple[str, str]:
        tree = robot.tree
        joint = robot.joint(tree)
        part = _element(joint, tag, lower="-1", upper="1", velocity="1")
        part.set(key, repr(float(part.get(key, "0")) * factor + 0.1))
        robot.write(tree)
        return joint.get("name", ""), quantity

    return edit


def _gravity(robot: Robot) -> tuple[str, str]:
    robot.keys("gravity = [0, 0, -3.7]")
    return "", "gravity"


def _name(robot: Robot) -> tuple[str, str]:
    tree = robot.tree
    joint = robot.joint(tree)
    name = joint.get("name", "")
    joint.set("name", f"{name}_b")
    robot.write(tree)
    return name, "kind"


def _order(robot: Robot) -> tuple[str, str]:
    """The names of two joints are exchanged: rows of arrays mean another joint."""
    tree = robot.tree
    joints = [joint for joint in tree.findall("joint") if joint.get("type") == "revolute"]
    place = robot.rng.randrange(len(joints) - 1)
    one, other = joints[place], joints[place + 1]
    name = one.get("name", "")
    one.set("name", other.get("name", ""))
    other.set("name", name)
    robot.write(tree)
    return "", "order of joints"


def _tool(robot: Robot) -> tuple[str, str]:
    model = load_robot(find_manifest(str(robot.folder)))
    other = (model.tool_body + 1) % len(model.body_names)
    robot.keys(f'tool = "{model.body_names[other]}"')
    return "", f"tool frame in {model.body_names[other]}"


def _gear(robot: Robot) -> tuple[str, str]:
    tree = robot.tree
    joint = robot.joint(tree)
    parts = tree.findall("transmission")
    mine = [p for p in parts if any(j.get("name") == joint.get("name") for j in p.iter("joint"))]
    for ratio in (ratio for part in mine for ratio in part.iter("mechanicalReduction")):
        ratio.text = "-101"
    robot.write(tree)
    return joint.get("name", ""), "gear"


EDITS: dict[str, Edit] = {
    "axis": _axis,
    "origin": _origin,
    "range": _range,
    "mass": _of_link("mass", "value", "mass"),
    "inertia": _of_link("inertia", "izz", "inertia"),
    "damping": _of_joint("dynamics", "damping", "viscous friction", 100.0),
    "effort": _of_joint("limit", "effort", "effort limit", 1.1),
    "gravity": _gravity,
    "joint name": _name,
    "joint order": _order,
    "tool frame": _tool,
    "gear": _gear,
}


def baseline_with(models: dict[str, Behaviour]) -> RunValues:
    """A run of one cell for each robot."""
    cells = {robot: CellValues(robot, (), "ok", (1.0,)) for robot in models}
    return RunValues("s", (), {"rank": METRICS["rank"]}, cells, {}, {}, models=models)


def gated(before: dict[str, Behaviour], after: dict[str, Behaviour]) -> RunDifference:
    """The comparison of a run with the baseline of another, through its file."""
    known = from_text(to_text(baseline_of(baseline_with(before))), "b.json")
    return find_difference(known.run, baseline_with(after), known.tolerances)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Robot, Behaviour]]:
    """The copy of a robot with its behaviour, made once."""
    folder, known = tmp_path_factory.mktemp("robots"), dict[str, tuple[Robot, Behaviour]]()

    def make(name: str) -> tuple[Robot, Behaviour]:
        if name not in known:
            robot = Robot.of(name, folder / name.replace("/", "-"))
            known[name] = robot, robot.behaviour()
        return known[name]

    return make


Made = Callable[[str], tuple[Robot, Behaviour]]


def edited(robot: Robot, edit: Callable[[Robot], object], folder: Path) -> tuple[Robot, object]:
    """A copy of a robot with an edit."""
    folder.mkdir(parents=True)
    for file in ("model.urdf", "robot.toml"):
        (folder / file).write_bytes((robot.folder / file).read_bytes())
    copy = replace(robot, folder=folder)
    return copy, edit(copy)


@pytest.mark.parametrize("robots", SIZES)
@pytest.mark.parametrize("name", EDITS)
def test_an_edit_that_matters_is_named_by_joint(
    robots: tuple[str, ...], name: str, made: Made, tmp_path: Path
) -> None:
    models = {robot: made(robot)[1] for robot in robots}
    for number, source in enumerate(robots):
        copy, answer = edited(made(source)[0], EDITS[name], tmp_path / str(number))
        found = gated(models, {**models, source: copy.behaviour()})
        assert found.is_failed
        assert {change.robot for change in found.models} == {source}
        causes = [(c.joint, c.quantity) for c in found.models if c.quantity != TORQUE]
        assert answer in causes, source
        assert copy.hash() != made(source)[0].hash(), source
        if name in ("axis", "range", "inertia", "damping", "effort", "gear", "gravity"):
            assert causes == [answer], source  # nothing else is accused
        # The update takes it over, and the same run then keeps the baseline.
        taken = update_of(found)
        assert taken.counts == {"quantities of robots": len(found.models)}
        assert not gated(dict(taken.run.models), {**models, source: copy.behaviour()}).is_failed


def _text(change: Callable[[str], str]) -> Callable[[Robot], None]:
    def edit(robot: Robot) -> None:
        file = robot.folder / "model.urdf"
        file.write_text(change(file.read_text()))

    return edit


def _elements(change: Callable[[ET.Element, random.Random], None]) -> Callable[[Robot], None]:
    def edit(robot: Robot) -> None:
        tree = robot.tree
        change(tree, robot.rng)
        robot.write(tree)

    return edit


def _shuffle_parts(tree: ET.Element, rng: random.Random) -> None:
    for part in (*tree.findall("link"), *tree.findall("joint")):
        children = list(part)
        rng.shuffle(children)
        part[:] = children


def _shuffle_attributes(tree: ET.Element, rng: random.Random) -> None:
    for part in tree.iter():
        keys = list(part.attrib.items())
        rng.shuffle(keys)
        part.attrib.clear()
        part.attrib.update(keys)


def _links_last(tree: ET.Element, rng: random.Random) -> None:
    tree[:] = [*(e for e in tree if e.tag != "link"), *reversed(tree.findall("link"))]


def _set_all(path: str, key: str, value: str) -> Callable[[Robot], None]:
    def change(tree: ET.Element, rng: random.Random) -> None:
        for element in tree.findall(path):
            element.set(key, value)

    return _elements(change)


def _remove_all(tag: str) -> Callable[[Robot], None]:
    def change(tree: ET.Element, rng: random.Random) -> None:
        for link in tree.findall("link"):
            for element in link.findall(tag):
                link.remove(element)

    return _elements(change)


def _add(text: str, path: str = ".") -> Callable[[Robot], None]:
    def change(tree: ET.Element, rng: random.Random) -> None:
        for element in tree.findall(path):
            element.append(ET.fromstring(text))

    return _elements(change)


VISUAL = '<visual name="new"><geometry><sphere radius="0.3"/></geometry></visual>'
NUMBER = re.compile(r'(?<=")-?\d+\.\d+(?=")')
HARMLESS: dict[str, Callable[[Robot], object]] = {
    "comments": _text(lambda text: text.replace("<link", "<!-- mass: 3 kg --><link")),
    "comment in front": _text(lambda text: f"<!-- one -->\n{text}"),
    "blank lines": _text(lambda text: text.replace("><", ">\n\n  <")),
    "no blanks": _text(lambda text: re.sub(r">\s+<", "><", text)),
    "line ends": _text(lambda text: text.replace("\n", "\r\n")),
    "tabs": _text(lambda text: text.replace("    ", "\t")),
    "quotes": _text(lambda text: text.replace('"', "'")),
    "declaration": _text(lambda text: f'<?xml version="1.0" encoding="UTF-8"?>\n{text}'),
    "digits": _text(lambda text: NUMBER.sub(lambda m: f"{m[0]}00", text)),
    "exponents": _text(lambda text: NUMBER.sub(lambda m: repr(float(m[0])) + "e0"
                       if "e" not in repr(float(m[0])) else m[0], text)),
    "elements in another order": _elements(_shuffle_parts),
    "attributes in another order": _elements(_shuffle_attributes),
    "links after joints": _elements(_links_last),
    "mesh paths": _set_all(".//mesh", "filename", "package://elsewhere/other.dae"),
    "colours": _set_all(".//color", "rgba", "0.1 0.2 0.3 1"),
    "name of a material": _set_all(".//material", "name", "steel"),
    "another material": _add('<material name="x"><color rgba="1 0 0 1"/></material>'),
    "no visual geometry": _remove_all("visual"),
    "visual geometry": _add(VISUAL, "link"),
    "extension of a simulator": _add('<gazebo reference="x"><mu1>0.2</mu1></gazebo>'),
}  # fmt: skip


def test_there_are_twenty_harmless_edits() -> None:
    assert len(HARMLESS) == 20
    assert len(EDITS) == 12
    assert len(set(ROBOTS)) == 20


@pytest.mark.parametrize("robots", SIZES)
@pytest.mark.parametrize("name", HARMLESS)
def test_a_harmless_edit_changes_nothing(
    robots: tuple[str, ...], name: str, made: Made, tmp_path: Path
) -> None:
    """Neither what a gate sees, nor the hash by which ids know the model."""
    models = {robot: made(robot)[1] for robot in robots}
    after = dict(models)
    for number, source in enumerate(robots):
        robot = made(source)[0]
        copy, _ = edited(robot, HARMLESS[name], tmp_path / str(number))
        model = load_robot(find_manifest(str(copy.folder)))
        after[source] = behaviour_of(model)
        before = load_robot(find_manifest(str(robot.folder)))
        assert model_hash(model, after[source]) == model_hash(before, models[source]), source
    found = gated(models, after)
    assert not found.models
    assert not found.is_failed


ARM = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
 <body name="upper"><joint name="j1" axis="0 0 1" range="-2 2" damping="0.1"/>
  <inertial mass="3" pos="0.1 0 0" diaginertia="0.02 0.03 0.03"/>
  <body name="fore" pos="0.3 0 0"><joint name="j2" axis="0 1 0" range="-2 2"/>
   <inertial mass="1.5" pos="0.1 0 0.02" diaginertia="0.01 0.02 0.02"/>
   <site name="tcp" pos="0 0 1"/>
   <geom type="box" size=".1 .2 .3" contype="0" conaffinity="0" rgba="1 0 0 1"/>
  </body></body></worldbody>
  <actuator><motor joint="j1" gear="50" forcerange="-3 3"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("old", "new", "joint", "quantity"),
    [
        ('gear="50"', 'gear="-50"', "j1", "gear"),
        ('forcerange="-3 3"', 'forcerange="-2 3"', "j1", "gear"),
        ("<worldbody>", '<option gravity="0 0 -3.7"/><worldbody>', "", "gravity"),
        ('damping="0.1"', 'damping="10"', "j1", "viscous friction"),
        ('pos="0 0 1"', 'pos="0 0 1.001"', "", "tool frame in fore"),
        ('axis="0 1 0"', 'axis="0 -1 0"', "j2", "axis"),
        ('axis="0 1 0"', 'axis="0 1 0" ref="0.1"', "j2", "reference"),
        ('rgba="1 0 0 1"', 'rgba="0 1 0 1"', None, ""),
        ('size=".1 .2 .3"', 'size=".2 .2 .3"', None, ""),
        ('name="upper"', 'name="upper" childclass="main"', None, ""),
    ],
)
def test_edits_of_an_mjcf(
    old: str, new: str, joint: str | None, quantity: str, tmp_path: Path
) -> None:
    found = []
    for number, text in enumerate((ARM, ARM.replace(old, new))):
        file = tmp_path / f"{number}.xml"
        file.write_text(text)
        record = model_record(f"{file}?tool=tcp", None, None)
        assert record is not None
        found.append(record)
    before, after = found
    changes = gated({"r": before["behaviour"]}, {"r": after["behaviour"]}).models
    causes = [(change.joint, change.quantity) for change in changes if change.quantity != TORQUE]
    assert causes == ([] if joint is None else [(joint, quantity)])
    assert (before["hash"] == after["hash"]) == (joint is None)


def test_a_hash_has_sixteen_digits_and_follows_from_the_rest_without_torques() -> None:
    robot = robot_of(ARM)
    found = behaviour_of(robot)
    other = {joint: {**part, TORQUE: [1.0] * 5} for joint, part in found.items()}
    assert model_hash(robot, found) == model_hash(robot, other)
    assert re.fullmatch("[0-9a-f]{16}", model_hash(robot, found))


@pytest.mark.parametrize("solid", [*product((0, 1), (0, 1), ("sphere", "box"))])
def test_shapes_count_where_they_can_touch_by_one_side(solid: tuple[int, int, str]) -> None:
    """Whether contacts are looked for by their type, by their affinity, or by both."""
    text = ARM.replace('type="box"', f'type="{solid[2]}"').replace(
        'contype="0" conaffinity="0"', f'contype="{solid[0]}" conaffinity="{solid[1]}"'
    )
    hashes = set()
    for size in (".1 .2 .3", ".2 .2 .3"):
        robot = robot_of(text.replace(".1 .2 .3", size))
        hashes.add(model_hash(robot, behaviour_of(robot)))
    assert len(hashes) == 1 + any(solid[:2])


@pytest.mark.parametrize(
    ("equality", "name"),
    [
        ('<joint joint1="j1" joint2="j2" polycoef="0 1 0 0 0"/>', "coupling joint j1 j2"),
        ('<joint joint1="j2" polycoef="0 0 0 0 0"/>', "coupling joint j2 world"),
    ],
)
def test_a_coupling_is_named_by_its_ends(equality: str, name: str) -> None:
    text = ARM.replace("<actuator>", f"<equality>{equality}</equality><actuator>")
    moved = text.replace('polycoef="0 ', 'polycoef="0.1 ')
    one, other = (behaviour_of(robot_of(t)) for t in (text, moved))
    assert name in one[""]
    assert [(c.joint, c.quantity) for c in behaviour_changes("r", one, other)] == [("", name)]


def test_torques_are_those_of_the_equations_of_motion() -> None:
    """Of a pendulum: m l^2 a + m g l sin q, at five different states."""
    text = """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/>
      <inertial mass="2" pos="0 0 -0.5" diaginertia="1e-9 1e-9 1e-9"/>
    </body></worldbody></mujoco>"""
    heavy, light = (robot_of(text.replace("<worldbody>", f'<option gravity="0 0 {g}"/><worldbody>'))
                    for g in (-9.81, 0.0))  # fmt: skip
    with_gravity, without = (np.array(behaviour_of(r)["j"][TORQUE]) for r in (heavy, light))
    a, sine = without / (2 * 0.25), (with_gravity - without) / (2 * 9.81 * 0.5)
    assert len(set(np.round(a, 6))) == 5
    assert np.abs(a).max() <= 3.0
    assert np.abs(np.arcsin(sine)).max() <= 1.5
    assert np.abs(np.diff(sine)).min() > 1e-3


PENDULUM = """<mujoco><worldbody><body><joint name="j" type="{kind}" axis="0 1 0"/>
  <inertial mass="{mass!r}" pos="0 0 {place!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize("seed", range(12))
def test_a_robot_of_any_size_has_nine_digits(seed: int) -> None:
    """From a finger to an excavator: neither fewer digits, nor the last bits of a processor."""
    rng = np.random.default_rng(seed)
    mass, place = 10.0 ** rng.uniform(-5, 5), 10.0 ** rng.uniform(-3, 1)
    inertia = mass * place**2 * rng.uniform(0.1, 1.0)
    for kind in ("hinge", "slide"):
        text = PENDULUM.format(kind=kind, mass=mass, place=place, inertia=inertia)
        found = behaviour_of(robot_of(text))["j"]
        for quantity, wanted in (
            ("mass", [mass]), ("first moment of mass", [0, 0, mass * place]),
            ("inertia", [inertia + mass * place**2, 0, 0, inertia + mass * place**2, 0, inertia]),
        ):  # fmt: skip
            size = max(map(abs, wanted))
            assert found[quantity] == pytest.approx(wanted, abs=5e-9 * size)
            assert all(float(f"{x:.9g}") == x for x in found[quantity])
        heavier = behaviour_of(robot_of(text.replace(repr(mass), repr(mass * (1 + 1e-13)))))
        assert heavier["j"] == found


@pytest.mark.parametrize("name", ROBOTS[:6])
def test_numbers_of_a_list_are_multiples_of_one_step(name: str, made: Made) -> None:
    """The ninth digit of the largest: what is smaller has the rounding errors of that."""
    robot, behaviour = made(name)
    joints = load_robot(find_manifest(str(robot.folder))).joints
    assert behaviour[""]["order of joints"] == [joint.name for joint in joints]
    for joint, quantities in behaviour.items():
        for quantity, values in quantities.items():
            assert "-0.0" not in map(str, values)
            numbers = [Decimal(repr(x)) for x in values if isinstance(x, float)]
            if largest := max(map(abs, numbers), default=Decimal()):
                step = Decimal(1).scaleb(largest.adjusted() - 8)
                assert all(number % step == 0 for number in numbers), (joint, quantity)


def test_angles_stay_within_a_radian_and_a_half() -> None:
    """Under gravity along x and along z a pendulum's torque gives cosine and sine of its angle."""
    angles = []
    for name in "abcdefgh":
        parts = []
        for gravity in ("0 0 0", "0 0 -9.81", "9.81 0 0"):
            text = PENDULUM.format(kind="hinge", mass=2.0, place=-0.5, inertia=0.1)
            text = text.replace('name="j"', f'name="{name}"').replace(
                "<worldbody>", f'<option gravity="{gravity}"/><worldbody>'
            )
            parts.append(np.array(behaviour_of(robot_of(text))[name][TORQUE]))
        angles += [*np.arctan2(parts[1] - parts[0], parts[2] - parts[0])]
    assert 1.35 < np.abs(angles).max() <= 1.5 + 1e-6


@pytest.mark.parametrize("seed", range(6))
def test_numbers_are_zero_beside_the_largest_of_their_kind(seed: int) -> None:
    """Below 1e-12 of it, wherever it is; above they have their digits."""
    rng = np.random.default_rng(seed)
    large = 10.0 ** rng.uniform(-3, 3)
    for share, is_kept in (
        (10.0 ** rng.uniform(-11.9, -1), True),
        (10.0 ** -rng.uniform(12.1, 14), False),
    ):
        text = ARM.replace('damping="0.1"', f'damping="{large!r}"').replace(
            'name="j2"', f'name="j2" damping="{share * large!r}"'
        )
        found = behaviour_of(robot_of(text))
        small = found["j2"]["viscous friction"]
        assert small == (pytest.approx([share * large], rel=1e-8) if is_kept else [0.0])
        assert found["j1"]["viscous friction"] == pytest.approx([large], rel=1e-8)


@pytest.mark.parametrize(("kind", "reach"), [("hinge", 3.0), ("slide", 1.0)])
def test_states_reach_as_far_as_gravity(kind: str, reach: float) -> None:
    """Over many joints: accelerations fill their range, and no more."""
    found = []
    for name in "abcdefgh":
        text = PENDULUM.format(kind=kind, mass=1.0, place=0.0, inertia=1.0)
        text = text.replace('name="j"', f'name="{name}"').replace(
            "<worldbody>", '<option gravity="0 0 0"/><worldbody>'
        )
        found += behaviour_of(robot_of(text))[name][TORQUE]  # = a of unit inertia
    assert len(set(found)) == 8 * 5
    assert 0.9 * reach < np.abs(found).max() <= reach
    assert np.abs(np.mean(found)) < 0.3 * reach


def test_rates_are_as_large_as_accelerations() -> None:
    """Of a mass m = 1 on a slide (r = 1 + q) on a hinge: r^2 a + 2 r v w and b - r v^2."""
    text = """<mujoco><option gravity="0 0 0"/><worldbody><body>
      <joint name="{name}" axis="0 0 1"/><joint name="s{name}" type="slide" axis="1 0 0"/>
      <inertial mass="1" pos="1 0 0" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>"""
    torques, forces = [], []
    for name in "abcdefgh":
        found = behaviour_of(robot_of(text.format(name=name)))
        torques += found[name][TORQUE]
        forces += found[f"s{name}"][TORQUE]
    assert 3.0 < np.abs(torques).max() <= 1.2**2 * 3.0 + 2 * 1.2 * 2.0 * 0.5
    assert -1.2 * 2.0**2 - 1.0 <= np.min(forces) < -2.5
    assert 0.5 < np.max(forces) <= 1.0


def test_states_turn_balls_and_move_bases() -> None:
    """In a turned body its weight has another moment in each state, none about its own axis."""
    found = {}
    for kind, gravity in product(("ball", "free"), (0.0, -9.81)):
        text = PENDULUM.format(kind=kind, mass=2.0, place=-0.5, inertia=0.1).replace(
            "<worldbody>", f'<option gravity="0 0 {gravity}"/><worldbody>'
        )
        found[kind, gravity] = np.array(behaviour_of(robot_of(text))["j"][TORQUE]).reshape(5, -1)
    moment = found["ball", -9.81] - found["ball", 0.0]
    assert len(np.unique(moment.round(6), axis=0)) == 5
    assert np.abs(moment[:, 2]).max() < 1e-6
    assert 4.0 < np.linalg.norm(moment, axis=1).max() < 2.0 * 9.81 * 0.5 + 1e-6
    weight = found["free", -9.81] - found["free", 0.0]
    np.testing.assert_allclose(weight[:, :3], np.tile([0, 0, 2 * 9.81], (5, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(weight[:, 3:], axis=1) <= 9.81 + 1e-6, True)
    assert len(np.unique(found["free", 0.0].round(6), axis=0)) == 5


def _names_and_numbers(rng: np.random.Generator) -> dict[str, dict[str, list[Any]]]:
    """The behaviour of a robot: numbers of all sizes, infinities and names."""
    return {
        joint: {
            "inertia": [*(10.0 ** rng.uniform(-9, 9) * rng.normal(size=6))],
            "range": ["-inf", "inf", rng.normal(), 0.0],
            "kind": ["hinge"],
            TORQUE: [*rng.normal(size=5)],
        }
        for joint in ("", "j1", "j2", "j3")
    }


@pytest.mark.parametrize("seed", range(20))
def test_values_are_the_same_up_to_a_millionth_of_the_largest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = _names_and_numbers(rng)
    after = json.loads(json.dumps(before))
    for part in after.values():
        for quantity in ("inertia", TORQUE):
            size = max(map(abs, part[quantity]))
            part[quantity] = [x + 0.9e-6 * size * rng.uniform(-1, 1) for x in part[quantity]]
    assert behaviour_changes("r", before, after) == []
    joint, quantity = rng.choice([*before]), rng.choice(["inertia", TORQUE])
    numbers = after[joint][quantity]
    place = rng.integers(len(numbers))
    numbers[place] = before[joint][quantity][place] + rng.choice([-1, 1]) * 1.2e-6 * max(
        map(abs, before[joint][quantity])
    )
    for pair in ((before, after), (after, before)):
        (change,) = behaviour_changes("r", *pair)
        assert (change.robot, change.joint, change.quantity) == ("r", joint, quantity)
        assert (change.before, change.after) == tuple(one[joint][quantity] for one in pair)


@pytest.mark.parametrize("exponent", range(6, 12))
def test_a_millionth_itself_is_the_same(exponent: int) -> None:
    """The limit belongs to it, and no more."""
    size = 2.0 * 10.0**exponent
    for step, count in ((1e-6 * size, 0), (1.001e-6 * size, 1)):
        pair = ({"j": {"mass": [size]}}, {"j": {"mass": [size - step]}})
        for before, after in (pair, pair[::-1]):
            assert len(behaviour_changes("r", before, after)) == count


@pytest.mark.parametrize(
    ("quantity", "values"),
    [
        ("range", ["inf", "-inf", 1.0, 0.0]), ("range", ["-inf", 5.0, 1.0, 0.0]),
        ("range", ["-inf", "inf", 1.0]), ("range", None), ("kind", ["slide"]), ("gear", [2.0]),
        ("inertia", [0.0] * 6), ("kind", ["hinge", "hinge"]),
    ],
)  # fmt: skip
def test_what_is_another_list_is_a_change_and_causes_come_first(
    quantity: str, values: list[object] | None
) -> None:
    before = _names_and_numbers(np.random.default_rng(0))
    for part in before.values():
        part["range"] = ["-inf", "inf", 1.0, 0.0]
    after = {joint: dict(part) for joint, part in before.items()}
    after["j2"] |= {quantity: values or [], TORQUE: [9.0] * 5}
    if values is None:
        del after["j2"][quantity]
    for pair in ((before, after), (after, before)):
        changes = behaviour_changes("r", *pair)
        assert [(one.joint, one.quantity) for one in changes] == [("j2", quantity), ("j2", TORQUE)]
        assert changes[0].before == pair[0]["j2"].get(quantity)
        assert changes[0].after == pair[1]["j2"].get(quantity)


def test_a_record_is_kept_and_follows_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SYSID_BENCH_CACHE", str(tmp_path / "cache"))
    package_folders.cache_folder.cache_clear()
    file = tmp_path / "arm.xml"
    file.write_text(ARM)
    first = model_record("arm.xml", None, tmp_path)
    (kept,) = (tmp_path / "cache").glob("*.model")
    assert first == model_record("file:./arm.xml", None, tmp_path) == json.loads(kept.read_text())
    assert len([*(tmp_path / "cache").glob("*.model")]) == 1
    kept.write_text("{")
    assert model_record("arm.xml", None, tmp_path) == first
    file.write_text(ARM.replace('mass="3"', 'mass="3.1"'))
    other = model_record("arm.xml", None, tmp_path)
    assert first is not None
    assert other is not None
    assert other["hash"] != first["hash"]
    assert model_record("absent.xml", None, tmp_path) is None
    file.write_text("<mujoco/>")
    assert model_record("arm.xml", None, tmp_path) is None
    package_folders.cache_folder.cache_clear()
