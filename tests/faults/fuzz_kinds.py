"""Kinds of input that are read: how sound ones are made, and the function that reads them."""

import json
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Final
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pandas as pd
import pyarrow.parquet  # noqa: F401 - once, not in each process
from scipy.io import savemat

from sysid_bench import identify, init_robot, list_, package_folders, paper_table, plan, show
from sysid_bench.commands.values import parse_motors, parse_noise
from sysid_bench.commands.values import parse_payload as payload_option
from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.motion_file import MotionFile
from sysid_bench.excitation.motion_output import read_motion
from sysid_bench.excitation.optimised import Optimised
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.plugin_names import BUILTIN, build
from sysid_bench.signals.log_reader import read_table
from sysid_bench.units import interval, quantity
from tests.faults import fuzz_seeds as seeds
from tests.faults.fuzz_kind import Kind, every, make_log, sound_robots, text_files
from tests.faults.fuzz_logs import LOG_KINDS
from tests.faults.fuzz_options import OPTIONS, word
from tests.faults.fuzz_runs import RUN_KINDS


def _text_kind(name: str, text: str, read: Callable[[str], object]) -> Kind:
    """Kind of a text that is given as an argument, one choice of several a line."""
    lines = [line.strip() for line in text.strip().splitlines()]

    def make(folder: Path) -> None:
        (folder / "text").write_text("\n".join(lines))

    def read_all(folder: Path) -> None:
        every(partial(read, line) for line in word(folder).split("\n"))

    return Kind(name, make, ("text",), read_all, places=False)


def _log(folder: Path) -> None:
    # Its torques are random numbers, whose diagnosis is a delay.
    with sound_robots():
        identify("scara", log=folder / "log.toml", task="robot", accept=("delay",))


def _make_tables(folder: Path) -> None:
    """The same numbers in each format of recordings."""
    t, q = np.arange(40) / 100, np.random.default_rng(0).normal(size=(40, 2))
    np.savetxt(folder / "log.csv", np.column_stack([t, q]), delimiter=",", header="t,a,b")
    np.savetxt(folder / "log.txt", np.column_stack([t, q]))
    np.savez(folder / "log.npz", t=t, q=q)
    np.savez_compressed(folder / "small.npz", t=t, q=q)
    np.save(folder / "log.npy", q)
    frame = pd.DataFrame({"t": t, "a": q[:, 0], "stamp": pd.to_datetime(t, unit="s")})
    frame.to_parquet(folder / "log.parquet")
    savemat(folder / "log.mat", {"t": t, "s": {"q": q}}, do_compression=True)
    savemat(folder / "plain.mat", {"t": t, "s": {"q": q}})
    savemat(folder / "old.mat", {"t": t, "q": q}, format="4")


def _table_kind(suffix: str) -> Kind:
    def read(folder: Path) -> None:
        for path in sorted(folder.glob(f"*{suffix}")):
            read_table(path)
        if not any(folder.glob(f"*{suffix}")):
            raise UsageError("absent: globbed here")

    return Kind(f"log{suffix}", _make_tables, (f"*{suffix}",), read)


def _make_members(folder: Path) -> None:
    np.save(folder / "t.npy", np.arange(40) / 100)
    np.save(folder / "q.npy", np.random.default_rng(0).normal(size=(40, 2)))


def _members(folder: Path) -> None:
    """Damage inside of an archive whose checksums are right."""
    with ZipFile(folder / "log.npz", "w", ZIP_DEFLATED) as archive:
        for path in sorted(folder.glob("*.npy")):
            archive.write(path, path.name)
    read_table(folder / "log.npz")


def _motion(folder: Path) -> None:
    problem = design_problem(load_robot("scara"), 200.0)
    MotionFile(str(folder / "motion.csv"), 2.0).design(problem, np.random.default_rng(0))
    MotionFile(str(folder / "motion.csv")).design(problem, np.random.default_rng(0))


def _make_motion(folder: Path) -> None:
    t = np.arange(100) * 0.02
    x = 0.1 * np.sin(2 * np.pi * np.outer(t / 2, [1, 2, 1, 3])) * [1, 1, 0.1, 1] + [0, 0, 0.1, 0]
    header = "t," + ",".join(joint.name for joint in load_robot("scara").joints)
    columns = np.column_stack([t, x])
    np.savetxt(folder / "motion.csv", columns, "%.9g", ",", header=header, comments="")


def _recorded_motion(folder: Path) -> None:
    robot = load_robot("scara")
    names = tuple(joint.name for joint in robot.joints)
    read_motion(folder / "motion.csv", design_problem(robot, 200.0), names, Optimised())


def _make_recorded_motion(folder: Path) -> None:
    names = [f"{joint.name}.{key}" for joint in load_robot("scara").joints for key in "qva"]
    numbers = np.random.default_rng(0).normal(size=(20, 1 + len(names)))
    header = ",".join(["t", *names])
    np.savetxt(folder / "motion.csv", numbers, "%.9g", ",", header=header, comments="")


def _robot_toml(folder: Path) -> None:
    for name in ("scara", "psm"):
        load_robot(folder / name / "robot.toml")


def _make_robots(folder: Path) -> None:
    source = package_folders.package_folder("robots")
    for name, of in (("scara", "scara"), ("psm", "dvrk_psm")):
        shutil.copytree(source / of, folder / name)
    (folder / "scara" / "robot.toml").write_text(seeds.MANIFEST)


def _dh(folder: Path) -> None:
    init_robot(folder / "dh.csv", folder / "made")
    init_robot(folder / "loop.csv", folder / "looped", modified=True)


