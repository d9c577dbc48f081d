"""MJCF features, each against its long form, in both engines; meshes where inertia needs them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.errors import ModelError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.regression import regression
from tests.robots import relative_gap, robot_of, states

INERTIAL = '<inertial pos=".1 .02 .03" mass="2" diaginertia=".1 .2 .25"/>'
HALF = "0.7071067811865476"


def model(bodies: str, before: str = "", after: str = "") -> str:
    return f"<mujoco>{before}<worldbody>{bodies}</worldbody>{after}</mujoco>"


def hinge(joint: str = "<joint/>", inside: str = "", name: str = "") -> str:
    return f"<body {name}>{joint}{INERTIAL}{inside}</body>"


CLASSED = hinge('<joint class="d"/>')
SAME = {
    "default": (
        model(
            f'<body childclass="c"><joint/>{INERTIAL}{CLASSED}</body>',
            '<default><default class="c"><joint pos="0 .1 0" axis="1 1 0" armature=".3"/>'
            '<default class="d"><joint type="slide"/></default></default></default>',
        ),
        model(
            hinge(
                '<joint pos="0 .1 0" axis="1 1 0" armature=".3"/>',
                hinge('<joint type="slide" pos="0 .1 0" axis="1 1 0" armature=".3"/>'),
            )
        ),
    ),
    "frame": (
        model(f'<frame pos="0 1 0" quat="{HALF} {HALF} 0 0"><body pos="1 0 .5"><joint/>{INERTIAL}'
              "</body></frame>"),
        model(f'<body pos="1 .5 0" quat="{HALF} {HALF} 0 0"><joint/>{INERTIAL}</body>'),
    ),
    "degrees": (
        model(f'<body euler="90 0 0"><joint ref="90" range="-180 180"/>{INERTIAL}</body>'),
        model(
            f'<body quat="{HALF} {HALF} 0 0"><joint ref="1.5707963267948966" '
            f'range="-3.141592653589793 3.141592653589793"/>{INERTIAL}</body>',
            '<compiler angle="radian"/>',
        ),
    ),
    "gravity flag": (
        model(hinge(), '<option><flag gravity="disable"/></option>'),
        model(hinge(), '<option gravity="0 0 0"/>'),
    ),
    "settotalmass": (
        model(hinge(inside=hinge()), '<compiler settotalmass="1"/>'),
        model(hinge(inside=hinge()).replace(INERTIAL, scaled := INERTIAL.replace('mass="2"',
              'mass=".5"').replace(".1 .2 .25", ".025 .05 .0625"))),
    ),
    "balanceinertia": (
        model('<body><joint/><inertial pos="0 0 1" mass="1" diaginertia="1 1 4"/></body>',
              '<compiler balanceinertia="true"/>'),
        model('<body><joint/><inertial pos="0 0 1" mass="1" diaginertia="2 2 2"/></body>'),
    ),
    "boundmass": (
        model('<body><joint/><inertial pos="0 0 1" mass=".1" diaginertia="1 1 1"/></body>',
              '<compiler boundmass="3" boundinertia="2"/>'),
        model('<body><joint/><inertial pos="0 0 1" mass="3" diaginertia="2 2 2"/></body>'),
    ),
    "inertiafromgeom": (
        model(hinge(inside='<geom type="box" size=".1 .2 .3" pos=".1 0 0" mass="6"/>'),
              '<compiler inertiafromgeom="true"/>'),
        model('<body><joint/><inertial pos=".1 0 0" mass="6" diaginertia=".26 .2 .1"/></body>'),
    ),
    "geoms": (
        model('<body><joint/><geom type="box" size=".1 .2 .3" pos=".1 0 0" mass="6"/></body>'),
        model('<body><joint/><inertial pos=".1 0 0" mass="6" diaginertia=".26 .2 .1"/></body>'),
    ),
    "group that does not weigh": (
        model('<body><joint/><geom size=".1" mass="9" group="3"/><geom type="box" mass="6" '
              'size=".1 .2 .3" pos=".1 0 0"/></body>', '<compiler inertiagrouprange="0 2"/>'),
        model('<body><joint/><inertial pos=".1 0 0" mass="6" diaginertia=".26 .2 .1"/></body>'),
    ),
    "fullinertia": (
        model('<body><joint/><inertial pos="0 0 0" mass="1" fullinertia="2 2 3 1 0 0"/></body>'),
        model('<body><joint/><inertial pos="0 0 0" mass="1" diaginertia="3 1 3" '
              'quat="0.9238795325112867 0 0 0.3826834323650898"/></body>'),
    ),
    "replicate": (
        model(f'<replicate count="2" offset="1 0 0">{hinge()}</replicate>'),
        model(hinge() + hinge(name='pos="1 0 0"')),
    ),
    "keyframe, sensor, tuple, exclude, texture, hfield, skin": (
        model(
            hinge('<joint name="j"/>', name='name="a"', inside='<site name="s"/>')
            + '<geom type="hfield" hfield="h"/><geom name="g" size=".1" material="m"/>',
            '<asset><texture name="t" type="2d" file="absent.png"/><material name="m" texture="t"/>'
            '<hfield name="h" file="absent.png" size="1 1 1 1"/><skin file="absent.skn"/></asset>',
            '<keyframe><key qpos="1 2 3"/></keyframe><sensor><force site="s"/></sensor>'
            '<custom><tuple name="t"><element objtype="geom" objname="g"/></tuple></custom>'
            '<contact><exclude body1="a" body2="world"/></contact>'
            '<actuator><motor joint="j" gear="7"/></actuator>',
        ),
        model(hinge()),
    ),
    "mesh that only looks": (
        model(hinge(inside='<geom type="mesh" mesh="x"/>'),
              '<asset><mesh name="x" file="../../absent.stl"/></asset>'),
        model(hinge()),
    ),
    "mesh that weighs nothing": (
        model('<body><joint/><geom type="mesh" mesh="x" mass="0"/><geom type="box" mass="6" '
              'size=".1 .2 .3" pos=".1 0 0"/></body>', '<asset><mesh file="x.stl"/></asset>'),
        model('<body><joint/><inertial pos=".1 0 0" mass="6" diaginertia=".26 .2 .1"/></body>'),
    ),
    "fixed bodies stay": (
        model(hinge(inside=f'<body pos="0 0 1">{INERTIAL}</body>'),
              '<compiler fusestatic="true"/>'),
        model(hinge(inside=f'<body pos="0 0 1">{INERTIAL}</body>')),
    ),
}  # fmt: skip
"""A feature and its long form: the same robot."""


def same_robot(one: RobotModel, other: RobotModel) -> None:
    np.testing.assert_allclose(one.phi, other.phi, rtol=1e-12, atol=1e-13)
    motion = states(other, 5)
    Y = [regression(robot, robot.inertial_columns).dense(motion).Y for robot in (one, other)]
    assert relative_gap(*Y) <= 1e-12
    np.testing.assert_allclose(one.joint_terms.armature, other.joint_terms.armature)


def agrees(robot: RobotModel) -> None:
    check = crosscheck(robot, 8)
    assert check.ok(), check.reason()


@pytest.mark.parametrize("feature", SAME)
def test_a_feature_is_its_long_form(feature: str) -> None:
    short, long = (robot_of(text) for text in SAME[feature])
    same_robot(short, long)
    agrees(short)


KINDS = {
    "several, anchored": '<joint pos=".1 0 0" axis="1 2 3"/><joint type="slide" pos="0 1 0"/>',
    "z-x-z": '<joint axis="0 0 1"/><joint axis="1 0 0"/><joint axis="0 0 1"/>',
    "reference": '<joint ref="30" range="-60 90"/>',
    "ball": '<joint type="ball" pos=".1 .2 .3" damping="1"/>',
    "slide and ball": '<joint type="slide"/><joint type="ball"/>',
    "free": '<freejoint/>',
    "aligned free": '<freejoint align="true"/>',
    "planar": '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint/>',
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_mixture_of_joints_agrees(kind: str) -> None:
    child = hinge('<joint axis="1 1 0" pos="0 0 .1"/>') if kind != "aligned free" else ""
    welded = f'<body pos=".2 0 0" euler="10 20 30">{INERTIAL}{child}</body>'
    agrees(robot_of(model(hinge(KINDS[kind], welded), '<option gravity="1 2 -8"/>')))
    agrees(robot_of(model(hinge(KINDS[kind]) + f"<body>{INERTIAL}</body>" + hinge())))


@pytest.mark.parametrize("rules", ['settotalmass="1"', 'boundmass="30"', 'balanceinertia="true"',
                                   'inertiafromgeom="true"'])  # fmt: skip
def test_a_payload_is_no_part_of_rules_for_the_model(rules: str) -> None:
    """Mounted, a payload leaves the robot as it was and weighs what it weighs."""
    text = model(hinge(inside='<geom size=".1"/>'), f"<compiler {rules}/>")
    bare, loaded = robot_of(text), robot_of(text, PAYLOADS["box-2kg"])
    np.testing.assert_array_equal(loaded.phi[0], bare.phi[0])
    np.testing.assert_allclose(loaded.phi[1], PAYLOADS["box-2kg"].phi, atol=1e-12)


def tetrahedron(file: Path, scale: float = 0.3) -> None:
    """An STL of the corner of a cube: mass density s^3 / 6 at (1, 1, 1) s / 4."""
    corners = scale * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    triangles = [struct.pack("<12fH", 0, 0, 0, *corners[list(f)].ravel(), 0) for f in faces]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + b"".join(triangles))


MESHED = model(
    '<body name="arm"><joint/><geom type="mesh" mesh="part"/></body>',
    '<compiler meshdir="parts"/><asset><mesh name="part" file="corner.stl"/></asset>',
)


@pytest.mark.parametrize("strip", ["", ' strippath="true"'])
def test_a_mesh_that_is_there_gives_the_inertia(strip: str, tmp_path: Path) -> None:
    tetrahedron(tmp_path / "parts" / "corner.stl")
    text = MESHED.replace('meshdir="parts"', f'meshdir="parts"{strip}')
    (tmp_path / "r.xml").write_text(text.replace("corner.stl", "x/corner.stl") if strip else text)
    robot = load_robot(tmp_path / "r.xml")
    assert robot.repairs == ()
    assert robot.phi[0, 0] == pytest.approx(1000 * 0.3**3 / 6, rel=1e-5)
    assert robot.phi[0, 1:4] / robot.phi[0, 0] == pytest.approx([0.075] * 3, rel=1e-5)
    assert list(robot.spec.meshes) == []
    agrees(robot)


def test_an_inline_mesh_gives_the_inertia() -> None:
    vertices = ".3 0 0  0 .3 0  0 0 .3  0 0 0"
    mesh = f'<mesh name="part" vertex="{vertices}"/>'
    robot = robot_of(MESHED.replace('<mesh name="part" file="corner.stl"/>', mesh))
    assert robot.phi[0, 0] == pytest.approx(4.5, rel=1e-5)
    agrees(robot)


def test_a_missing_mesh_names_the_body_and_what_to_do() -> None:
    with pytest.raises(ModelError, match=r"arm: .*parts/corner\.stl.*<inertial>.*folder"):
        robot_of(MESHED)
    both = MESHED.replace('mesh="part"/>', 'mesh="part"/><geom size=".1"/>')
    (reported,) = robot_of(both).repairs
    assert reported.startswith("arm: inertia came from meshes")
    assert "<inertial>" in reported


def test_a_mesh_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "corner.stl").write_bytes(b"no mesh at all")
    (tmp_path / "r.xml").write_text(MESHED)
    with pytest.raises(ModelError, match=r"r\.xml"):
        load_robot(tmp_path / "r.xml")


@pytest.mark.parametrize("place", ["../corner.stl", "{}/corner.stl"])
def test_a_mesh_outside_of_the_folder_is_not_read(place: str, tmp_path: Path) -> None:
    tetrahedron(tmp_path / "corner.stl")
    (tmp_path / "model" / "parts").mkdir(parents=True)
    file = tmp_path / "model" / "r.xml"
    file.write_text(MESHED.replace("corner.stl", f"../{place}".format(tmp_path).removeprefix(
        "../" if place.startswith("{") else "")))  # fmt: skip
    with pytest.raises(ModelError, match="outside the model's folder"):
        load_robot(file)


def test_absent_meshes_name_a_few_bodies_and_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = '<body name="b{0}"><joint/><geom type="mesh" mesh="m{0}"/></body>'
    meshes = "".join(f'<mesh name="m{k}" file="m{k}.stl"/>' for k in range(9))
    bodies = "".join(body.format(k) for k in range(9))
    (tmp_path / "r.xml").write_text(model(bodies, f"<asset>{meshes}</asset>"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError) as refusal:
        load_robot(Path("r.xml"))
    message = str(refusal.value)
    assert "b0, b1, b2 and 6 more: inertia" in message
    assert "b3" not in message
    assert f"the folder {tmp_path.name!r}" in message


@pytest.mark.parametrize("integrator", ["Euler", "implicit"])
def test_inverse_dynamics_is_that_of_continuous_time(integrator: str) -> None:
    flag = f'<option integrator="{integrator}"><flag invdiscrete="enable"/></option>'
    check = crosscheck(robot_of(model(hinge('<joint damping="1"/>'), flag)), 8)
    assert check.ok(), check.reason()


def test_a_joint_held_still_by_its_damping_drowns_nothing() -> None:
    held = '<joint damping="1e11" stiffness="1e8" frictionloss="1e9"/>'
    robot = robot_of(model(hinge(held, hinge())))
    check = crosscheck(robot, 8)
    assert check.ok(), check.reason()
    assert robot.joint_terms.viscous[0] == 1e11
    with pytest.raises(ModelError, match="1e\\+13"):
        robot_of(model(hinge('<joint damping="1e14"/>')))


def test_two_degrees_of_freedom_of_one_name_are_refused() -> None:
    for inner in ('<joint name="root.vx"/>', '<joint name="root.wz" type="slide"/>'):
        with pytest.raises(ModelError, match=r"'root\.[vw].'.*rename"):
            robot_of(model(hinge("<freejoint/>", hinge(inner))))
    ball, hinged = '<joint name="b" type="ball"/>', hinge('<joint name="b.x"/>')
    with pytest.raises(ModelError, match=r"'b\.x'"):
        robot_of(model(hinge(ball, hinged)))


def test_a_part_is_no_model() -> None:
    with pytest.raises(ModelError, match="a part to be included"):
        robot_of(f"<mujocoinclude>{hinge()}</mujocoinclude>")
