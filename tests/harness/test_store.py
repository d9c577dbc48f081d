"""Laws of the run folder: a stored row is never lost, a broken line is never fatal."""

import fcntl
import json
import math
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
import pytest
from harness_world import FULL, NAMES, read, small
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.canonical_json import canonical, plain
from sysid_bench.errors import UsageError
from sysid_bench.harness.frames import data_frames
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import with_rows
from sysid_bench.harness.work import row_files
from sysid_bench.harness.work.row_files import (
    RowWriter,
    new_row_file,
    parse_row,
    read_rows,
    stored_rows,
    with_hash,
    without_hash,
)


def make(folder: Path, text: str = FULL) -> RunFolder:
    suite = read(text)
    return RunFolder.new(folder, suite, cells_of_suite(suite, NAMES), {"python": "3"})


def test_a_run_folder_records_what_it_was_made_of(tmp_path: Path) -> None:
    make(tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    assert run.suite == with_rows(read(FULL), hashed=True)
    assert run.plan.cells == cells_of_suite(read(FULL), NAMES).cells
    assert run.environment == {"python": "3"}
    assert run.rows().rows == {}
    assert len(run.cells) == 0


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is not a run"):
        RunFolder.open(tmp_path)


def test_the_same_plan_goes_on_and_another_is_refused(tmp_path: Path) -> None:
    run = make(tmp_path)
    with run.new_writer("w") as writer:
        writer.write({"id": run.plan.cells[0].id, "status": "ok"})
    again = make(tmp_path, FULL.replace("60 s", "30 s").replace("Geodesic (ours)", "Ours"))
    assert len(again.rows().rows) == 1
    assert again.suite.run.timeout == "30 s"
    with pytest.raises(
        UsageError, match=r"holds another run.*56 of its cells.*seed.*Choose another"
    ):
        make(tmp_path, FULL.replace("20261121", "5"))
    assert RunFolder.open(tmp_path).suite.run.timeout == "30 s"


def test_the_last_row_of_an_id_wins_over_all_files(tmp_path: Path) -> None:
    for turn in range(3):
        for name in ("worker2", "worker1"):
            with RowWriter(new_row_file(tmp_path, name)) as writer:
                writer.write({"id": "a", "status": "ok", "turn": turn, "by": name})
                writer.write({"id": name, "status": "ok", "turn": turn})
    stored = read_rows(tmp_path)
    assert stored.rows["a"] == {"id": "a", "status": "ok", "turn": 2, "by": "worker1"}
    assert {row["turn"] for row in stored.rows.values()} == {2}
    assert len(list(tmp_path.iterdir())) == 6


lines = st.sampled_from(
    [
        b'{"id": "x", "status": "ok"}',
        b'{"id": "x"}',
        b'{"id": 3}',
        b"[1]",
        b"{",
        b"\xff\xfe",
        b"null",
        b'"id"',
        b"[" * 9999,
    ]
)


@given(st.lists(lines, max_size=6), st.integers(0, 30))
def test_whole_rows_survive_whatever_stands_between_them(junk: list[bytes], cut: int) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        row = json.dumps({"id": "kept", "status": "ok", "value": 1}).encode()
        text = b"\n".join([*junk, row]) + b"\n" + row.replace(b"kept", b"torn")[:cut]
        (Path(name) / "000001-w.jsonl").write_bytes(text)
        stored = read_rows(Path(name))
        bad = [line for line in junk if line != b'{"id": "x", "status": "ok"}']
        assert stored.rows["kept"] == {"id": "kept", "status": "ok", "value": 1}
        assert len(stored.garbled) == len(bad)
        assert stored.torn == (cut > 0 and "torn" not in stored.rows)


def test_a_disk_that_gives_an_error_is_named(tmp_path: Path) -> None:
    run = make(tmp_path, small())
    (tmp_path / "cells" / "000001-w.jsonl").symlink_to("/proc/self/mem")
    for look in (run.rows, run.row_counts, run.frames):
        with pytest.raises(UsageError, match=r"000001-w\.jsonl' cannot be read .*remove it"):
            look()


def test_a_row_is_on_file_when_append_returns(tmp_path: Path) -> None:
    writer = RowWriter(new_row_file(tmp_path, "w"))
    for number in range(5):
        writer.write({"id": str(number), "status": "ok"})
        assert set(stored_rows(writer.path)) == {str(n) for n in range(number + 1)}
    writer.close()
    writer.close()


stored_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(st.characters()) | st.just("\ud800")
    | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)  # fmt: skip


@given(stored_values)
def test_any_value_is_read_as_it_was_written(value: Any) -> None:
    line = with_hash(json.dumps({"id": "a", "status": "ok", "value": value}).encode())
    row = parse_row(line + b"\n")
    assert json.dumps(row) == json.dumps({"id": "a", "status": "ok", "value": value})


