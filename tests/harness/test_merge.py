"""Laws of shards: together they are the plan, and merged they are the run of one machine."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest
from harness_world import FULL, NAMES, read, small
from hypothesis import given
from hypothesis import strategies as st

import sysid_bench
from sysid_bench.errors import UsageError
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.merge import merge
from sysid_bench.harness.plan import Plan, Shard, cells_of_suite
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.work.row_files import read_rows, with_hash, without_hash
from sysid_bench.words import MACHINE_FIELDS

CALL = "harness_tasks:execute"


def go(out: Path, **settings: Any) -> Path:
    run(read(FULL), out, jobs=2, names=NAMES, call=CALL, **settings)
    return out


Copy = Callable[[str], Path]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs made once: the whole plan by two machines, and its two halves."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("one", "two"):
        go(folder / name)
    for i in (1, 2):
        go(folder / f"half{i}", shard=Shard(i, 2))
    return folder


@pytest.fixture
def copy(runs: Path, tmp_path: Path) -> Copy:
    """The copy of a run of that name, for one test to change."""
    return lambda name: Path(shutil.copytree(runs / name, tmp_path / name))


def rows(folder: Path) -> dict[str, Any]:
    stored = read_rows(folder / "cells").rows
    return {
        name: {key: value for key, value in row.items() if key not in MACHINE_FIELDS}
        for name, row in stored.items()
    }


def falsify(folder: Path, cell: str, **fields: Any) -> None:
    """Replace the row of a cell by one with other results, as a faulty machine would write it."""
    for file in (folder / "cells").glob("*.jsonl"):
        found = [json.loads(without_hash(line)) for line in file.read_bytes().splitlines()]
        new = [row | fields if row["id"] == cell else row for row in found]
        file.write_bytes(b"".join(with_hash(json.dumps(row).encode()) + b"\n" for row in new))


def add_row(folder: Path, cell: str, **fields: Any) -> Path:
    """Add a row of a cell in a file of its own, as of another worker, with other values."""
    row = read_rows(folder / "cells").rows[cell] | fields
    file = folder / "cells" / "999999-other.jsonl"
    file.write_bytes(with_hash(json.dumps(row).encode()) + b"\n")
    return file


@pytest.mark.parametrize("count", [1, 2, 3, 7, 100])
def test_shards_are_disjoint_whole_experiments_and_complete(count: int) -> None:
    cells = cells_of_suite(read(FULL), NAMES).cells
    parts = [Shard(index, count).experiments(cells) for index in range(1, count + 1)]
    everything = {cell.experiment for cell in cells}
    assert sorted(name for part in parts for name in part) == sorted(everything)
    assert sum(not part for part in parts) == max(0, count - len(everything))


@given(
    st.lists(st.lists(st.floats(0.01, 1e4), min_size=1, max_size=3), min_size=1, max_size=20),
    st.integers(1, 8),
    st.randoms(use_true_random=False),
)
def test_shards_cost_alike(costs: list[list[float]], count: int, order: Random) -> None:
    """Parts differ by one experiment at most, and no machine needs more than the plan to know."""
    spec = cells_of_suite(read(small()), NAMES).cells[0].spec
    cells = [
        Cell(replace(spec, repeat=number), {"use": f"method{place}"}, {}, {}, seconds)
        for number, parts in enumerate(costs)
        for place, seconds in enumerate(parts)
    ]
    shards = [Shard(index, count) for index in range(1, count + 1)]
    dealt = [shard.experiments(cells) for shard in shards]
    total = {cells[0].experiment: 0.0}
    for cell in cells:
        total[cell.experiment] = total.get(cell.experiment, 0.0) + cell.seconds
    loads = [sum(total[name] for name in part) for part in dealt]
    for part, load in zip(dealt, loads, strict=True):
        assert not part or load - min(total[name] for name in part) <= min(loads) * (1 + 1e-9)
    order.shuffle(cells)
    read_again = Plan.from_json_lines(line.encode() for line in Plan(tuple(cells)).to_json_lines())
    assert [shard.experiments(read_again.cells) for shard in shards] == dealt


def test_a_shard_without_cells_is_a_run(tmp_path: Path) -> None:
    """A matrix with more jobs than experiments succeeds; a selection without cells does not."""
    suite = read(small("run.repeats = 2\ndefaults.noise = { tau = '1 %' }"))
    done = [
        run(suite, tmp_path / f"part{i}", names=NAMES, call=CALL, shard=Shard(i, 4))
        for i in range(1, 5)
    ]
    assert (
        sorted((result.exit_code, result.asked) for result in done) == [(0, 0)] * 2 + [(0, 1)] * 2
    )
    merged = merge([result.folder.path for result in done], tmp_path / "merged")
    assert (merged.exit_code, merged.rows, merged.open) == (0, 2, 0)
    none = run(
        suite, tmp_path / "none", names=NAMES, call=CALL, shard=Shard(1, 4),
        select='robot == "nobody"',
    )  # fmt: skip
    assert none.exit_code == 4


@pytest.mark.parametrize("text", ["", "2", "0/3", "4/3", "a/b", "1/0", "-1/3", "1/2/3", "1.0/2"])
def test_a_shard_that_does_not_exist(text: str) -> None:
    with pytest.raises(UsageError, match="shard"):
        Shard.parse(text)


@pytest.mark.long
def test_three_merged_shards_are_the_single_run(tmp_path: Path, copy: Copy) -> None:
    whole = copy("one")
    parts = [go(tmp_path / f"part{i}", shard=Shard(i, 3)) for i in (1, 2, 3)]
    result = merge(parts, tmp_path / "merged")
    assert (result.exit_code, result.rows, result.open, result.twice) == (0, 56, 0, 0)
    assert rows(tmp_path / "merged") == rows(whole)
    # It is a run like any other: nothing is left to run, and its tables are there.
    assert run(tmp_path / "merged", names=NAMES, call=CALL).asked == 0
    assert (tmp_path / "merged" / "cells.parquet").is_file()


def test_what_two_machines_computed_equally_is_counted(tmp_path: Path, copy: Copy) -> None:
    parts = [copy(name) for name in ("one", "two")]
    assert merge(parts, tmp_path / "merged").twice == 56


@pytest.mark.parametrize("place", [0, 30, -1])
def test_a_falsified_row_is_found_and_nothing_written(
    tmp_path: Path, copy: Copy, place: int
) -> None:
    parts = [copy(name) for name in ("one", "two")]
    cell = list(rows(parts[0]))[place]
    falsify(parts[1], cell, torque_error=0.25)
    result = merge(parts, tmp_path / "merged")
    assert (result.exit_code, result.contradictions) == (1, (cell,))
    assert not (tmp_path / "merged").exists()


@pytest.mark.parametrize(
    ("share", "condition", "verdict"),
    [
        (5e-13, 100.0, "rounded"), (5e-13, 1e8, "rounded"), (5e-8, 1e8, "rounded"),
        (5e-12, 1e8, "rounded"), (2e-10, 100.0, "contradicting"), (2e-6, 1e8, "contradicting"),
        (0.0, 100.0, "equal"),
    ],
)  # fmt: skip
def test_rows_of_another_processor_are_equal_up_to_rounding(
    tmp_path: Path, copy: Copy, share: float, condition: float, verdict: str
) -> None:
    """Relative differences up to 1e-12, or 1e-15 of the condition number; counts are equal."""
    parts = [copy(name) for name in ("one", "two")]
    cell = next(iter(rows(parts[0])))
    tables = {"joints": [{"name": "j", "rmse": 3.0}], "iterations": 7}
    falsify(parts[0], cell, torque_error=0.25, condition=condition, **tables)
    table = {"joints": [{"name": "j", "rmse": 3.0 * (1 - share)}], "iterations": 7}
    falsify(parts[1], cell, torque_error=0.25 * (1 + share), condition=condition, **table)
    result = merge(parts, tmp_path / "merged")
    found = "contradicting" if result.contradictions else "rounded" if result.rounded else "equal"
    assert found == verdict
    assert result.twice == 56 - (verdict == "contradicting")
    assert (tmp_path / "merged").exists() == (verdict != "contradicting")


def test_exact_errors_differ_by_rounding_and_counts_by_nothing(tmp_path: Path, copy: Copy) -> None:
    parts = [copy(name) for name in ("one", "two")]
    first, second, *_ = rows(parts[0])
    for number, folder in enumerate(parts):
        falsify(folder, first, gap=(number + 1) * 3e-16, torque_error=(4 - number) * 1e-12)
    assert merge(parts, tmp_path / "merged").rounded == 1
    for number, folder in enumerate(parts):
        falsify(folder, second, iterations=number + 7)
    assert merge(parts, tmp_path / "other").contradictions == (second,)


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize(
    ("fields", "contradicts"),
    [
        ({}, False), ({"torque_error": 0.25 * (1 + 5e-13)}, False), ({"torque_error": 0.5}, True),
        ({"iterations": 8}, True), ({"seconds": 9.0, "machine": "b"}, False),
        ({"status": "failed", "torque_error": 0.5}, False),
        ({"fingerprint": "of other code", "torque_error": 0.5}, False),
    ],
)  # fmt: skip
def test_ok_rows_of_one_run_that_contradict_are_named(
    tmp_path: Path, copy: Copy, fields: dict[str, Any], contradicts: bool, number: int
) -> None:
    """Those that are equal, equal up to rounding, or of other code do not."""
    parts = [copy(f"half{i}") for i in (1, 2)]
    cell = list(rows(parts[number]))[-1]
    falsify(parts[number], cell, torque_error=0.25, iterations=7, condition=100.0)
    file = add_row(parts[number], cell, **fields)
    result = merge(parts, tmp_path / "merged", mixed=True)
    assert result.contradictions == ((cell,) if contradicts else ())
    assert result.exit_code == contradicts
    assert (result.twice, result.rounded) == (0, 0)
    if contradicts:
        _, last = result.places[cell]
        assert last == f"{file}:1"
        summary = sysid_bench.merge(parts, tmp_path / "merged").summary()
        assert cell in summary
        assert last in summary


@pytest.mark.parametrize("place", range(4))
def test_a_row_that_was_changed_is_found_where_no_other_run_has_it(
    tmp_path: Path, copy: Copy, place: int
) -> None:
    """In whatever field, by an editor or a program; the run repairs itself, with this row alone."""
    parts = [copy(f"half{i}") for i in (1, 2)]
    file = sorted((parts[1] / "cells").glob("*.jsonl"))[0]
    lines = file.read_text().splitlines()
    number = place % len(lines)
    row = json.loads(lines[number])
    name = ("torque_error", "status", "reason", "fingerprint")[place]
    changes = {"torque_error": 0.25, "status": "failed", "reason": "none", "fingerprint": "0"}
    lines[number] = json.dumps(row | {name: changes[name]})
    file.write_text("\n".join(lines) + "\n")
    result = merge(parts, tmp_path / "merged")
    assert (result.exit_code, result.changed) == (1, (f"{file}:{number + 1}",))
    assert not (tmp_path / "merged").exists()
    repaired = run(parts[1], names=NAMES, call=CALL, shard=Shard(2, 2))
    assert repaired.asked == 1
    assert f"{file.name}:{number + 1}" in " ".join(repaired.notes)
    assert merge(parts, tmp_path / "merged").exit_code == 0


@pytest.mark.parametrize("end", ["\n", ""])
@pytest.mark.parametrize("place", [0, 1, -1])
def test_a_row_without_its_hash_is_refused(
    tmp_path: Path, copy: Copy, place: int, end: str
) -> None:
    """Wherever rows are read; a run of before rows had hashes stays readable."""
    parts = [copy(f"half{i}") for i in (1, 2)]
    whole = len(RunFolder(parts[1]).rows().rows)
    file = max((parts[1] / "cells").glob("*.jsonl"), key=lambda path: path.stat().st_size)
    lines = file.read_bytes().splitlines()
    row = json.loads(without_hash(lines[place])) | {"torque_error": 0.25}
    lines[place] = json.dumps(row).encode()
    file.write_bytes(b"\n".join(lines) + end.encode())
    assert len(RunFolder(parts[1]).rows().rows) == whole - 1
    assert RunFolder(parts[1]).row(row["id"]) is None
    assert row["id"] not in RunFolder(parts[1]).first_fields().rows
    assert sum(RunFolder(parts[1]).row_counts().rows.values()) == whole - 1
    assert row["id"] not in set(RunFolder(parts[1]).cells["id"])
    where = f"{file}:{range(1, len(lines) + 1)[place]}"
    result = merge(parts, tmp_path / "merged")
    assert (result.exit_code, result.changed) == (1, (where,))
    frozen = parts[1] / "run.toml"
    frozen.write_text(frozen.read_text().replace('rows = "hashed"', ""))
    assert len(RunFolder(parts[1]).rows().rows) == whole
    assert run(parts[1], names=NAMES, call=CALL, shard=Shard(2, 2)).asked == 0
    assert merge(parts, tmp_path / "merged").exit_code == 0
    assert RunFolder(tmp_path / "merged").has_hashes


def test_a_run_of_an_earlier_version_that_goes_on_keeps_its_rows(copy: Copy) -> None:
    half = copy("half1")
    frozen = half / "run.toml"
    frozen.write_text(frozen.read_text().replace('rows = "hashed"', ""))
    for file in (half / "cells").glob("*.jsonl"):
        file.write_bytes(
            b"".join(without_hash(line) + b"\n" for line in file.read_bytes().splitlines())
        )
    go(half)
    assert len(RunFolder(half).rows().rows) == len(RunFolder(half).planned)
    assert RunFolder(half).rows().garbled == ()


@pytest.mark.parametrize("order", [1, -1])
def test_an_ok_row_is_kept_before_any_other(tmp_path: Path, copy: Copy, order: int) -> None:
    parts = [copy(name) for name in ("one", "two")]
    cell = next(iter(rows(parts[0])))
    falsify(parts[1], cell, status="timeout", reason="a slow machine", torque_error=None)
    result = merge(parts[::order], tmp_path / "merged")
    assert result.exit_code == 0
    assert rows(tmp_path / "merged")[cell]["status"] == "ok"


def test_runs_that_cannot_be_merged(tmp_path: Path, copy: Copy) -> None:
    one = copy("one")
    other = read(FULL.replace("20261121", "1"))
    run(other, tmp_path / "other", names=NAMES, call=CALL, limit=2)
    with pytest.raises(UsageError, match="another plan"):
        merge([one, tmp_path / "other"], tmp_path / "merged")
    with pytest.raises(UsageError, match="is a run already"):
        merge([one], tmp_path / "other")
    with pytest.raises(UsageError, match="is not a run"):
        merge([one, tmp_path / "nothing"], tmp_path / "merged")
    two = copy("two")
    falsify(two, next(iter(rows(two))), fingerprint="another")
    with pytest.raises(UsageError, match="--mixed"):
        merge([one, two], tmp_path / "merged")
    assert merge([one, two], tmp_path / "merged", mixed=True).exit_code == 0
