"""Laws of everything that is read: what is not a file of the kind is refused in one sentence."""

import os
import struct
from collections.abc import Callable
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest
from numpy.lib import format as npy

from sysid_bench.commands.basis import paper_table
from sysid_bench.commands.values import parse_motors
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.motion_file import MotionFile
from sysid_bench.excitation.motion_output import read_motion
from sysid_bench.excitation.optimised import Optimised
from sysid_bench.harness.suite.load_suite import load_suite
from sysid_bench.harness.work.row_files import read_rows
from sysid_bench.input_files import parse_json, parse_toml, read_data
from sysid_bench.models import dh_table
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import read_manifest
from sysid_bench.signals import log_table
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.log_reader import read_table
from tests.robots import named_robot

DEEP = {
    "toml": "a = " + "[" * 5000,
    "json": "[" * 100_000,
    "within": "a = " + "[" * 200 + "]" * 200,
}


def motion(path: Path) -> None:
    problem = design_problem(named_robot("scara"), 200.0)
    MotionFile(str(path)).design(problem, np.random.default_rng(0))


def recorded_motion(path: Path) -> None:
    robot = named_robot("scara")
    names = tuple(joint.name for joint in robot.joints)
    read_motion(path, design_problem(robot, 200.0), names, Optimised())


READERS: dict[str, Callable[[Path], object]] = {
    "suite.toml": load_suite,
    "robot.toml": read_manifest,
    "log.toml": read_description,
    "motors.toml": lambda path: parse_motors(str(path)),
    "robot.urdf": load_robot,
    "robot.xml": load_robot,
    "dh.csv": dh_table.read_table,
    "motion.csv": motion,
    "recorded.csv": recorded_motion,
    "values.json": lambda path: paper_table("scara", values=path),
    **{f"log.{suffix}": read_table for suffix in ("csv", "npz", "npy", "parquet", "mat")},
}


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(3 * 10**9)