@given(st.data())
def test_a_changed_byte_makes_a_line_another_one(data: st.DataObject) -> None:
    """No row, or where the name of the hash itself is hit, that of a line without one."""
    row = {"id": "a", "status": "ok", "value": 0.123456789, "text": "abc"}
    line = bytearray(with_hash(json.dumps(row).encode()))
    place = data.draw(st.integers(0, len(line) - 1))
    line[place] = data.draw(st.integers(32, 126).filter(lambda byte: byte != line[place]))
    found = parse_row(bytes(line))
    assert found is None or {key: found[key] for key in row} == row


def test_a_row_that_is_no_json_leaves_no_trace(tmp_path: Path) -> None:
    with RowWriter(new_row_file(tmp_path, "w")) as writer:
        with pytest.raises(TypeError, match="cannot be stored as JSON"):
            writer.write({"id": "a", "value": object()})
        writer.write({"id": "b", "status": "ok"})
    assert read_rows(tmp_path).garbled == ()
    assert set(stored_rows(writer.path)) == {"b"}


def test_a_line_that_is_too_long_is_no_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_files, "LARGEST_ROW", 100)
    path = new_row_file(tmp_path, "w")
    row = b'{"id": "%s", "status": "ok", "x": "%s"}\n'
    path.write_bytes(row % (b"a", b"") + row % (b"b", b"x" * 950) + row % (b"c", b""))
    with path.open("ab") as file:
        file.write(row[:-1] % (b"d", b"x" * 70) + b"x" * 500)
    stored = read_rows(tmp_path)
    assert list(stored.rows) == ["a", "c"]
    assert (stored.torn, stored.garbled) == (1, (f"{path.name}:2",))
    assert [line.end for line in row_files.lines(path)][-1] == path.stat().st_size
    with (
        RowWriter(new_row_file(tmp_path, "w")) as writer,
        pytest.raises(UsageError, match="MB are stored at most"),
    ):
        writer.write({"id": "e", "status": "ok", "x": "x" * 100})
    assert writer.path.read_bytes() == b""


def test_numbers_that_are_none_become_none() -> None:
    row = {
        "a": np.float64(np.nan),
        "b": math.inf,
        "c": np.arange(2),
        "d": (np.bool_(True), np.int64(3)),
    }
    assert plain(row) == {"a": None, "b": None, "c": [0, 1], "d": [True, 3]}


json_values: Any = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)


@given(st.dictionaries(st.text(), json_values))
def test_canonical_text_is_that_of_the_value_alone(value: dict[str, Any]) -> None:
    assert canonical(dict(reversed(value.items()))) == canonical(value)
    assert json.loads(canonical(value)) == value


odd_values = st.one_of(
    json_values,
    st.floats(),
    st.floats(width=32).map(np.float32),
    st.floats().map(np.float64),
    st.integers(-(2**40), 2**40).map(np.int64),
    st.booleans().map(np.bool_),
    st.lists(st.floats(), max_size=3).map(np.array),
    st.tuples(st.integers(-(2**80), 2**80), st.text(st.characters())),
    st.dictionaries(st.integers() | st.none() | st.floats(), st.floats(), max_size=2),
    st.dictionaries(st.text(), st.floats(), max_size=2).map(MappingProxyType),
    st.sampled_from(["\udc80", "\udfff file"]),
)


@given(st.dictionaries(st.text(), odd_values, max_size=5))
def test_a_row_is_written_as_plain_json_says(
    tmp_path_factory: pytest.TempPathFactory, value: dict[str, Any]
) -> None:
    row = {**value, "id": "a", "status": "ok", "joints": None, "parameters_table": None}
    with RowWriter(new_row_file(tmp_path_factory.mktemp("cells"), "w")) as writer:
        writer.write(row)
    (line,) = writer.path.read_bytes().splitlines()
    assert json.loads(without_hash(line)) == plain(row)


@pytest.mark.parametrize("name", ["cells.parquet", "parameters.parquet", "consolidated.json"])
def test_a_folder_in_place_of_a_table_is_named(tmp_path: Path, name: str) -> None:
    run = make(tmp_path, small())
    with run.new_writer("w") as writer:
        writer.write({**run.plan.cells[0].first_fields, "status": "ok"})
    (tmp_path / name).mkdir()
    with pytest.raises(UsageError, match="all rows are stored"):
        run.write_frames()
    assert len(run.rows().rows) == 1
    (tmp_path / name).rmdir()
    run.write_frames()
    assert len(pd.read_parquet(tmp_path / "cells.parquet")) == 1