def _make_dh(folder: Path) -> None:
    text_files({"dh.csv": seeds.DH})(folder)
    shutil.copy(
        package_folders.package_folder("robots") / "dvrk_psm" / "dh_loop.csv", folder / "loop.csv"
    )


def _mjcf(folder: Path) -> None:
    load_robot(folder / "robot.xml")


def _make_mjcf(folder: Path) -> None:
    text_files(seeds.MJCF)(folder)
    triangles = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4") * 0.1
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    body = b"".join(
        np.zeros(3, "<f4").tobytes() + triangles[list(face)].tobytes() + b"\0\0" for face in faces
    )
    (folder / "part.stl").write_bytes(b"\0" * 80 + np.uint32(len(faces)).tobytes() + body)


def _suite(folder: Path) -> None:
    plan(folder / "suite.toml", robots_dir=folder)


def _plug_in(text: str) -> None:
    kind, _, name = text.partition(" ")
    build(kind if kind in BUILTIN else "estimator", name)


def _quantity(text: str) -> None:
    quantity(text, "|".join(("s", "Hz", "rad", "m", "B", "1")))
    interval(f"0 s to {text}" if text.endswith("s") else "0 s to 1 s")


def _condition(text: str) -> None:
    fields = {"robot": "ur5", "rate": 200.0, "noise": ("exact", "n1"), "torque_error": None}
    Expression.parse(text).holds(MappingProxyType(fields))


def _payload(text: str) -> None:
    parse_payload(payload_option(text))


def _log_suite(folder: Path) -> None:
    plan(folder / "suite.toml")


def _make_log_suite(folder: Path) -> None:
    make_log(folder)
    (folder / "suite.toml").write_text(seeds.LOG_SUITE.replace("$HOME", str(folder)))
    shutil.copy(folder / "log.csv", folder / "other.csv")


def _plug_in_file(folder: Path) -> None:
    for no_code in (True, False):  # not imported, then imported by a supervised process
        plan(folder / "suite.toml", no_code=no_code)


def _catalogue(folder: Path) -> None:
    os.chdir(folder)
    every(partial(list_, kind, folder) for kind in ("robots", "suites"))
    every(partial(show, name, folder) for name in ("scara", "psm", "mine"))


def _make_catalogue(folder: Path) -> None:
    _make_robots(folder)
    text_files({"suites/mine.toml": seeds.SUITE})(folder)


def _values(folder: Path) -> None:
    with sound_robots():
        paper_table("dvrk_psm", values=folder / "values.json")


def _make_values(folder: Path) -> None:
    rows = paper_table("dvrk_psm")["rows"]
    text = json.dumps({row["expression"]: 0.5 for row in rows[:4]}, indent=1)
    (folder / "values.json").write_text(text)


def _motors(folder: Path) -> None:
    parse_motors(str(folder / "motors.toml"))


KINDS: Final = (
    Kind("suite", text_files({"suite.toml": seeds.SUITE}), ("suite.toml",), _suite),
    Kind("plant-file", text_files({"plant.toml": seeds.PLANT, "suite.toml": seeds.PLANT_SUITE}),
         ("plant.toml",), _suite),
    Kind("manifest", _make_robots, ("*/robot.toml",), _robot_toml),
    Kind("urdf", text_files({"robot.urdf": seeds.URDF}), ("robot.urdf",),
         lambda folder: load_robot(folder / "robot.urdf")),
    Kind("mjcf", _make_mjcf, ("*.xml", "*.stl"), _mjcf),
    Kind("obj", text_files({"robot.xml": seeds.OBJ_MODEL, "part.obj": seeds.OBJ}),
         ("part.obj",), _mjcf),
    Kind("dh", _make_dh, ("*.csv",), _dh),
    Kind("log-description", make_log, ("log.toml",), _log),
    Kind("log-numbers", make_log, ("log.csv",), _log),
    *(_table_kind(suffix) for suffix in (".csv", ".txt", ".npz", ".npy", ".parquet", ".mat")),
    *LOG_KINDS,
    Kind("npz-members", _make_members, ("*.npy",), _members, places=False),
    Kind("motion", _make_motion, ("motion.csv",), _motion),
    Kind("recorded-motion", _make_recorded_motion, ("motion.csv",), _recorded_motion),
    *RUN_KINDS,
    Kind("values.json", _make_values, ("values.json",), _values),
    Kind("motors", text_files({"motors.toml": seeds.MOTORS}), ("motors.toml",), _motors),
    _text_kind("payload", seeds.PAYLOADS, _payload),
    _text_kind("noise", "tau=0.5 %,q=1e-4 rad", parse_noise),
    _text_kind("quantity", seeds.QUANTITIES, _quantity),
    _text_kind("condition", seeds.CONDITIONS, _condition),
    _text_kind("plug-in", seeds.PLUG_INS, _plug_in),
    _text_kind("show", "ur5\nols\nfourier\nsmoke\npoint-1kg", lambda name: show(name)),
    _text_kind("robot-file", seeds.ROBOT_FILES, lambda name: load_robot(name)),
    Kind("log-suite", _make_log_suite, ("*.toml", "*.csv"), _log_suite),
    Kind("plug-in-file", text_files({"mine.py": seeds.PLUG_IN, "suite.toml": seeds.PLUG_IN_SUITE}),
         ("mine.py",), _plug_in_file),
    Kind("catalogue", _make_catalogue, ("*/robot.toml", "suites/*.toml"), _catalogue),
    *OPTIONS,
)  # fmt: skip
