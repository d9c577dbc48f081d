"""A row that was changed after it was written is named, by whatever shows or keeps its run."""

import json
from pathlib import Path
from typing import Any

import pytest
from harness_world import FULL, NAMES

from sysid_bench import baseline_save, baseline_update, status
from sysid_bench.commands.run_folder import open_run, row_notes
from sysid_bench.errors import UsageError
from sysid_bench.harness.merge import contradictions
from sysid_bench.harness.run import run
from sysid_bench.harness.work.row_files import with_hash, without_hash


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "suite.toml").write_text(FULL)
    return run_here(tmp_path / "suite.toml", tmp_path / "run", limit=6)


def run_here(source: Path, out: Path | None = None, **choice: Any) -> Path:
    done = run(source, out, jobs=1, names=NAMES, call="harness_tasks:execute", **choice)
    return done.folder.path


def rows_file(folder: Path) -> Path:
    (file,) = (one for one in (folder / "cells").glob("*.jsonl") if one.stat().st_size)
    return file


def edit(folder: Path, number: int, old: bytes, new: bytes) -> str:
    """Change a line without its hash; return the id of its cell."""
    file = rows_file(folder)
    lines = file.read_bytes().splitlines(keepends=True)
    assert old in lines[number]
    cell = str(json.loads(lines[number])["id"])
    lines[number] = lines[number].replace(old, new, 1)
    file.write_bytes(b"".join(lines))
    return cell


@pytest.mark.parametrize("hidden", [False, True])
def test_a_changed_row_is_named_and_no_baseline_is_made_of_it(folder: Path, hidden: bool) -> None:
    baseline = folder.parent / "baseline.json"
    baseline_save(folder, baseline)
    assert status(folder).damaged == []
    if hidden:  # its frames are gone, too
        for file in folder.glob("*.parquet"):
            file.unlink()
    cell = edit(folder, 2, b'"ok"', b'"failed"')
    (place,) = status(folder).damaged
    assert place == f"{rows_file(folder).name}:3 (cell {cell})"
    assert place in status(folder).summary()
    assert cell in row_notes(open_run(folder))
    for write in (baseline_save, baseline_update):
        with pytest.raises(UsageError, match=cell):
            write(folder, baseline)
    # Its cell runs again, and the line counts no more.
    run_here(folder)
    assert status(folder).damaged == []
    baseline_save(folder, baseline)


def test_a_line_without_an_id_is_named_while_cells_are_open(folder: Path) -> None:
    file = rows_file(folder)
    file.write_bytes(b"not JSON\n" + file.read_bytes())
    assert status(folder).damaged == [f"{file.name}:1"]
    run_here(folder)
    assert status(folder).damaged == []


def test_ok_rows_of_one_cell_that_differ_are_named(folder: Path) -> None:
    file = rows_file(folder)
    first, second = (json.loads(without_hash(one)) for one in file.read_bytes().splitlines()[:2])
    other = folder / "cells" / "000009-worker9.jsonl"

    other.write_bytes(with_hash(json.dumps(first).encode()) + b"\n")
    assert contradictions(open_run(folder)) == []  # the same once more
    changed = second | {"torque_error": 0.125}
    other.write_bytes(other.read_bytes() + with_hash(json.dumps(changed).encode()) + b"\n")
    assert contradictions(open_run(folder)) == [second["id"]]
    # Rows of other code may differ, and so does what was not ok.
    for change in ({"fingerprint": "0" * 16}, {"status": "failed"}):
        other.write_bytes(with_hash(json.dumps(changed | change).encode()) + b"\n")
        assert contradictions(open_run(folder)) == []
