"""Faults planted in copies of good models are found, and good models have no error."""

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.errors import UsageError
from sysid_bench.models.manifest import find_manifest

ROBOTS = Path(__file__).parents[2] / "robots"
PACKAGE = "example-robot-data:"
MODELS = {
    "ur5": f"{PACKAGE}ur_description/urdf/ur5_robot.urdf",
    "panda": f"{PACKAGE}panda_description/urdf/panda.urdf",
    "kinova": f"{PACKAGE}kinova_description/robots/kinova.urdf",
    "go2": f"{PACKAGE}go2_description/urdf/go2.urdf",
}
Change = Callable[[ET.Element], None]


def times(links: list[str], part: str, keys: str, factor: float) -> Change:
    """Multiply numbers of <inertial> by a factor; all links for []."""

    def change(robot: ET.Element) -> None:
        found = [link for link in robot.findall("link") if not links or link.get("name") in links]
        for element in [e for link in found for e in link.findall(f"inertial/{part}")]:
            for key in keys.split():
                element.set(key, str(factor * float(element.get(key, "0"))))

    return change


def written(path: str, **values: float | str) -> Change:
    """Write attributes of the elements at a path, of which the last one may be absent."""

    def change(robot: ET.Element) -> None:
        above, _, tag = path.rpartition("/")
        for parent in robot.findall(above):
            element = parent.find(tag)
            element = ET.SubElement(parent, tag) if element is None else element
            element.attrib.update({key: str(value) for key, value in values.items()})

    return change


def shifted(link: str, xyz: str) -> Change:
    return written(f"link[@name='{link}']/inertial/origin", xyz=xyz)


def moments(link: str, ixx: float, iyy: float, izz: float) -> Change:
    zeros = dict.fromkeys(("ixy", "ixz", "iyz"), 0.0)
    return written(f"link[@name='{link}']/inertial/inertia", ixx=ixx, iyy=iyy, izz=izz, **zeros)


def without_inertial(link: str) -> Change:
    def change(robot: ET.Element) -> None:
        found = robot.find(f"link[@name='{link}']")
        assert found is not None
        found.remove(found.find("inertial"))  # type: ignore[arg-type]

    return change


def all_links(mass: str, moment: str) -> Change:
    """The same numbers in every <inertial>."""

    def change(robot: ET.Element) -> None:
        written("link/inertial/mass", value=mass)(robot)
        values = dict.fromkeys(("ixx", "iyy", "izz"), moment)
        zeros = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        written("link/inertial/inertia", **values, **zeros)(robot)

    return change


def swapped(link: str, first: str, second: str) -> Change:
    """Exchange two moments of a link, as a wrong order of the diagonal does."""

    def change(robot: ET.Element) -> None:
        inertia = robot.find(f"link[@name='{link}']/inertial/inertia")
        assert inertia is not None
        values = inertia.get(first, "0"), inertia.get(second, "0")
        inertia.attrib.update({first: values[1], second: values[0]})

    return change


SIX = "ixx iyy izz ixy ixz iyz"
PLANTED: list[tuple[str, str, str, Change]] = [
    ("ur5", "mass", "", times([], "mass", "value", 1e3)),
    ("panda", "mass", "panda_link4", times(["panda_link4"], "mass", "value", 1e3)),
    ("kinova", "mass", "j2s6s200_link_2", times(["j2s6s200_link_2"], "mass", "value", 1e4)),
    ("go2", "mass", "FL_calf", times(["FL_calf"], "mass", "value", 1e4)),
    ("ur5", "moments", "forearm_link", times(["forearm_link"], "inertia", SIX, 1e6)),
    ("panda", "moments", "panda_link6", times(["panda_link6"], "inertia", SIX, 1e3)),
    ("go2", "moments", "FR_thigh", times([], "inertia", SIX, 1e6)),
    ("ur5", "impossible-inertia", "upper_arm_link", moments("upper_arm_link", 0.1, 0.1, 0.5)),
    ("panda", "impossible-inertia", "panda_link2", moments("panda_link2", -0.01, 0.02, 0.02)),
    ("kinova", "impossible-inertia", "j2s6s200_link_3",
     moments("j2s6s200_link_3", 0.001, 0.01, 0.001)),
    ("ur5", "moments", "upper_arm_link", moments("upper_arm_link", 0.12, 0.12, 0.2)),
    ("ur5", "centre-of-mass", "wrist_1_link", shifted("wrist_1_link", "0 2 0")),
    ("panda", "centre-of-mass", "panda_link3", shifted("panda_link3", "0 0 -90")),
    ("ur5", "missing-mass", "wrist_2_link", without_inertial("wrist_2_link")),
    ("go2", "missing-mass", "RL_calf", without_inertial("RL_calf")),
    ("kinova", "placeholder-inertia", "", all_links("1", "1")),
    ("panda", "placeholder-inertia", "", all_links("1", "0.01")),
    ("go2", "limbs", "RL_calf", times(["RL_calf"], "mass", "value", 1.2)),
    ("go2", "limbs", "FL_thigh", shifted("FL_thigh", "0.03 0.02 -0.02")),
    ("go2", "moments", "FR_calf", swapped("FR_calf", "ixx", "izz")),
    ("ur5", "load", "", times(["forearm_link"], "mass", "value", -1.0)),
    ("kinova", "load", "", shifted("j2s6s200_link_2", "0 nan 0")),
    ("panda", "load", "", all_links("0", "0")),
    ("ur5", "limits", "shoulder_pan_joint", written("joint/limit", effort="0")),
    ("kinova", "limits", "j2s6s200_joint_1", written("joint/limit", velocity="0")),
]  # fmt: skip


