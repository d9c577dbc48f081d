"""An MJCF may include files of its own folder, once, and expand to no more than a robot needs."""

import re
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.commands.crosscheck import crosscheck
from sysid_bench.errors import ModelError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import read_manifest
from tests.robots import robot_of

BODY = '<body name="{}"><joint/><inertial pos="0 0 .1" mass="1" diaginertia="1 1 1"/></body>'


def write(folder: Path, **texts: str) -> Path:
    """Files of a model by name (`__` is a slash); the path of main.xml."""
    for name, text in texts.items():
        file = folder / (name.replace("__", "/") + ".xml")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    return folder / "main.xml"


ATTACHING = (
    '<mujoco><asset><model name="s" file="part.xml"/></asset><worldbody>'
    f'{BODY.format("a")}<body><attach model="s" prefix="p_"/></body></worldbody></mujoco>'
)


def including(*files: str, bodies: str = "") -> str:
    included = "".join(f'<include file="{file}"/>' for file in files)
    return f"<mujoco>{included}<worldbody>{bodies}</worldbody></mujoco>"


def test_includes_are_read_beside_the_model_and_beside_each_other(tmp_path: Path) -> None:
    file = write(
        tmp_path,
        main=including("parts/one.xml", bodies='<include file="parts/bodies.xml"/>'),
        parts__one=including("two.xml", bodies=BODY.format("one")),
        parts__two=including(bodies=BODY.format("two")),
        parts__bodies=f"<mujocoinclude>{BODY.format('three')}</mujocoinclude>",
    )
    robot = load_robot(file)
    assert set(robot.body_names) == {"one", "two", "three"}
    together = "".join(map(BODY.format, robot.body_names))
    np.testing.assert_array_equal(robot.phi, robot_of(including(bodies=together)).phi)


def test_an_attached_model_may_not_include_from_outside_either(tmp_path: Path) -> None:
    write(tmp_path, secret=including(bodies=BODY.format("secret")))
    file = write(tmp_path / "model", main=ATTACHING, part=including("../secret.xml"))
    with pytest.raises(ModelError, match=r"secret\.xml'> lies outside .*assets = \"\.\.\""):
        load_robot(file)


def test_an_outer_folder_may_be_named(tmp_path: Path) -> None:
    """By a manifest, from the model's folder; nothing beyond it is read."""
    bodies = f"<mujocoinclude>{BODY.format('outer')}</mujocoinclude>"
    main = including(bodies='<include file="../bodies.xml"/>')
    file = write(tmp_path / "robot" / "mjcf", main=main)
    write(tmp_path / "robot", bodies=bodies)
    manifest = tmp_path / "robot.toml"
    manifest.write_text('name = "r"\nfile = "robot/mjcf/main.xml"\nassets = ".."\n')
    assert load_robot(read_manifest(manifest)).body_names == ("outer",)
    [verdict] = crosscheck(file, samples=2, assets=tmp_path / "robot")
    assert verdict["ok"]
    file.write_text(including("../../bodies.xml"))
    write(tmp_path, bodies=bodies)
    with pytest.raises(ModelError, match="outside"):
        load_robot(read_manifest(manifest))


@pytest.mark.parametrize("element", ["include", "model"])
@pytest.mark.parametrize("where", ["../secret.xml", "parts/../../secret.xml", "{}/secret.xml"])
def test_nothing_outside_of_the_folder_is_read(where: str, element: str, tmp_path: Path) -> None:
    write(tmp_path, secret=including(bodies=BODY.format("secret")))
    (tmp_path / "model" / "parts").mkdir(parents=True)
    asked = f'<{element} file="{where.format(tmp_path)}"/>'
    inside = asked if element == "include" else f"<asset>{asked}</asset>"
    text = f"<mujoco>{inside}<worldbody>{BODY.format('a')}</worldbody></mujoco>"
    with pytest.raises(ModelError, match="outside the model's folder"):
        load_robot(write(tmp_path / "model", main=text))


def test_a_link_that_leads_outside_is_not_followed(tmp_path: Path) -> None:
    write(tmp_path, secret=including(bodies=BODY.format("secret")))
    file = write(tmp_path / "model", main=including("inner.xml"))
    (file.parent / "inner.xml").symlink_to(tmp_path / "secret.xml")
    with pytest.raises(ModelError, match="outside"):
        load_robot(file)


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        ({"main": including("main.xml")}, "cycle"),
        ({"main": including("a.xml"), "a": including("b.xml"), "b": including("a.xml")}, "cycle"),
        ({"main": including("absent.xml")}, "does not exist"),
        ({"main": including("a.xml"), "a": "<mujoco>"}, r"a\.xml is not well-formed XML"),
        ({"main": including("a.xml"), "a": "<!DOCTYPE x []><mujoco/>"}, "DOCTYPE"),
        ({"main": including("a\0.xml".replace("\0", "&#0;"))}, "well-formed"),
    ],
)
def test_includes_that_cannot_be_read_say_why(
    texts: dict[str, str], words: str, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=words):
        load_robot(write(tmp_path, **texts))


