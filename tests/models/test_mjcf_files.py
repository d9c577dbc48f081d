"""What an MJCF text may pull in: files of its own folder, once, and no more than a robot needs."""

from pathlib import Path

import numpy as np
import pytest

from sysid_bench.errors import ModelError
from sysid_bench.models.load import load_robot
from tests.robots import robot_of

BODY = '<body name="{}"><joint/><inertial pos="0 0 .1" mass="1" diaginertia="1 1 1"/></body>'


def write(folder: Path, **texts: str) -> Path:
    """Files of a model by name (`__` is a slash); the path of main.xml."""
    for name, text in texts.items():
        file = folder / (name.replace("__", "/") + ".xml")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    return folder / "main.xml"


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


@pytest.mark.parametrize("element", ["include", "model"])
@pytest.mark.parametrize("where", ["../secret.xml", "parts/../../secret.xml", "{}/secret.xml"])
def test_nothing_outside_of_the_folder_is_read(where: str, element: str, tmp_path: Path) -> None:
    write(tmp_path, secret=including(bodies=BODY.format("secret")))
    (tmp_path / "model" / "parts").mkdir(parents=True)
    asked = f'<{element} file="{where.format(tmp_path)}"/>'
    inside = asked if element == "include" else f"<asset>{asked}</asset>"
    text = f"<mujoco>{inside}<worldbody>{BODY.format('a')}</worldbody></mujoco>"
    with pytest.raises(ModelError, match="outside of the model's folder"):
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
        ({"main": including("absent.xml")}, "not there"),
        ({"main": including("a.xml"), "a": "<mujoco>"}, r"a\.xml is no well-formed XML"),
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


def test_a_tree_that_is_too_large_to_compare_is_refused() -> None:
    with pytest.raises(ModelError, match="degrees of freedom"):
        robot_of(including(bodies=MANY.format(400, BODY.format("a"))))