def findings(model: str) -> set[tuple[str, str]]:
    """(rule, element) of the findings of a model that are not notes."""
    found = sysid_bench.lint([model]).findings
    return {(entry["rule"], entry["element"]) for entry in found if entry["severity"] != "note"}


@pytest.fixture(scope="module")
def clean() -> dict[str, set[tuple[str, str]]]:
    return {name: findings(model) for name, model in MODELS.items()}


@pytest.mark.parametrize(
    ("robot", "rule", "element", "change"), PLANTED, ids=[f"{p[0]}-{p[1]}-{p[2]}" for p in PLANTED]
)
def test_a_planted_fault_is_found(
    clean: dict[str, set[tuple[str, str]]],
    tmp_path: Path, robot: str, rule: str, element: str, change: Change,
) -> None:  # fmt: skip
    tree = ET.parse(find_manifest(MODELS[robot]).path)
    change(tree.getroot())
    tree.write(tmp_path / "changed.urdf")
    new = findings(str(tmp_path / "changed.urdf")) - clean[robot]
    assert rule in {name for name, _ in new}
    assert not element or (rule, element) in new


@pytest.mark.parametrize(
    ("link", "values", "severity"),
    [("wrist_3_link", (1e-3, 1e-3, 1e-2), "error"), ("upper_arm_link", (0.1, 0.1, 0.3), "warning"),
     ("forearm_link", (0.2, -1.5, 0.2), "error"), ("base_link", (-1.0, 1.0, 1.0), "warning")],
)  # fmt: skip
@pytest.mark.parametrize("turned", [False, True])
def test_an_impossible_inertia_is_an_error_where_a_joint_feels_it(
    tmp_path: Path, link: str, values: tuple[float, float, float], severity: str, turned: bool
) -> None:
    tree = ET.parse(find_manifest(MODELS["ur5"]).path)
    root = tree.getroot()
    # A quarter turn about x exchanges the moments about y and z.
    moments(link, values[0], *(values[:0:-1] if turned else values[1:]))(root)
    origin = root.find(f"link[@name='{link}']/inertial/origin")
    assert origin is not None
    origin.set("rpy", f"{np.pi / 2 if turned else 0.0!r} 0 0")
    tree.write(tmp_path / "arm.urdf")
    found = sysid_bench.lint([tmp_path / "arm.urdf"]).findings
    impossible = [entry for entry in found if entry["rule"] == "impossible-inertia"]
    assert [(entry["element"], entry["severity"]) for entry in impossible] == [(link, severity)]


def test_a_file_in_which_nothing_moves_is_noted_and_takes_no_other_with_it(tmp_path: Path) -> None:
    table = "<robot name='t'><link name='a'/><link name='b'/><joint name='j' type='fixed'>"
    text = f"{table}<parent link='a'/><child link='b'/></joint></robot>"
    (tmp_path / "table.urdf").write_text(text)
    (tmp_path / "arm.urdf").write_text(find_manifest(MODELS["ur5"]).path.read_text())
    result = sysid_bench.lint([tmp_path])
    assert result.ok
    assert result.models == 2
    (found,) = (entry for entry in result.findings if entry["file"].endswith("table.urdf"))
    assert (found["rule"], found["severity"]) == ("motionless", "note")
    assert findings(MODELS["ur5"]) <= {(e["rule"], e["element"]) for e in result.findings}


