"""Laws of storage: where the machine takes no more, a run ends with one sentence and an honest exit
code, loses no stored row, and completes with the same command once there is room again."""

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from harness_world import FULL, NAMES

from sysid_bench.harness.run import RunResult, run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.work.row_files import RowWriter, new_row_file, read_rows, stored_rows
from sysid_bench.harness.work.worker_process import BoundedLog
from sysid_bench.words import MACHINE_FIELDS
from tests.faults.runners import left_behind, start, stored_lines, wait_for

CELLS = 56
PAGE = os.sysconf("SC_PAGE_SIZE")


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    file = tmp_path / "suite.toml"
    file.write_text(FULL)
    return file


def run_here(suite: Path, out: Path, **choice: Any) -> RunResult:
    return run(suite, out, jobs=1, names=NAMES, call="harness_tasks:execute", **choice)


def mount(*words: str) -> None:
    done = subprocess.run(["mount", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"This machine mounts nothing for this user ({done.stderr.strip()}).")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    mount("-t", "tmpfs", "-o", "size=1m", "none", str(folder))
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def fill(folder: Path, left: int) -> Path:
    """Leave this many bytes of a disk."""
    ballast = folder / "ballast"
    with ballast.open("wb", buffering=0) as file:
        while True:
            try:
                file.write(bytes(PAGE))
            except OSError:
                break
        file.truncate(max(0, file.tell() - left))
    return ballast


def ended(suite: Path, out: Path, jobs: int = 1) -> tuple[int, str]:
    """Exit code and errors of a runner."""
    with start(suite, out, jobs) as runner:
        _, errors = runner.communicate()
    return runner.returncode, errors


def is_one_sentence(errors: str) -> bool:
    return errors.startswith("sysid-bench: ") and errors.count("\n") == 1


@pytest.mark.parametrize(("pages", "resumed"), [(0, False), (2, False), (4, True)])
def test_a_full_disk_loses_no_row(suite: Path, small_disk: Path, pages: int, resumed: bool) -> None:
    """It is full before the first row, or after some."""
    out = small_disk / "run"
    before = run_here(suite, out, limit=4).folder.rows().rows
    ballast = fill(small_disk, pages * PAGE)
    code, errors = ended(out if resumed else suite, out)
    assert code == 2
    assert is_one_sentence(errors), errors
    now = RunFolder.open(out).rows()
    assert (now.torn, now.garbled) == (0, ())
    assert {name: now.rows[name] for name in before} == before
    assert (len(now.rows) > len(before)) == resumed
    assert "lost" not in {row["status"] for row in now.rows.values()}
    ballast.unlink()
    assert ended(suite, out) == (0, "")
    assert len(RunFolder.open(out).rows().rows) == len(stored_lines(out / "cells")) == CELLS


def test_a_limit_of_file_sizes_loses_no_row(tmp_path: Path, suite: Path) -> None:
    """Python turns SIGXFSZ off: a write beyond the limit is an error."""
    before = run_here(suite, tmp_path / "run", limit=4).folder.rows().rows
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (6000, hard))
    try:
        code, errors = ended(tmp_path / "run", tmp_path / "run")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 2
    assert is_one_sentence(errors), errors
    now = RunFolder.open(tmp_path / "run").rows()
    assert (now.torn, now.garbled) == (0, ())
    assert {name: now.rows[name] for name in before} == before
    assert len(before) < len(now.rows) < CELLS
    assert ended(suite, tmp_path / "run")[0] == 0


def test_a_read_only_folder(tmp_path: Path, suite: Path) -> None:
    out = tmp_path / "run"
    before = run_here(suite, out, limit=4).folder.rows()
    mount("--bind", str(out), str(out))
    try:
        mount("-o", "remount,ro,bind", str(out))
        code, errors = ended(suite, out)
        assert code == 2
        assert is_one_sentence(errors), errors
        assert RunFolder.open(out).rows() == before
    finally:
        subprocess.run(["umount", str(out)], check=True)


def test_the_row_writer_on_a_full_disk_writes_whole_rows_or_none(small_disk: Path) -> None:
    file = new_row_file(small_disk, "w")
    ballast = fill(small_disk, 2 * PAGE)
    written = list[str]()
    with RowWriter(file) as writer:
        while "full" not in written:
            number = str(len(written))
            try:
                writer.write({"id": number, "status": "ok", "text": "x" * 300})
            except OSError:
                written.append("full")
            else:
                written.append(number)
        written.remove("full")
        assert list(stored_rows(file)) == written
        ballast.unlink()
        writer.write({"id": "after", "status": "ok"})
    rows = read_rows(small_disk)
    assert (list(rows.rows), rows.torn, rows.garbled) == ([*written, "after"], 0, ())


def test_a_log_on_a_full_disk_keeps_its_end_in_memory(small_disk: Path) -> None:
    log = BoundedLog(small_disk / "worker.log")
    fill(small_disk, PAGE)
    for number in range(3):
        log.write(b"x" * PAGE + b"line %d\n" % number)
    assert log.output(0).endswith("line 2\n")
    log.close()