def test_consolidation_keeps_every_number(tmp_path: Path) -> None:
    run = make(tmp_path)
    with run.new_writer("w") as writer:
        for number, cell in enumerate(reversed(run.plan.cells)):
            joints = [{"name": f"j{i}", "rmse_test": i / 7} for i in range(3)]
            table = [{"body": "b", "name": "m", "true": 1.0, "estimate": None, "std": 0.1}]
            row = {
                **cell.first_fields,
                "noise": "old label",
                "status": "ok",
                "torque_error": number / 3,
            }
            more = {"versions": {"numpy": "2"}, "warnings": ["a"], "rank": number or None}
            writer.write({**row, **more, "joints": joints, "parameters_table": table})
        writer.write({"id": "of no plan", "status": "ok"})
    run.write_frames()
    cells = pd.read_parquet(tmp_path / "cells.parquet")
    assert list(cells["id"]) == [cell.id for cell in run.plan.cells]
    assert list(cells["torque_error"]) == [n / 3 for n in reversed(range(len(cells)))]
    assert list(cells.columns[:3]) == ["id", "experiment", "robot"]
    assert set(cells["noise"]) == {cell.labels["noise"] for cell in run.plan.cells}
    assert set(cells["versions.numpy"]) == {"2"}
    by_joint = pd.read_parquet(tmp_path / "joints.parquet")
    assert len(by_joint) == 3 * len(cells)
    assert list(by_joint["rmse_test"][:3]) == [0, 1 / 7, 2 / 7]
    parameters = pd.read_parquet(tmp_path / "parameters.parquet")
    assert set(parameters["id"]) == set(cells["id"])
    pd.testing.assert_frame_equal(run.cells, cells, check_dtype=False)
    hidden = {path.name for path in tmp_path.iterdir() if path.name.startswith(".")}
    assert hidden <= {".lock"}  # no temporary files


def test_two_runners_in_one_folder_are_refused(tmp_path: Path) -> None:
    run = make(tmp_path, small())
    with run.lock(), pytest.raises(UsageError, match=f"process {os.getpid()}"), run.lock():
        pytest.fail("two runners at once")
    with run.lock():
        pass


@pytest.mark.parametrize("target", [".", "absent", ".lock", "/dev/zero", "/proc/self/mem", ""])
def test_what_cannot_lock_is_refused(tmp_path: Path, target: str) -> None:
    run = make(tmp_path, small())
    lock = tmp_path / ".lock"
    lock.unlink()
    lock.symlink_to(target) if target else os.mkfifo(lock)
    with pytest.raises(UsageError, match=r"\.lock'.*remove it"), run.lock():
        pytest.fail("nothing is locked")
    lock.unlink()
    with run.lock():
        pass


def test_a_lock_of_the_dead_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sysid_bench.harness.work.folder_lock.ORPHAN_SECONDS", 0.1)
    run = make(tmp_path, small())
    with (tmp_path / ".lock").open("w") as held:
        held.write("999999999")  # no process has this number
        held.flush()
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="Another runner"), run.lock():
            pytest.fail("the orphan still holds it")
    with run.lock():
        pass


def test_verdicts_by_parameter_lose_no_cell() -> None:
    def row(number: int, names: str, **more: Any) -> dict[str, Any]:
        table = [{"name": name, "identifiable": "none", "body": "b"} for name in names]
        return {"id": f"c{number}", "status": "ok", "parameters_table": table, **more}

    failed = {"id": "c0", "status": "failed", "reason": "why"}
    frame = data_frames([failed, row(1, "mx"), row(2, "m"), row(3, "")]).by_parameter
    assert list(zip(frame["id"], frame["parameter"], strict=True)) == [
        ("c0", "m"), ("c0", "x"), ("c1", "m"), ("c1", "x"), ("c2", "m"), ("c3", "m"), ("c3", "x"),
    ]  # fmt: skip
    assert frame.loc[frame["id"] == "c1", "verdict"].tolist() == ["none", "none"]
    assert frame.loc[frame["id"] == "c0", "verdict"].isna().all()
    assert data_frames([failed]).by_parameter["status"].tolist() == ["failed"]


def test_coverage_has_a_line_for_every_way_to_report_it_and_loses_no_cell() -> None:
    def cell(number: int, estimator: str, status: str = "ok", **coverage: float) -> dict[str, Any]:
        made: dict[str, Any] = {"id": f"{number}", "estimator": estimator, "status": status}
        return {**made, "coverage": coverage} if coverage else made

    rows = [
        cell(0, "wls", periods=0.9, textbook=0.5),
        cell(1, "wls", "failed"),
        cell(2, "huber", textbook=0.7),
        cell(3, "huber", "timeout"),
        cell(4, "mute", "crash"),
        cell(5, "silent"),
    ]
    frame = data_frames(rows).by_std_from
    found = {(row["id"], row["std_from"]): row["coverage"] for _, row in frame.iterrows()}
    assert found.keys() == {
        ("0", "periods"), ("0", "textbook"), ("1", "periods"), ("1", "textbook"),
        ("2", "textbook"), ("3", "textbook"), ("4", "periods"), ("4", "textbook"),
    }  # fmt: skip
    assert (found["0", "periods"], found["0", "textbook"], found["2", "textbook"]) == (
        0.9,
        0.5,
        0.7,
    )
    exact = data_frames([cell(0, "wls"), cell(1, "wls", "failed")]).by_std_from
    assert exact["std_from"].tolist() == ["none", "none"]
    assert exact["coverage"].isna().all()