PLACES: dict[str, Callable[[Path], object]] = {
    "device": lambda path: path.symlink_to("/dev/zero"),
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "loop": lambda path: path.symlink_to(path.name),
    "absent": lambda path: None,
    "3 GB": sparse,
    "empty": Path.touch,
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", READERS)
def test_what_is_not_a_file_is_refused_with_its_name(
    name: str, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    PLACES[place](path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SysidBenchError, match=path.stem) as refusal:
        READERS[name](path)
    assert len(str(refusal.value)) < 1000


@pytest.mark.parametrize("name", [name for name in READERS if name.endswith(".toml")])
@pytest.mark.parametrize(
    "text", [DEEP["toml"], DEEP["within"], "a = " + "9" * 5000, "\0", "a = 1e"]
)
def test_toml_beyond_the_limits_of_python_is_refused(name: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(SysidBenchError, match=path.stem):
        READERS[name](path)


@pytest.mark.parametrize("name", [name for name in READERS if name.endswith(".toml")])
def test_what_is_not_text_is_refused_as_such(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"a = \xff\xfe")
    with pytest.raises(SysidBenchError, match=r"it is not a text file \(byte 5 is not UTF-8\)"):
        READERS[name](tmp_path / name)


def test_json_is_not_nested_without_end() -> None:
    with pytest.raises(ValueError, match="levels deep"):
        parse_json(DEEP["json"])
    with pytest.raises(ValueError, match="levels deep"):
        parse_toml(DEEP["within"])
    assert parse_json('{"a": [1]}') == {"a": [1]}


def test_a_file_that_states_no_size_is_read_and_bounded() -> None:
    assert b"Name" in read_data(Path("/proc/self/status"))
    with pytest.raises(OSError, match="20 are allowed"):
        read_data(Path("/proc/self/status"), largest=20)


def test_a_message_is_short_and_printable() -> None:
    text = str(UsageError("first\n" + "x" * 10**6 + "\x1b[31m\udc80"))
    assert len(text) < 2000
    assert text.replace("\n", "").isprintable()
    assert text.startswith("first\nxxx")
    assert str(UsageError("N·m is not kg")) == "N·m is not kg"


@pytest.mark.parametrize("place", ["joint", "link", "inertial"])
@pytest.mark.parametrize("written", ["abc 0 0", "", "0 0", "0 0 nan", "1 2 3 4"])
def test_an_origin_without_three_numbers_is_refused(
    place: str, written: str, tmp_path: Path
) -> None:
    origins = dict.fromkeys(("joint", "link", "inertial"), "")
    origins[place] = f'<origin rpy="{written}"/>'
    path = tmp_path / "robot.urdf"
    path.write_text(
        f"""<robot name="r"><link name="base"/><link name="a">{origins["link"]}<inertial>
        {origins["inertial"]}<mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
        <joint name="j" type="continuous"><parent link="base"/><child link="a"/>
        {origins["joint"]}<axis xyz="0 0 1"/></joint></robot>"""
    )
    with pytest.raises(SysidBenchError, match="rpy of an <origin> is"):
        load_robot(path)


def array_header(shape: tuple[int, ...]) -> bytes:
    text = repr({"descr": "<f8", "fortran_order": False, "shape": shape}).encode()
    return npy.magic(1, 0) + struct.pack("<H", len(text)) + text


@pytest.mark.parametrize("shape", [(400_000_000,), (10**15, 10**15), (-1,), (1000,)])
@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_a_header_that_states_more_numbers_than_there_are_is_refused_before_reading(
    suffix: str, shape: tuple[int, ...], tmp_path: Path
) -> None:
    path = tmp_path / f"log.{suffix}"
    content = array_header(shape) + b"\0" * 80
    if suffix == "npy":
        path.write_bytes(content)
    else:
        with ZipFile(path, "w", ZIP_DEFLATED) as archive:
            archive.writestr("q.npy", content)
    with pytest.raises(UsageError, match="its headers state"):
        read_table(path)


def test_a_directory_that_states_3_gb_is_refused_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    with ZipFile(path, "w") as archive:
        archive.writestr("q.npy", array_header((10,)) + b"\0" * 80)
    content = path.read_bytes()
    size = len(array_header((10,)) + b"\0" * 80)
    entry = content.rindex(b"PK\x01\x02")  # 20 bytes to the packed and unpacked sizes
    assert struct.unpack("<I", content[entry + 24 : entry + 28]) == (size,)
    changed = content[: entry + 24] + struct.pack("<I", 3 * 10**9) + content[entry + 28 :]
    path.write_bytes(changed)
    with pytest.raises(UsageError, match="its headers state 3000000000 bytes"):
        read_table(path)


def test_any_damage_to_the_header_of_an_array_is_refused(tmp_path: Path) -> None:
    sound = array_header((10,)) + b"\0" * 80
    path = tmp_path / "log.npy"
    for place in range(len(array_header((10,)))):
        path.write_bytes(sound[:place] + b"\xff" + sound[place + 1 :])
        with pytest.raises(UsageError, match="log"):
            read_table(path)


@pytest.mark.parametrize("suffix", ["parquet", "mat"])
def test_a_log_that_unpacks_to_too_much_is_refused(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pandas as pd
    from scipy.io import savemat

    path, q = tmp_path / f"log.{suffix}", np.zeros(100_000)
    if suffix == "mat":
        savemat(path, {"q": q}, do_compression=True)
    else:
        pd.DataFrame({"q": q}).to_parquet(path)
    assert path.stat().st_size < 100_000
    assert len(read_table(path).values) == len(q)
    monkeypatch.setattr(log_table, "LARGEST_LOG", 700_000)
    os.utime(path, (0, 0))  # read again
    with pytest.raises(UsageError, match="700000 are allowed"):
        read_table(path)


@pytest.mark.parametrize("text", ["(" * 100_000, "-" * 100_000 + "1", "1e999", "9**9**9", "0**-1"])
def test_an_expression_of_a_dh_table_that_python_refuses_is_refused(
    text: str, tmp_path: Path
) -> None:
    path = tmp_path / "dh.csv"
    path.write_text(f"link,joint,a,alpha,d,theta\n1,R,0,{text},0,q1\n")
    with pytest.raises(UsageError, match="line 2"):
        dh_table.read_table(path)


def test_a_recorded_motion_is_of_finite_numbers(tmp_path: Path) -> None:
    path = tmp_path / "recorded.csv"
    names = [f"{joint.name}.{key}" for joint in named_robot("scara").joints for key in "qva"]
    header, row = ",".join(["t", *names]), ",".join(["0.5"] * (1 + len(names)))
    path.write_text(f"{header}\n{row}\n{row}\n")
    recorded_motion(path)
    for cell in ("abc", "nan", "inf", "1e999", "", '"', "\x1b[31m", "1,2"):
        path.write_text(f"{header}\n{row}\n{row.replace('0.5', cell, 1)}\n")
        with pytest.raises(UsageError, match="recorded"):
            recorded_motion(path)


def test_a_motion_with_a_nul_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "motion.csv"
    path.write_bytes(b"t,shoulder,elbow,lift,spin\n0,0,0,0,\0" + b"9" * 200_000 + b"\n")
    with pytest.raises(UsageError, match="not a table of numbers"):
        motion(path)


def test_damaged_rows_and_what_is_not_a_file_are_skipped_and_counted(tmp_path: Path) -> None:
    lines = [
        '{"id": "a", "status": "ok"}',
        *('{"id": "b"}', '{"id": "c", "status": "fine"}', '{"id": "d", "status": ["ok"]}'),
        *('{"id": "e", "status": "ok", "joints": 5}', '{"id": "f", "status": "ok", "joints": [5]}'),
        '{"id": "g", "status": "ok", "parameters_table": "text"}',
    ]
    (tmp_path / "000001-worker1.jsonl").write_text("\n".join(lines) + "\n")
    (tmp_path / "000002-worker1.jsonl").symlink_to("/dev/zero")
    (tmp_path / "000003-worker1.jsonl").mkdir()
    stored = read_rows(tmp_path)
    assert set(stored.rows) == {"a"}
    assert (len(stored.garbled), stored.torn) == (len(lines) - 1 + 2, 0)