def test_an_old_run_folder(tmp_path: Path, suite: Path) -> None:
    """Rows without the newer fields, run.toml without the newer keys."""
    folder = run_here(suite, tmp_path / "run").folder.path
    text = (folder / "run.toml").read_text()
    kept = [line for line in text.splitlines() if not line.startswith("memory")]
    (folder / "run.toml").write_text("\n".join(kept))
    with RowWriter(new_row_file(folder / "cells", "old")) as writer:
        for row in RunFolder(folder).rows().rows.values():
            new = {*MACHINE_FIELDS, "sources", "losses", "fingerprint", "versions"}
            writer.write({key: value for key, value in row.items() if key not in new})
    for file in sorted((folder / "cells").iterdir())[:-1]:
        file.unlink()
    again = run(folder, names=NAMES)
    assert (again.asked, again.exit_code, again.counts) == (0, 0, {"ok": CELLS})


def test_a_moved_run_folder_and_a_moved_suite(tmp_path: Path, suite: Path) -> None:
    run_here(suite, tmp_path / "run", limit=4)
    (tmp_path / "run").rename(tmp_path / "moved")
    suite.unlink()
    again = run(tmp_path / "moved", names=NAMES, call="harness_tasks:execute")
    assert (again.asked, again.exit_code, again.counts) == (CELLS - 4, 0, {"ok": CELLS})


def test_rows_stay_where_a_plug_in_is_gone(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "import numpy as np\nfrom sysid_bench.types import Estimate\n\n"
        "class Mine:\n    def solve(self, problem):\n"
        "        return Estimate(np.linalg.lstsq(problem.W, problem.b, rcond=None)[0])\n"
    )
    text = (
        'schema = 1\nname = "gone"\n[[robot]]\nuse = "scara"\n'
        '[[estimator]]\nuse = "file:mine.py:Mine"\n'
    )
    first = run(parse_suite(text, folder=tmp_path), tmp_path / "run", jobs=1)
    (tmp_path / "mine.py").unlink()
    again = run(tmp_path / "run", jobs=1)
    assert (again.asked, again.exit_code, again.counts) == (0, 0, {"ok": 1})
    assert again.folder.rows() == first.folder.rows()


@pytest.mark.parametrize("days", [-1, 1])
def test_a_clock_that_was_set_hides_no_row(tmp_path: Path, suite: Path, days: int) -> None:
    folder = run_here(suite, tmp_path / "run", limit=4).folder
    for file in folder.path.rglob("*"):
        moved = file.stat().st_mtime + days * 86400
        os.utime(file, (moved, moved))
    assert len(folder.cells) == 4
    assert run_here(suite, tmp_path / "run").asked == CELLS - 4
    assert len(RunFolder.open(tmp_path / "run").cells) == CELLS


def test_a_second_runner_is_told_of_the_first(tmp_path: Path) -> None:
    suite = tmp_path / "suite.toml"
    suite.write_text(FULL.replace('use = "ols"', 'use = "ols"\nseconds = 0.5'))
    with start(suite, tmp_path / "run", 1) as runner:
        assert runner.stdout is not None
        runner.stdout.readline()
        code, errors = ended(suite, tmp_path / "run")
        runner.kill()
        runner.communicate()
    assert code == 2
    assert is_one_sentence(errors), errors
    assert f"process {runner.pid} (" in errors
    assert "kill_runner.py" in errors


def test_a_run_folder_that_is_removed_while_it_runs(tmp_path: Path, token: str) -> None:
    suite, out = tmp_path / "suite.toml", tmp_path / "run"
    suite.write_text(FULL.replace('use = "ols"', 'use = "ols"\nseconds = 0.2'))
    with start(suite, out, 2) as runner:
        assert runner.stdout is not None
        while runner.stdout.readline() != "row\n":
            pass
        shutil.rmtree(out)
        _, errors = runner.communicate()
    assert runner.returncode == 2
    assert is_one_sentence(errors), errors
    assert "removed" in errors
    assert wait_for(lambda: not left_behind(token)), left_behind(token)


@pytest.mark.parametrize(
    ("act", "code"), [("remove {out}", 2), ("truncate {out}/cells", 3), ("garble {out}/cells", 3)]
)
def test_a_plug_in_that_changes_the_run_folder(tmp_path: Path, act: str, code: int) -> None:
    """Rows that it destroys, itself or by a line without an end, are reported, and run again."""
    suite, out = tmp_path / "suite.toml", tmp_path / "run"
    do = act.format(out=out)
    cells = f'[[estimator]]\nuse = "ols"\n[[estimator]]\nuse = "wls"\ndo = "{do}"\n'
    suite.write_text(f'schema = 1\nname = "small"\n[[robot]]\nuse = "ur5"\n{cells}')
    found, errors = ended(suite, out)
    assert found == code, errors
    assert is_one_sentence(errors) if code == 2 else errors == ""
    again = run_here(suite, out, limit=1)
    assert again.counts == {"ok": 1}
    assert again.asked == (0 if act.startswith("garble") else 1)


def test_a_working_directory_that_is_gone(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    command = 'rmdir "$PWD" && exec "$0" -m sysid_bench run scara -o run'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable], cwd=gone, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert is_one_sentence(done.stderr), done.stderr
