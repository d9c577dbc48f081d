"""Laws of consolidation: frames are those of the rows, whatever happened to either."""

import json
import os
import random
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from harness_world import NAMES, read, small
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.commands.status import status
from sysid_bench.harness import consolidate as consolidation
from sysid_bench.harness import stored_run
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.consolidate import PlannedFields, build_frames
from sysid_bench.harness.coverage import COVERAGE_FILE, HEAD, FrameFiles, RowCounts, read_coverage
from sysid_bench.harness.frames import FRAMES, Frames, data_frames
from sysid_bench.harness.plan import cells_of_suite, offset_by_cell
from sysid_bench.harness.stored_run import RunFolder, frames_of_run
from sysid_bench.harness.work.row_files import (
    RowWriter,
    new_row_file,
    parse_row,
    read_rows,
    row_files,
    with_hash,
)
from sysid_bench.types import Row

ESTIMATORS = "".join(f'[[estimator]]\nuse = "{name}"\n' for name in ("ols", "wls"))
BODY = '[run]\nrepeats = 4\n[defaults]\nnoise = { tau = "1 %" }'
FILES = (*(f"{name}.parquet" for name in FRAMES), COVERAGE_FILE)

values = st.one_of(
    st.none(), st.booleans(), st.integers(-5, 5), st.integers(2**62, 2**65), st.floats(-1, 1),
    st.sampled_from(["", "a", "3"]), st.lists(st.integers(0, 3), max_size=2),
    st.dictionaries(st.sampled_from(["k", "l"]), st.floats(0, 1), max_size=2),
)  # fmt: skip
entries = st.dictionaries(st.sampled_from(["name", "body", "std"]), values, max_size=3)
contents = st.fixed_dictionaries(
    {},
    optional={
        **dict.fromkeys(("rank", "status", "noise", "stats", "sources"), values),
        "joints": st.lists(entries, max_size=3),
        "parameters_table": st.lists(entries, max_size=3),
    },
)


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    suite = read(small(BODY, estimators=ESTIMATORS))
    return RunFolder.new(tmp_path / "run", suite, cells_of_suite(suite, NAMES), {"python": "3"})


def store_rows(run: RunFolder, seed: int) -> None:
    """Append rows of some cells, one of them twice, to two files."""
    draw = random.Random(seed)
    with run.new_writer("a") as one, run.new_writer("b") as two:
        for cell in draw.choices(run.plan.cells, k=6):
            table = [{"name": f"m{i}", "true": draw.random(), "std": None} for i in range(3)]
            row = {
                **cell.first_fields,
                "status": draw.choice(["ok", "failed"]),
                "rank": draw.randrange(9),
            }
            tables = {"parameters_table": table, "joints": [{"name": "j", "relative": 0.5}]}
            more = {"fingerprint": str(seed), "losses": 1, "sources": {"a.py": "hash"}}
            draw.choice([one, two]).write({**row, **more, **tables})


def of_rows(run: RunFolder) -> Frames:
    rows = run.rows().rows
    return data_frames({**rows[c.id], **c.first_fields} for c in run.plan.cells if c.id in rows)


def assert_same(found: Frames, wanted: Frames) -> None:
    for name in FRAMES:
        a, b = getattr(found, name), getattr(wanted, name)
        pd.testing.assert_frame_equal(a, b, check_exact=True)
        for column in a:
            kinds = [list(map(type, frame[column])) for frame in (a, b)]
            assert kinds[0] == kinds[1], column


def assert_reads_all(run: RunFolder) -> None:
    """Frames and heads of a folder as opened anew are those of its rows."""
    again = RunFolder.open(run.path)
    assert_same(again.frames(), of_rows(again))
    stored, heads = again.rows(), again.first_fields()
    wanted = {
        cell: {k: v for k, v in row.items() if k in HEAD} for cell, row in stored.rows.items()
    }
    assert heads.rows == wanted
    assert json.loads(json.dumps(heads.rows)) == wanted  # plain numbers: jobs carry them on
    assert (heads.torn, heads.garbled) == (stored.torn, stored.garbled)
    places = offset_by_cell((run.path / "plan.jsonl").read_bytes().splitlines(keepends=True))
    assert again.row_counts() == RowCounts.of(places, stored.rows)


