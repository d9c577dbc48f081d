"""Smallest inputs that once gave a traceback, or were read without bound."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sysid_bench import open_run, package_folders, show
from sysid_bench.commands.record import recording_notes
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.excitation.information import CRITERIA, Criterion
from sysid_bench.experiments import third_party as loaded_sources
from sysid_bench.harness import fingerprint
from sysid_bench.harness.coverage import COVERAGE_FILE, read_coverage
from sysid_bench.harness.plan import planned_fields
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.names import static_names
from sysid_bench.harness.work import row_files
from sysid_bench.harness.work.row_files import read_rows
from sysid_bench.input_files import LARGEST, check_file, file_hash
from sysid_bench.models import dh_table
from sysid_bench.models.load import load_robot
from sysid_bench.models.sources import ABSENT
from sysid_bench.plugin_names import build
from sysid_bench.signals.log_reader import read_table


def test_a_line_of_a_dh_table_that_csv_refuses_is_named(tmp_path: Path) -> None:
    path = tmp_path / "dh.csv"
    path.write_text("link,joint,a,alpha,d,theta\n1,R,0,0,0," + "9" * 200_000 + "\n")
    with pytest.raises(UsageError, match="line 2"):
        dh_table.read_table(path)


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("number", [np.nan, np.inf, 1e308])
def test_rows_beyond_numbers_leave_parameters_undetermined(name: str, number: float) -> None:
    W = np.ones((3, 2)) * number
    with np.errstate(all="ignore"):
        criterion = Criterion({name: 1.0}, np.zeros((0, 2)), np.eye(2))
        assert criterion.value(W) == np.inf
        assert not criterion.gradient(W).any()


def test_a_row_longer_than_rows_are_is_garbled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(row_files, "LARGEST_ROW", 40)
    row = '{{"id": "{}", "status": "ok"}}\n'
    middle = '{"id": "b", "status": "ok", "reason": "' + "x" * 200 + '"}\n'
    path = tmp_path / "000001-worker1.jsonl"
    path.write_text(row.format("a") + middle + row.format("c") + middle[:-1])
    stored = read_rows(tmp_path)
    assert set(stored.rows) == {"a", "c"}
    assert (stored.garbled, stored.torn) == ((f"{path.name}:2",), 1)
    behind = read_rows(tmp_path, start={path.name: (2, len(row.format("a") + middle))})
    assert set(behind.rows) == {"c"}


@pytest.mark.parametrize(
    "line", ['{"labels": []}', "[]", "1", '{"labels": ' + "[" * 100_000, '{"labels": {"a": 1}}']
)
def test_a_line_of_a_plan_that_is_not_a_cell_is_named(line: str) -> None:
    with pytest.raises(UsageError, match=r"plan\.jsonl:1"):
        list(planned_fields([line.encode()]))


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero"), Path.mkdir])
def test_only_files_are_hashed(make: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    make(path)
    with pytest.raises(OSError, match=r"robot\.xml"):
        file_hash(path)
    assert fingerprint._model(str(path)) == [ABSENT]
    assert loaded_sources._present(str(path)) == "absent"


@pytest.mark.parametrize("text", [b"[" * 100_000, b"\xff", b"[]", b'{"files": {"a": 1}}'])
def test_a_damaged_coverage_is_none(text: bytes, tmp_path: Path) -> None:
    (tmp_path / COVERAGE_FILE).write_bytes(text)
    assert read_coverage(tmp_path, []) is None


def test_a_damaged_note_on_a_recording_is_a_note(tmp_path: Path) -> None:
    damage: dict[str, Callable[[Path], object]] = {
        "a": lambda path: path.write_bytes(b"\xff"),
        "b": Path.mkdir,
        "c": os.mkfifo,
        "d": lambda path: path.write_text(" No scene. "),
    }
    for cell, make in damage.items():
        folder = tmp_path / "artifacts" / cell
        folder.mkdir(parents=True)
        make(folder / "no_recording.txt")
    *damaged, sound = recording_notes(RunFolder(tmp_path))
    assert [note.partition(":")[0] for note in damaged] == ["a", "b", "c"]
    assert sound == "No scene."


def test_a_plug_in_is_not_read_without_end(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    with path.open("wb") as file:
        file.truncate(LARGEST + 1)
    with pytest.raises(UsageError, match=r"mine\.py"):
        build("estimator", f"file:{path}:Mine")
    with pytest.raises(UsageError, match=r"mine\.py"):
        static_names().plugin("estimator", {"use": f"file:{path}:Mine"})


def test_a_lock_without_a_number_names_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sysid_bench.harness.work.folder_lock.ORPHAN_SECONDS", 0.0)
    with (tmp_path / ".lock").open("w+b") as file:
        file.write(b"\xff\xfe")
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX)
        with (
            pytest.raises(UsageError, match="Another runner"),
            RunFolder(tmp_path).lock(),
        ):
            pass


@pytest.mark.parametrize("name", ["x" * 5000, "x" * 5000 + ".toml", "a\0.toml", "a\0/b.xml"])
def test_a_name_that_no_file_can_have_is_refused(name: str) -> None:
    by_name: tuple[Callable[[str], object], ...] = (
        *(load_robot, package_folders.suite, open_run, show, build_plug_in),
        lambda name: read_table(Path(name)),
        lambda name: dh_table.read_table(Path(name)),
    )
    for read in by_name:
        with pytest.raises(SysidBenchError):
            read(name)
    with pytest.raises(OSError, match="name"):
        check_file(Path(name))


@pytest.mark.parametrize("module", ["", ".", ".ols", "json.", "json..tool"])
def test_a_module_without_a_name_is_refused(module: str) -> None:
    with pytest.raises(UsageError, match=r"estimator|module"):
        build("estimator", f"{module}:Mine")


def test_a_mesh_that_links_to_itself_is_refused(tmp_path: Path) -> None:
    (tmp_path / "part.obj").symlink_to("part.obj")
    (tmp_path / "robot.xml").write_text(
        '<mujoco><asset><mesh name="part" file="part.obj"/></asset><worldbody><body><joint/>'
        '<geom type="mesh" mesh="part"/></body></worldbody></mujoco>'
    )
    with pytest.raises(SysidBenchError, match=r"part\.obj"):
        load_robot(tmp_path / "robot.xml")


def build_plug_in(name: str) -> object:
    return build("estimator", f"file:{name}:Mine")