def test_files_of_a_folder_may_include_each_other(tmp_path: Path) -> None:
    for name in ("robots", "parts"):
        (tmp_path / name).mkdir()
    (tmp_path / "parts" / "link.xml").write_text("<mujocoinclude><geom size='.1'/></mujocoinclude>")
    (tmp_path / "robots" / "arm.xml").write_text(
        "<mujoco><worldbody><body><joint/><include file='../parts/link.xml'/></body></worldbody>"
        "</mujoco>"
    )
    assert sysid_bench.lint([tmp_path]).ok


def test_the_robots_of_the_project_have_no_error() -> None:
    folders = sorted(path.parent for path in ROBOTS.glob("*/robot.toml"))
    result = sysid_bench.lint(folders)
    assert result.models == len(folders) > 15
    errors = [entry for entry in result.findings if entry["severity"] == "error"]
    assert not errors


def test_a_finding_has_its_line_and_can_be_suppressed(tmp_path: Path) -> None:
    tree = ET.parse(find_manifest(MODELS["ur5"]).path)
    times(["forearm_link"], "mass", "value", 1e4)(tree.getroot())
    tree.write(tmp_path / "arm.urdf")
    found = sysid_bench.lint([tmp_path]).findings
    heavy = next(entry for entry in found if entry["rule"] == "mass")
    assert heavy["severity"] == "error"
    written = (tmp_path / "arm.urdf").read_text().splitlines()[heavy["line"] - 1]
    assert 'name="forearm_link"' in written
    manifest = tmp_path / "robot.toml"
    for ignored in (["mass:forearm_link"], ["mass"]):
        manifest.write_text(
            f'name = "arm"\nfile = "arm.urdf"\n[lint]\nignore = {json.dumps(ignored)}\n'
        )
        kept = {
            (entry["rule"], entry["element"]) for entry in sysid_bench.lint([manifest]).findings
        }
        assert ("mass", "forearm_link") not in kept


def test_a_model_that_cannot_be_read_is_one_finding(tmp_path: Path) -> None:
    (tmp_path / "broken.urdf").write_text("<robot name='x'><link name='a'")
    (tmp_path / "other.xml").write_text("<package/>")
    result = sysid_bench.lint([tmp_path])
    assert result.models == 1
    assert [entry["rule"] for entry in result.findings] == ["load"]
    assert not result.ok
    (tmp_path / "broken.urdf").unlink()
    with pytest.raises(UsageError, match="no URDF or MJCF"):
        sysid_bench.lint([tmp_path])


@pytest.mark.parametrize("folder", ["deep/robots/arm", "robots", "my robots/ünï"])
def test_a_folder_is_searched_for_manifests_and_for_models_without_one(
    tmp_path: Path, folder: str
) -> None:
    """Each robot.toml counts once, with its model where that lies, a package's or a file beside
    it; a model file that no manifest names counts by itself."""
    for name, file in {"pack": MODELS["panda"], "own": "arm.urdf", "gone": "absent.urdf"}.items():
        (tmp_path / folder / name).mkdir(parents=True)
        text = f'name = "{name}"\nfile = "{file}"\n'
        (tmp_path / folder / name / "robot.toml").write_text(text)
    arm = find_manifest(MODELS["ur5"]).path.read_text()
    (tmp_path / folder / "own" / "arm.urdf").write_text(arm)
    both = findings(MODELS["panda"]) | findings(str(tmp_path / folder / "own" / "arm.urdf"))
    result = sysid_bench.lint([tmp_path])
    assert result.models == 3
    found = [entry for entry in result.findings if entry["severity"] != "note"]
    assert {(entry["rule"], entry["element"]) for entry in found} == both | {("load", "")}
    (error,) = (entry for entry in result.findings if entry["rule"] == "load")
    assert error["file"] == str(tmp_path / folder / "gone" / "robot.toml")
    assert "absent.urdf" in error["message"]
    (tmp_path / folder / "lone.urdf").write_text(arm)
    assert sysid_bench.lint([tmp_path]).models == 4