MANY = '<replicate count="{}" offset="1 0 0">{}</replicate>'


@pytest.mark.parametrize(
    "bodies",
    [
        MANY.format(10**9, BODY.format("a")),
        MANY.format(10**4, MANY.format(10**4, BODY.format("a"))),
        MANY.format("1e300", BODY.format("a")),
        f'<body name="b"><flexcomp type="grid" count="9999 9999 9"/>{BODY.format("a")}</body>',
    ],
)  # fmt: skip
def test_a_text_that_stands_for_too_much_is_refused_at_once(bodies: str) -> None:
    with pytest.raises(ModelError, match="elements"):
        robot_of(including(bodies=bodies))


@pytest.mark.parametrize("count", ["-inf", "-1e400", "nan", "-1"])
def test_a_count_that_is_no_number_of_copies_is_mujocos_to_judge(count: str) -> None:
    text = including(bodies=MANY.format(count, BODY.format("a")))
    with suppress(ModelError):  # no other error
        robot_of(text)


def test_a_path_that_is_not_utf8_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "mad\udcff"
    folder.mkdir()
    with pytest.raises(ModelError, match="path in UTF-8"):
        load_robot(write(folder, main=including(bodies=BODY.format("a"))))


def bomb(levels: int) -> dict[str, str]:
    """Files of which each includes the next one twice."""
    twice = '<include file="f{0}.xml"/><include file="f{0}.xml"/>'
    texts = {
        f"f{k}": f"<mujocoinclude>{twice.format(k + 1)}</mujocoinclude>" for k in range(levels)
    }
    return {"main": including("f0.xml"), **texts, f"f{levels}": "<mujocoinclude/>"}


GREAT = {
    "included twice, again and again": bomb(30),
    "a long chain": {
        "main": including("f0.xml"),
        **{f"f{k}": including(f"f{k + 1}.xml") for k in range(400)},
        "f400": including(),
    },
    "attached copies": {
        "main": ATTACHING,
        "part": including(bodies=MANY.format(3000, MANY.format(3000, BODY.format("b")))),
    },
    "many parts, each large": {
        "main": including(*(f"f{k}.xml" for k in range(25))),
        **{f"f{k}": including(bodies=MANY.format(6000, BODY.format("b"))) for k in range(25)},
    },
    "bodies times joints": {"main": including(bodies=MANY.format(1000, BODY.format("a")))},
    "a height field": {
        "main": '<mujoco><asset><hfield name="h" nrow="20000" ncol="20000" size="1 1 1 1"/>'
        f"</asset><worldbody>{BODY.format('a')}</worldbody></mujoco>"
    },
    "user data": {
        "main": f'<mujoco><size nuser_body="100000000"/><worldbody>{BODY.format("a")}</worldbody>'
        "</mujoco>"
    },
    "a fine mesh": {
        "main": '<mujoco><asset><mesh name="m" builtin="supersphere" params="99999 1 1"/></asset>'
        f"<worldbody>{BODY.format('a')}</worldbody></mujoco>"
    },
    "soft bodies": {
        "main": including(bodies=BODY.format("a") + '<flexcomp type="grid" count="20 20 20"/>')
    },
}


@pytest.mark.parametrize("case", GREAT)
def test_what_is_too_much_in_all_is_refused_before_it_is_built(case: str, tmp_path: Path) -> None:
    file = write(tmp_path, **GREAT[case])
    start = time.process_time()
    with pytest.raises(ModelError) as refusal:
        load_robot(file)
    assert time.process_time() - start < 3
    assert "\n" not in str(refusal.value)
    assert re.search("more than|at most", str(refusal.value))


def test_a_great_file_is_not_read(tmp_path: Path) -> None:
    file = write(tmp_path, main=including("great.xml"))
    with open(tmp_path / "great.xml", "wb") as great:
        great.truncate(3 * 2**30)
    with pytest.raises(ModelError, match="bytes together"):
        load_robot(file)


def test_memory_that_a_text_reserves_is_not_taken() -> None:
    text = f'<mujoco><size memory="100G"/><worldbody>{BODY.format("a")}</worldbody></mujoco>'
    assert robot_of(text).nv == 1


def test_a_tree_that_is_too_large_to_compare_is_refused() -> None:
    with pytest.raises(ModelError, match="degrees of freedom"):
        robot_of(including(bodies=MANY.format(400, BODY.format("a"))))