@settings(max_examples=20)
@given(st.lists(contents, min_size=1, max_size=5), st.randoms())
def test_parquet_gives_the_frames_of_any_rows(written: list[Row], draw: random.Random) -> None:
    """The rows come in any order, with a consolidation in between."""
    rows = [{"id": str(number), **row, "status": "ok"} for number, row in enumerate(written)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plan.jsonl").touch()
        heads = {row["id"]: {"id": row["id"]} for row in rows}
        order, half = draw.sample(rows, len(rows)), draw.randrange(len(rows))
        for part in (order[:half], order[half:]):
            with RowWriter(new_row_file(folder / "cells", "w")) as writer:
                for row in part:
                    writer.write(row)
            coverage = build_frames(folder, PlannedFields(heads, dict.fromkeys(heads, 0)))
        assert list(read_rows(folder / "cells").rows.values()) == order
        assert json.dumps(list(read_rows(folder / "cells").rows.values())) == json.dumps(order)
        assert_same(Frames(FrameFiles(folder, coverage).read), data_frames(rows))


@pytest.mark.parametrize("seed", range(3))
def test_appended_rows_are_read_beside_parquet(run: RunFolder, seed: int) -> None:
    for turn in range(3):
        store_rows(run, 3 * seed + turn)
        assert_reads_all(run)
        if turn != seed % 3:
            run.write_frames()
            assert_reads_all(run)


def test_all_rows_in_parquet_are_not_parsed_again(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    store_rows(run, 1)
    run.write_frames()
    wanted = of_rows(run)
    monkeypatch.setattr("sysid_bench.harness.work.row_files.parse_row", None)
    assert_same(run.frames(), wanted)
    assert len(run.first_fields().rows) == len(wanted.cells)


def test_the_status_of_consolidated_rows_reads_none_of_them(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in range(4):
        store_rows(run, seed)
    before = status(run.path)
    assert before.statuses.keys() == {"ok", "failed"}
    run.write_frames()
    with monkeypatch.context() as patch:
        patch.setattr("sysid_bench.harness.work.row_files.parse_row", None)
        patch.setattr("sysid_bench.harness.stored_run.FrameFiles", None)
        assert status(run.path) == before
    for file in row_files(run.path / "cells"):
        file.write_bytes(file.read_bytes().replace(b'"status":"', b'"status":"x'))
    assert status(run.path).open == before.cells


def test_counts_of_many_kinds_are_not_stored(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    store_rows(run, 1)
    wanted = status(run.path)
    monkeypatch.setattr("sysid_bench.harness.consolidate._MOST_KINDS", 0)
    for turn in range(2):
        run.write_frames()
        coverage = read_coverage(run.path, row_files(run.path / "cells"))
        assert coverage is not None
        assert coverage.counts is None
        assert status(run.path) == wanted, turn
        store_rows(run, 2)
        wanted = status(run.path)


def test_a_changed_byte_of_the_coverage_is_seen(run: RunFolder) -> None:
    store_rows(run, 1)
    run.write_frames()
    paths = row_files(run.path / "cells")
    file = run.path / COVERAGE_FILE
    text = file.read_bytes()
    assert read_coverage(run.path, paths) is not None
    for place in range(0, len(text) - 1, 7):
        file.write_bytes(text[:place] + bytes([text[place] ^ 1]) + text[place + 1 :])
        assert read_coverage(run.path, paths) is None, place


@pytest.mark.parametrize("seed", range(3))
def test_new_rows_join_the_earlier_files(
    run: RunFolder, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows that Parquet files hold are not parsed again, in whatever order cells come."""
    monkeypatch.setattr(consolidation, "_GROUP", 2)
    parsed: list[bytes] = []

    def parse(text: bytes, *, hashed: bool) -> Row | None:
        parsed.append(text)
        return parse_row(text, hashed=hashed)

    monkeypatch.setattr(consolidation, "parse_row", parse)
    draw = random.Random(seed)
    cells = draw.sample(run.plan.cells, len(run.plan.cells))
    for turn in range(3):
        with run.new_writer("w") as writer:
            for cell in cells[turn::3]:
                table = [{"name": f"m{i}", "true": draw.random()} for i in range(turn)]
                values = {"rank": 1 if turn == 0 else 0.5, "note": None if turn == 0 else "a"}
                writer.write(
                    {**cell.first_fields, "status": "ok", **values, "parameters_table": table}
                )
        run.write_frames()
        assert_reads_all(run)
        run.write_frames()
    assert len(parsed) == len(set(parsed)) == len(cells)


def test_files_that_hold_all_rows_stay(run: RunFolder) -> None:
    store_rows(run, 1)
    run.write_frames()
    before = [(run.path / name).stat().st_mtime_ns for name in FILES[:-1]]
    run.write_frames()
    assert [(run.path / name).stat().st_mtime_ns for name in FILES[:-1]] == before


def test_a_run_is_consolidated_as_it_grows(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sysid_bench.harness.stored_run.FEW_BYTES", 0)
    heard: list[str] = []
    with frames_of_run(run, (), lambda kind, data: heard.append(kind)) as on_event:
        store_rows(run, 1)
        on_event("row", {})
        assert not (run.path / COVERAGE_FILE).exists()
        on_event("task", {})
    assert heard == ["row", "task"]
    monkeypatch.setattr("sysid_bench.harness.work.row_files.parse_row", None)
    assert len(RunFolder.open(run.path).frames().cells) == len(run.first_fields().rows) > 0


@pytest.mark.parametrize("kept", range(len(FILES)))
def test_a_kill_between_the_files_loses_nothing(
    run: RunFolder, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first files of a consolidation are replaced, the others are not."""
    store_rows(run, 1)
    run.write_frames()
    old = {name: (run.path / name).read_bytes() for name in FILES}
    store_rows(run, 2)
    run.write_frames()
    for name in FILES[kept:]:
        (run.path / name).write_bytes(old[name])
    litter = run.path / ".cells.parquet.1"
    litter.touch()
    assert_reads_all(run)
    run.write_frames()
    assert_reads_all(run)
    assert not litter.exists()
    litter.touch()
    run.write_frames()  # also where no row is new
    assert not litter.exists()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("damage", ["absent", "cut", "flipped", "empty"])
def test_a_damaged_file_is_ignored(run: RunFolder, name: str, damage: str) -> None:
    store_rows(run, 1)
    run.write_frames()
    path = run.path / name
    data = path.read_bytes()
    middle = len(data) // 3
    changed = {
        "cut": data[:-7],
        "flipped": data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :],
        "empty": b"",
    }
    path.unlink()
    if damage in changed:
        path.write_bytes(changed[damage])
    assert_reads_all(run)
    run.write_frames()
    assert_reads_all(run)


def test_torn_and_garbled_lines_are_counted_once(run: RunFolder) -> None:
    store_rows(run, 1)
    files = sorted((run.path / "cells").iterdir())
    with files[0].open("ab") as one, files[1].open("ab") as two:
        one.write(b'\n{"id": 3}\nnonsense\n{"id": "tor')
        two.write(b'{"id": "of no plan", "joints": {"columns": {"a": [1], "b": []}}}\n')
    assert len(run.rows().garbled) == 3
    assert run.rows().torn == 1
    run.write_frames()
    assert_reads_all(run)
    store_rows(run, 2)
    assert_reads_all(run)


def test_a_last_row_without_its_newline_is_a_row(run: RunFolder) -> None:
    store_rows(run, 1)
    file = max((run.path / "cells").iterdir())
    row = {**run.plan.cells[0].first_fields, "status": "crash"}
    with file.open("ab") as out:
        out.write(with_hash(json.dumps(row).encode()))
    run.write_frames()
    assert run.first_fields().rows[row["id"]]["status"] == "crash"
    assert_reads_all(run)


def test_changed_row_files_make_parquet_invalid(run: RunFolder) -> None:
    store_rows(run, 1)
    run.write_frames()
    file = next(path for path in (run.path / "cells").iterdir() if path.stat().st_size)
    file.write_bytes(file.read_bytes().replace(b'"j"', b'"k"'))
    os.utime(file, (1, 1))
    assert_reads_all(run)
    run.write_frames()
    file.unlink()
    assert_reads_all(run)


def test_a_moved_copied_or_read_only_folder_is_read(run: RunFolder, tmp_path: Path) -> None:
    store_rows(run, 1)
    run.write_frames()
    moved = tmp_path / "moved"
    shutil.copytree(run.path, moved, copy_function=shutil.copy)
    assert_reads_all(RunFolder(moved))
    store_rows(RunFolder(moved), 2)
    for path in (moved, moved / "cells"):
        path.chmod(0o500)
    try:
        assert_reads_all(RunFolder(moved))
    finally:
        for path in (moved, moved / "cells"):
            path.chmod(0o700)


@pytest.mark.parametrize("writable", [True, False])
def test_many_rows_are_read_in_bounded_memory(
    run: RunFolder, writable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond some bytes frames come from Parquet files: in the folder, or in a temporary one."""
    store_rows(run, 1)
    wanted = of_rows(run)
    monkeypatch.setattr(stored_run, "FEW_BYTES", 0)
    monkeypatch.setattr(stored_run, "data_frames", None)
    if writable:
        assert_same(run.frames(), wanted)
    else:
        with run.lock():
            assert_same(run.frames(), wanted)
    assert (run.path / COVERAGE_FILE).is_file() == writable


def test_files_that_others_replace_stay_readable(run: RunFolder) -> None:
    store_rows(run, 1)
    run.write_frames()
    frames, wanted = run.frames(), of_rows(run)
    store_rows(run, 2)
    run.write_frames()
    assert_same(frames, wanted)


@pytest.mark.parametrize("kind", ["cells", "by_joint", "by_parameter", "by_std_from"])
@pytest.mark.parametrize("seed", range(2))
def test_frames_of_some_fields_have_the_lines_of_all(run: RunFolder, kind: str, seed: int) -> None:
    store_rows(run, seed)
    for _ in range(2):  # from rows, then from Parquet files
        frames = run.frames()
        whole = getattr(frames, kind)
        for names in (["robot"], ["torque_error", "joint"], list(whole.columns)):
            few = getattr(replace(frames, fields=frozenset(names)), kind)
            kept = [name for name in names if name in whole.columns]
            pd.testing.assert_frame_equal(few[kept], whole[kept])
        run.write_frames()


def test_rows_of_some_cells_and_fields(run: RunFolder) -> None:
    store_rows(run, 1)
    store_rows(run, 2)
    rows = run.rows().rows
    some = set(list(rows)[::2])
    assert run.rows(some).rows == {cell: rows[cell] for cell in rows if cell in some}
    few = read_rows(run.path / "cells", fields=("id", "status")).rows
    assert few == {c: {"id": c, "status": row["status"]} for c, row in rows.items()}
    assert {cell: run.row(cell) for cell in rows} == rows
    assert run.row("0") is None


def test_cells_that_differ_by_their_repeat_are_one_kind(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def others(cell: Any) -> str:
        data = cell.to_json()
        for key in ("id", "experiment"):
            del data[key]
        return json.dumps(data | {"spec": {**data["spec"], "repeat": 0}})

    kinds: dict[str, list[str]] = {}
    for cell in run.plan.cells:
        kinds.setdefault(others(cell), []).append(cell.id)
    plan = (run.path / "plan.jsonl").read_bytes()
    parsed: list[str] = []

    def key(cell: Cell) -> str:
        parsed.append(cell.id)
        return cell.id

    monkeypatch.setattr(Cell, "code_key", property(key))
    places = offset_by_cell(plan.splitlines(keepends=True))
    assert parsed == [ids[0] for ids in kinds.values()]
    assert list(places) == [cell.id for cell in run.plan.cells]
    for ids in kinds.values():
        assert {run.cells_at([places[cell]])[places[cell]].id for cell in ids} == {ids[0]}


def test_ids_and_heads_of_the_plan_need_no_cells(run: RunFolder) -> None:
    assert run.planned == tuple(cell.id for cell in run.plan.cells)
    spaced = [
        json.dumps(cell.to_json(), indent=None, separators=(",", ":")) for cell in run.plan.cells
    ]
    (run.path / "plan.jsonl").write_text("\n".join(spaced))
    assert RunFolder(run.path).planned == run.planned
