"""URDF files that ROS reads over their faults: mended and reported, or one sentence."""

import codecs
from pathlib import Path

import numpy as np
import pinocchio
import pytest

from sysid_bench.errors import ModelError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.models.load import load_robot
from tests.models.test_urdf_formats import INERTIA, INERTIAL, LIMIT, arm
from tests.robots import robot_of

OTHER = INERTIAL.replace('value="1"', 'value="7"')
LIGHT = f"<inertial>{INERTIA}</inertial>"
MENDED = {
    "two inertials": (arm(tip=INERTIAL + OTHER), arm(), "2 <inertial> elements in link 'tip'"),
    "three masses": (
        arm(tip=INERTIAL.replace(INERTIA, '<mass value="2"/><mass value="3"/>' + INERTIA)),
        arm(),
        "3 <mass> elements in link 'tip'",
    ),
    "two axes": (
        arm().replace('<axis xyz="0 1 1"/>', '<axis xyz="0 1 1"/><axis xyz="1 0 0"/>'),
        arm(),
        "2 <axis> elements in joint 'j'",
    ),
    "two limits": (arm(inside=LIMIT + LIMIT.replace("-1", "-2")), arm(), "2 <limit> elements"),
    "no mass": (arm(tip=LIGHT), arm(tip=""), "<inertial> without mass: taken for massless"),
    "xacro left": (
        arm().replace("<link", '<xacro:include filename="$(find x)/y.xacro"/><link', 1),
        arm(),
        "1 unexpanded <xacro:include>",
    ),
}


@pytest.mark.parametrize("name", MENDED)
def test_faults_are_mended_for_both_engines_and_reported(name: str) -> None:
    text, plain, words = MENDED[name]
    robot = robot_of(text)
    assert any(words in repair for repair in robot.repairs)
    np.testing.assert_array_equal(robot.phi, robot_of(plain).phi)
    np.testing.assert_array_equal(robot.limits.q_low, robot_of(plain).limits.q_low)
    check = crosscheck(robot, 5)
    assert check.ok(), check.reason()
    assert check.native_gap is not None


@pytest.mark.parametrize("name", ["two inertials", "two axes"])
def test_the_first_of_repeated_elements_is_what_ros_reads(name: str) -> None:
    text, plain, _ = MENDED[name]
    theirs, ours = (pinocchio.buildModelFromXML(x) for x in (text, plain))
    for one, other in zip(theirs.inertias, ours.inertias, strict=True):
        assert one.mass == other.mass
    assert [j.shortname() for j in theirs.joints] == [j.shortname() for j in ours.joints]


DECLARED = '<?xml version="1.0" encoding="{}"?>'
TEXTS = {
    "mark": codecs.BOM_UTF8 + arm().encode(),
    "mark and declaration": codecs.BOM_UTF8 + (DECLARED.format("utf-8") + arm()).encode(),
    "leading space": ("\n \t" + DECLARED.format("utf-8") + arm()).encode(),
    "version 0.0": ('<?xml version="0.0" ?>' + arm()).encode(),
    "version 2": ('<?xml version="2.0" ?>' + arm()).encode(),
    "no version": ('<?xml encoding="utf-8"?>' + arm()).encode(),
    "utf-16": (DECLARED.format("utf-16") + arm()).encode("utf-16"),
    "latin-1": (DECLARED.format("iso-8859-1") + "<!-- gr\xf6\xdfer -->" + arm()).encode("latin-1"),
    "windows": (DECLARED.format("windows-1252") + "<!-- \x80 -->" + arm()).encode("latin-1"),
    "unknown": (DECLARED.format("x-none") + arm()).encode(),
    **{
        # Codecs of Python that are not encodings of XML: they raise, or change the text.
        name: (DECLARED.format(name) + arm()).encode()
        for name in ("idna", "undefined", "unicode_escape", "utf-7", "hex")
    },
    "wrong declaration": DECLARED.format("utf-8").encode() + b"<!-- gr\xf6 -->" + arm().encode(),
    "dashes": ("<!-- a -- b --->" + arm() + "<!------>").encode(),
    "commented doctype": ("<!-- <!DOCTYPE r> -->" + arm()).encode(),
}


@pytest.mark.parametrize("name", TEXTS)
def test_declarations_marks_and_comments_change_nothing(name: str, tmp_path: Path) -> None:
    file = tmp_path / "r.urdf"
    file.write_bytes(TEXTS[name])
    robot = load_robot(str(file))
    np.testing.assert_array_equal(robot.phi, robot_of(arm()).phi)
    assert robot.repairs == ()


REFUSED = {
    "rpy": (arm().replace('rpy=".1 0 .3"', 'rpy="abc 0 0"', 1), "'j'.*rpy.*'abc 0 0'.*three"),
    "axis": (arm().replace('xyz="0 1 1"', 'xyz="0 1"', 1), "'j'.*xyz of an <axis>.*three"),
    "limit": (arm(inside='<limit lower="low"/>'), "'j'.*lower is 'low'"),
    "damping": (arm(inside=LIMIT + '<dynamics damping="x"/>'), "'j'.*damping is 'x'"),
    "token": (arm(inside='<limit effort="${e}"/>'), "'j'.*effort='\\${e}'.*xacro"),
    "optenv": (arm().replace('xyz="0 .1 .2"', 'xyz="$(optenv X 0 0 0)"'), "'j'.*xacro FILE"),
    "no inertia": (arm(tip="").replace(INERTIAL, ""), "not a model of dynamics: none of its 3"),
    "masses of zero": (arm().replace("1 2 3", "0 0 0").replace('value="1"', 'value="0"'),
                       "not a model of dynamics"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_reader_can_guess_is_one_sentence(name: str) -> None:
    text, words = REFUSED[name]
    with pytest.raises(ModelError, match=words):
        robot_of(text)
